"""The results of a sweep: a row for each run, in `sweep.json` and `sweep.csv`."""

from __future__ import annotations

import csv
import json
import unicodedata
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from hyrl_mj.errors import BadArtifact, BadInput
from hyrl_mj.files import artifacts
from hyrl_mj.files.manifest import check_contents, check_may_hold
from hyrl_mj.judging import by_kind
from hyrl_mj.judging.game import LIMIT, Robustness
from hyrl_mj.learning import Settings, changed, differing, preset
from hyrl_mj.policies import ALGORITHMS
from hyrl_mj.runs.directory import Run, load_run
from hyrl_mj.tasks import described_task

NAME = "sweep.json"
MOST_RUNS = 1_000


@dataclass(frozen=True)
class Setting:
    """What runs that differ in nothing but their seed have in common.

    Attributes:
        task: the name of the task, or the file that defines it.
        algorithm: the algorithm of stage 1; "" for the task's.
        eps: the bound of the noise.
    """

    task: str
    algorithm: str
    eps: float

    def __post_init__(self) -> None:
        if Path(self.stem).name != self.stem:
            raise BadInput(f"{self.stem!r} cannot be the name of a folder: give another algorithm")

    @property
    def title(self) -> str:
        """The setting in words, such as "vehicle, dqn, noise 0.1"."""
        parts = [Path(self.task).stem, self.algorithm, f"noise {self.eps:g}"]
        return ", ".join(filter(None, parts))

    @property
    def stem(self) -> str:
        """The beginning of the names of its run directories, such as "vehicle-dqn-0.1"."""
        parts = [Path(self.task).stem, self.algorithm.replace(":", "_"), f"{self.eps:g}"]
        return "-".join(filter(None, parts))


@dataclass(frozen=True)
class Row:
    """One run of a sweep.

    Attributes:
        setting: all but the seed.
        seed: the seed.
        state: "open", "done", or "stopped" by an error.
        sentence: the verdict in a sentence, or the error.
        verdict: the word of the verdict, "" if there is none.
        seconds: how long the stages took that this sweep has run [s].
        figures: the results by name; None where there is none.
    """

    setting: Setting
    seed: int
    state: Literal["open", "done", "stopped"] = "open"
    sentence: str = ""
    verdict: str = ""
    seconds: float = 0.0
    figures: dict[str, float | None] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """The name of the run directory."""
        return f"{self.setting.stem}-{self.seed}"

    @property
    def done(self) -> bool:
        """Whether the run is finished."""
        return self.state == "done"

    def on_disk(self, folder: Path, common: Common) -> Row:
        """Returns the row with what its run directory holds: its results if it is finished, else none.

        A run of other settings than those of the row and of the sweep has none.
        """
        row = Row(self.setting, self.seed, seconds=self.seconds)
        try:
            if (run := finished_run(folder / self.name)) is None:
                return row
            wanted = common.settings(self, run.settings)
        except BadInput as error:  # the task is in a file that may not be executed
            return row.stopped(str(error))
        stem, differences = Path(run.settings.task).stem, ", ".join(differing(run.settings, wanted))
        if differences or stem != Path(self.setting.task).stem:
            return row.stopped(
                f"its folder holds a run of {stem} with other settings ({differences or 'another task'}): "
                "put it back to where it was made, and remove what lies here"
            )
        verdict = run.verdict
        return replace(
            row,
            state="done",
            sentence=verdict.sentence,
            verdict=verdict.word,
            figures=_figures(run.robustness, run.task.tells_arrival),
        )

    def stopped(self, sentence: str) -> Row:
        """Returns the row without results, because of an error."""
        return Row(self.setting, self.seed, "stopped", sentence, seconds=self.seconds)


@dataclass(frozen=True)
class Common:
    """The settings that all runs of a sweep share; those of `SweepOptions`."""

    preset: str
    horizon: float | None
    set: dict[str, Any]
    everywhere: bool = False

    def settings(self, row: Row, found: Settings) -> Settings:
        """Returns the settings that the run of a row has; those of a foreign algorithm as they were found."""
        own, task = row.setting, described_task(found.task)
        algorithm = own.algorithm or task.learning.algorithm
        usual = algorithm in ALGORITHMS
        made = preset(
            task, self.preset, eps=own.eps, seed=row.seed, horizon=self.horizon,
            algorithm=algorithm if usual else None,
        )  # fmt: skip
        if not usual:
            named = found.stage1.algorithm == algorithm
            stage1 = found.stage1 if named else replace(made.stage1, algorithm=algorithm)
            made = replace(made, stage1=stage1, stage6=found.stage6)
        made = replace(made, task=found.task, everywhere=self.everywhere)
        return changed(made, self.set) if self.set else made

    def texts(self) -> dict[str, str]:
        """Returns the settings as they are typed, by option."""
        horizon = "by default" if self.horizon is None else f"{self.horizon:g}"
        changes = " ".join(f"{name}={json.dumps(value)}" for name, value in self.set.items())
        everywhere = "given" if self.everywhere else "not given"
        return {
            "--preset": self.preset,
            "--horizon": horizon,
            "--all-coordinates": everywhere,
            "--set": changes or "nothing",
        }


@dataclass(frozen=True)
class Sweep:
    """A sweep, as `sweep.json` holds it.

    Attributes:
        common: the settings that all runs share.
        rows: the runs.
    """

    common: Common
    rows: tuple[Row, ...]

    def __repr__(self) -> str:
        words = Counter(row.verdict or row.state for row in self.rows)
        return f"Sweep({', '.join(f'{count} {word}' for word, count in sorted(words.items()))})"

    def checked(self) -> Sweep:
        """Returns the sweep itself; raises `BadInput` if it has more than `MOST_RUNS` runs."""
        if len(self.rows) > MOST_RUNS:
            raise BadInput(
                f"a sweep makes at most {MOST_RUNS:,} runs, and this one would have {len(self.rows):,}: "
                "divide it among several folders"
            )
        return self

    @staticmethod
    def load(folder: Path) -> Sweep:
        """Reads `sweep.json` in a folder.

        Raises:
            BadArtifact: there is none, it is damaged, or the folder holds a link.
            BadInput: it has more runs than any sweep.
        """
        check_contents(folder)
        remedy = "give the folder of a sweep, or make one with hyrl-mj sweep TASK --out DIR"
        found = artifacts.read_record(folder / NAME, "sweep", Sweep, remedy).checked()
        names = Counter(row.name for row in found.rows)
        if len(names) < len(found.rows):
            twice = names.most_common(1)[0][0]
            raise BadArtifact(
                f"{folder / NAME} has the run {twice[:80]} twice: make the sweep again"
            )
        return found

    def save(self, folder: Path) -> None:
        """Writes `sweep.json`."""
        artifacts.write_json(folder / NAME, self, kind="sweep")

    def on_disk(self, folder: Path) -> Sweep:
        """Returns the sweep with what the run directories hold; what has stopped runs stays told."""

        def seen(row: Row) -> Row:
            found = row.on_disk(folder, self.common)
            told = row.state == "stopped" and found.state == "open"
            return row.stopped(row.sentence) if told else found

        return replace(self, rows=tuple(map(seen, self.rows)))

    def with_row(self, row: Row) -> Sweep:
        """Returns the sweep with another row of the same name."""
        rows = tuple(row if row.name == other.name else other for other in self.rows)
        return replace(self, rows=rows)

    def write_csv(self, folder: Path) -> None:
        """Writes `sweep.csv`: a line for each run, with the names of the columns in the first."""
        names = list(dict.fromkeys(name for row in self.rows for name in row.figures))
        with (
            artifacts.replacing(folder / "sweep.csv") as temporary,
            temporary.open("w", newline="", encoding="utf-8") as file,
        ):
            writer = csv.writer(file)
            head = ["task", "algorithm", "eps", "seed", "state", "verdict", "seconds"]
            writer.writerow([*head, *map(_plain, names), "sentence"])
            for row in self.rows:
                task, algorithm = _plain(row.setting.task), _plain(row.setting.algorithm)
                values = [row.seed, row.state, _plain(row.verdict), f"{row.seconds:.6g}"]
                found = [row.figures.get(name) for name in names]
                cells = ["" if value is None else f"{value}" for value in found]
                sentence = _plain(row.sentence)
                writer.writerow([task, algorithm, row.setting.eps, *values, *cells, sentence])

    def groups(self) -> dict[Setting, list[Row]]:
        """Returns the rows by setting."""
        found: dict[Setting, list[Row]] = {}
        for row in self.rows:
            found.setdefault(row.setting, []).append(row)
        return found


def _plain(text: str) -> str:
    """Returns a text that a spreadsheet does not take for a formula."""
    formulas = ("=", "+", "-", "@", "\t", "\r")
    # A spreadsheet passes over spaces, and takes wide characters for the usual ones.
    seen = unicodedata.normalize("NFKC", text).lstrip()
    return f"'{text}" if seen.startswith(formulas) or text.startswith(formulas) else text


def opened(folder: Path, common: Common, rows: Iterable[Row]) -> Sweep:
    """Returns the sweep in a folder, with the rows that are not there yet; a new one if there is none.

    Raises:
        BadInput: the folder holds something else, or a sweep with other settings.
    """
    rows = tuple(rows)
    if not (folder / NAME).exists():
        check_may_hold(folder, NAME, "the folder of a sweep")
        return Sweep(common, rows).checked()
    there = Sweep.load(folder)
    if there.common != common:
        pairs = zip(there.common.texts().items(), common.texts().values(), strict=True)
        differing = (f"{name} {old} there, {new} given" for (name, old), new in pairs if old != new)
        raise BadInput(
            f"{folder} holds a sweep with other settings ({'; '.join(differing)}): choose another --out, "
            "or give the same settings; seeds, noise bounds, algorithms and tasks can be added"
        )
    known = {row.name: row for row in there.rows}
    for row in rows:
        if known.setdefault(row.name, row).setting != row.setting:
            was, now = known[row.name].setting, row.setting
            raise BadInput(
                f"{folder} holds a run {row.name} of {was.task}, and one of {now.task} is given: choose "
                "another --out"
            )
    return replace(there, rows=tuple(known.values())).checked()


def finished_run(path: Path) -> Run | None:
    """Returns the run in a directory if its stages are finished and to be believed.

    Raises:
        BadInput: the task is in a file that this machine has not executed before.
    """
    if not (path / "config.json").is_file():
        return None
    # Not those that draw: pictures are missing where nothing can be drawn.
    stages = (
        "train", "critical-set", "partition", "extended-sets", "retrain", "robustness", "report",
    )  # fmt: skip
    try:
        run = load_run(path)
        done = all(map(run.manifest.is_done, stages)) and run.is_examined_as_usual
    except BadArtifact:
        return None
    return run if done else None


def _figures(robustness: Robustness, timed: bool = True) -> dict[str, float | None]:
    """Returns the results of a run by name; `timed` tells whether its episodes end where they arrive."""
    if (game := robustness.deciding) is None:
        found: dict[str, float] = {}
        for who in ("policy", "hyrl"):
            for kind, (arrived, episodes) in by_kind(robustness, who).items():
                found |= {f"{who}_reached_{kind}": arrived / episodes, f"episodes_{kind}": episodes}
        return {**found, **_compared(robustness, timed)}
    last = game.scores["hyrl"][-1]
    figures: dict[str, float | None] = {"open": last.open, "winnable": last.winnable}
    for i, when in ((0, "_without_noise"), (-1, "")):
        for who in ("policy", "hyrl", LIMIT):
            score = game.scores[who][i]
            kinds = ("won",) if who == LIMIT else ("won", "proved", "not_broken")
            replays = None if when else game.replays_of(who)
            for kind in kinds:
                # What is lost where it is played in MuJoCo is not won, whatever the game says.
                refuted = kind != "won" and replays and replays.failures
                for some in ("",) if who == "policy" else ("", "_any"):
                    name = f"{who}_{kind}{some}{when}"
                    figures[name] = None if refuted else getattr(score, f"{kind}{some}")
    figures |= {"hyrl_time": last.time, "hyrl_time_any": last.time_any}
    figures |= {"hyrl_proved_time": last.proved_time, "hyrl_proved_time_any": last.proved_time_any}
    if last.excursion is not None:
        figures["hyrl_excursion"] = last.excursion
    for who, margin in game.margin.items():
        figures[f"{who}_margin"] = margin
        figures[f"{who}_miss_without_noise"] = game.miss_without_noise[who]
    return {**figures, **_compared(robustness, timed)}


def _compared(robustness: Robustness, timed: bool = True) -> dict[str, float]:
    """Returns what comparisons from the same starts tell of both controllers, of the worst kind of noise."""
    figures: dict[str, float] = {}
    for compared in robustness.comparisons:
        if " " in compared.noise:  # a sum or a log, with other bounds than the run
            continue
        n, attack = compared.compared, compared.noise == "attack"
        if attack:
            for who, lost in compared.unaided.items():
                figures[f"{who}_lost_without_noise"] = lost / compared.starts
        if not n:  # no start that both win without noise
            continue
        if attack:
            figures["attacked"] = n
        for who in compared.lost:
            if attack:
                figures[f"{who}_withstood_attack"] = 1 - compared.lost[who] / n
            if n == compared.lost[who] or not timed:  # none arrives, late or not
                continue
            for name, value in (
                ("late", compared.late[who] / n),
                ("longest", compared.time[who][1]),
            ):
                figures[f"{who}_{name}"] = max(value, figures.get(f"{who}_{name}", 0.0))
    return figures
