"""The results of a sweep: a row for each run, in `sweep.json` and `sweep.csv`."""

from __future__ import annotations

import csv
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from hyrl_mj import artifacts
from hyrl_mj.errors import BadArtifact, BadInput
from hyrl_mj.game import LIMIT
from hyrl_mj.manifest import FILES
from hyrl_mj.run_directory import Run, load_run

NAME = "sweep.json"
# States of a run.
OPEN, DONE, STOPPED = "open", "done", "stopped"
# The stages that have to be finished; the others are about single starts and agents.
STAGES = [stage for stage in FILES if stage not in ("diagnose", "simulate --start")]


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
class Curve:
    """What is won against the noise bound, in the worst-case game; empty where it cannot be played.

    Attributes:
        eps: the noise bounds.
        policy, hyrl: share of the winnable starts that each controller wins, from its own start mode.
        hyrl_any: that the hybrid controller wins from every start mode.
    """

    eps: tuple[float, ...] = ()
    policy: tuple[float, ...] = ()
    hyrl: tuple[float, ...] = ()
    hyrl_any: tuple[float, ...] = ()


@dataclass(frozen=True)
class Row:
    """One run of a sweep.

    Attributes:
        setting: all but the seed.
        seed: the seed.
        state: `OPEN`, `DONE`, or `STOPPED` by an error.
        sentence: the verdict in a sentence, or the error.
        verdict: the word of the verdict, "" if there is none.
        seconds: how long the stages took that this sweep has run [s].
        figures: the results by name; None where there is none.
        curve: what is won against the noise bound.
    """

    setting: Setting
    seed: int
    state: str = OPEN
    sentence: str = ""
    verdict: str = ""
    seconds: float = 0.0
    figures: dict[str, float | None] | None = None
    curve: Curve = Curve()

    @property
    def name(self) -> str:
        """The name of the run directory."""
        return f"{self.setting.stem}-{self.seed}"

    def finished(self, run: Run) -> Row:
        """Returns the row with the results of a finished run."""
        verdict, curve = run.verdict, Curve()
        if (game := run.robustness.game) is not None:
            wins = game.curve.wins
            curve = Curve(
                game.curve.eps, wins["policy"].won, wins["hyrl"].won, wins["hyrl"].won_any
            )
        return replace(
            self,
            state=DONE,
            sentence=verdict.sentence,
            verdict=verdict.word,
            figures=_figures(run),
            curve=curve,
        )


@dataclass(frozen=True)
class Common:
    """The settings that all runs of a sweep share; those of `SweepOptions`."""

    preset: str
    horizon: float | None
    set: dict[str, Any]


@dataclass(frozen=True)
class Sweep:
    """A sweep, as `sweep.json` holds it.

    Attributes:
        common: the settings that all runs share.
        rows: the runs.
    """

    common: Common
    rows: tuple[Row, ...]

    @staticmethod
    def load(folder: Path) -> Sweep:
        """Reads `sweep.json` in a folder.

        Raises:
            BadArtifact: there is none, or it is damaged.
        """
        remedy = "give the folder of a sweep, or make one with hyrl-mj sweep TASK --out DIR"
        return artifacts.read_record(folder / NAME, "sweep", Sweep, remedy)

    def save(self, folder: Path) -> None:
        """Writes `sweep.json`."""
        artifacts.write_json(folder / NAME, self, kind="sweep")

    def with_row(self, row: Row) -> Sweep:
        """Returns the sweep with another row of the same name."""
        rows = tuple(row if row.name == other.name else other for other in self.rows)
        return replace(self, rows=rows)

    def write_csv(self, folder: Path) -> None:
        """Writes `sweep.csv`: a line for each run, with the names of the columns in the first."""
        names = list(dict.fromkeys(name for row in self.rows for name in row.figures or {}))
        with (
            artifacts.replacing(folder / "sweep.csv") as temporary,
            temporary.open("w", newline="", encoding="utf-8") as file,
        ):
            writer = csv.writer(file)
            head = ["task", "algorithm", "eps", "seed", "state", "verdict", "seconds"]
            writer.writerow([*head, *names, "sentence"])
            for row in self.rows:
                values = [row.seed, row.state, row.verdict, f"{row.seconds:.1f}"]
                found = [(row.figures or {}).get(name) for name in names]
                cells = ["" if value is None else f"{value:.6g}" for value in found]
                writer.writerow([*asdict(row.setting).values(), *values, *cells, row.sentence])

    def groups(self) -> dict[Setting, list[Row]]:
        """Returns the rows by setting."""
        found: dict[Setting, list[Row]] = {}
        for row in self.rows:
            found.setdefault(row.setting, []).append(row)
        return found


def opened(folder: Path, common: Common, rows: Iterable[Row]) -> Sweep:
    """Returns the sweep in a folder, with the rows that are not there yet; a new one if there is none.

    Raises:
        BadInput: the folder holds something else, or a sweep with other settings.
    """
    rows = tuple(rows)
    if not (folder / NAME).exists():
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise BadInput(
                f"{folder} exists and is not the folder of a sweep: choose another --out"
            )
        return Sweep(common, rows)
    there = Sweep.load(folder)
    settings = {row.setting for row in rows}, {row.setting for row in there.rows}
    if there.common != common or settings[0] != settings[1]:
        differing = [
            f"{name}: {old} there, {new} given"
            for (name, old), new in zip(
                asdict(there.common).items(), asdict(common).values(), strict=True
            )
            if old != new
        ]
        if settings[0] != settings[1]:
            was, now = ("; ".join(sorted(s.title for s in group)) for group in settings[::-1])
            differing.append(f"runs of {was} there, of {now} given")
        raise BadInput(
            f"{folder} holds a sweep with other settings ({', '.join(differing)}): choose another --out, "
            "or give the same settings; more seeds can be added"
        )
    names = {row.name for row in there.rows}
    return replace(there, rows=there.rows + tuple(r for r in rows if r.name not in names))


def finished_run(path: Path) -> Run | None:
    """Returns the run in a directory if all of its stages are finished and to be believed."""
    if not (path / "config.json").is_file():
        return None
    try:
        run = load_run(path)
        done = all(run.manifest.is_done(stage) for stage in STAGES)
        usual = done and run.robustness.eps == run.settings.noise
    except BadArtifact:
        return None
    return run if usual else None


def _figures(run: Run) -> dict[str, float | None]:
    """Returns the results of a run by name."""
    robustness = run.robustness
    if (game := robustness.game) is None:
        least: dict[str, float | None] = {}
        for who in ("policy", "hyrl"):
            for count in robustness.episodes:
                name = f"{who}_reached_{count.noise}"
                if count.controller == who:
                    least[name] = min(count.reached, least.get(name) or 1.0)
        return least
    figures: dict[str, float | None] = {"winnable": game.scores["hyrl"][-1].winnable}
    for i, when in ((0, "_without_noise"), (-1, "")):
        for who in ("policy", "hyrl", LIMIT):
            score = game.scores[who][i]
            figures[f"{who}_won{when}"] = score.won
            if who != "policy":
                figures[f"{who}_won_any{when}"] = score.won_any
    last = game.scores["hyrl"][-1]
    figures |= {"hyrl_time": last.time, "hyrl_time_any": last.time_any}
    if last.excursion is not None:
        figures["hyrl_excursion"] = last.excursion
    for who, margin in game.margin.items():
        figures[f"{who}_margin"] = margin
        figures[f"{who}_miss_without_noise"] = game.miss_without_noise[who]
    return figures


def summary(figures: Iterable[float | None]) -> tuple[float, float, float] | None:
    """Returns median, least and greatest of some figures; None if there are none."""
    values = [value for value in figures if value is not None]
    return (float(np.median(values)), min(values), max(values)) if values else None
