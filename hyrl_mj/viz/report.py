"""The report of all results of a run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import is_dataclass
from pathlib import Path
from types import MappingProxyType

from markupsafe import Markup

from hyrl_mj.errors import BadInput, listed
from hyrl_mj.judging import POLICIES
from hyrl_mj.judging.game import MapClass, Robustness
from hyrl_mj.learning import Training
from hyrl_mj.policies import Agent, MlpPolicy
from hyrl_mj.runs.arcs import attack_replay
from hyrl_mj.runs.directory import Run
from hyrl_mj.viz import pages, tables
from hyrl_mj.viz.commands import changed, commands
from hyrl_mj.viz.figures import CLASS_COLOURS
from hyrl_mj.viz.figures.style import task_title

NO_VIDEO = pages.missing(
    "There is no video of the replay, for which an off-screen renderer and ffmpeg are needed. What this "
    "machine lacks tells",
    "hyrl-mj doctor",
)


def write_report(run: Run, path: Path) -> None:
    """Writes the page; where a result is missing the page says how to get it.

    The same artifacts give the same bytes.

    Raises:
        BadArtifact: the hybrid controller is not finished, or a file is damaged.
        BadInput: the path is no html, or cannot be written.
    """
    if path.suffix != ".html":
        raise BadInput(f"a report is an html, {path} is not: give a name that ends in .html")
    pages.write(path, render(run))


def render(run: Run) -> str:
    """Returns the page as HTML."""
    task = run.task
    has = run.manifest.has
    robustness = run.robustness if has(run.path / "robustness.json") else None
    arcs = run.arcs() if all(map(has, run.arc_paths().values())) else None
    facts = [run.path / name for name in ("arrivals.json", "retraining.json")]
    stages = run.settings.stage1, run.settings.stage6
    options = [stage.options if isinstance(stage, Training) else {} for stage in stages]
    first, sixth = (_texts(vars(s) | more) for s, more in zip(stages, options, strict=True))
    title, s, unit = task_title(task), run.settings, task.noise_on()[1]
    where = Markup("{}. Run <b>{}</b>, noise {} {}, seed {}, preset {}.").format(
        capital(task.description), name := pages.name_of(run.path), s.eps, unit, s.seed, s.preset
    )
    return pages.fill(
        "report.html",
        heading=f"{title}: Hysteresis-Based RL, run {name}",
        title=title,
        subtitle=where,
        run=run,
        task=task,
        settings=s,
        critical=run.critical_set,
        unit=unit,
        tables=tables,
        robustness=robustness,
        game=robustness.game if robustness else None,
        deciding=robustness.deciding if robustness else None,
        capital=capital,
        modes=[task.mode_name(q) for q in run.controller.modes],
        listed=listed,
        worst=robustness
        and "worst noise of up to " + task.noise_text(robustness.eps, robustness.everywhere),
        film=pages.film(
            run.path / "replay.mp4",
            "Replay of the policy and HyRL, side by side",
            _film_caption(run),
            has,
        )
        or NO_VIDEO,
        pictures=pages.pictures(run.path / "figures", has),
        arrivals={who: tables.arrivals(run, arcs, who == "policy") for who in ("policy", "hyrl")}
        if arcs
        else None,
        verdict=run.verdict if robustness and all(map(has, facts)) else None,
        against_noise=against_noise(run, robustness),
        replays=arcs and tables.replay_table(run, arcs),
        stages=_stages(run),
        table=_texts(vars(s), {"eps": unit, "horizon": "s"}),
        training=[(name, first.get(name, ""), sixth.get(name, "")) for name in first | sixth],
        commands=commands(run, robustness),
        changed=changed(run),
        classes=[(c.label, colour) for c, colour in zip(MapClass, CLASS_COLOURS, strict=True)],
    )


def _film_caption(run: Run) -> str:
    """Returns what the replay shows."""
    shown = "The learned policy (left) and HyRL (right) from the same start"
    if attack_replay(run):
        return f"{shown}, in real time, each under the strongest noise that the attack found against it."
    noise = "each under the strongest noise that is known for it"
    return (
        f"{shown}{' on the critical set' * bool(len(run.critical_set.points))}, in real time, "
        f"{noise if run.exact else 'under the same alternating noise'}"
        f"{', once for each start mode of HyRL' * (len(run.controller.modes) > 1)}."
    )


def against_noise(run: Run, robustness: Robustness | None) -> list[pages.Part]:
    """Returns the tables of what noise can do, and why some are missing."""
    if robustness is None:
        cure = "hyrl-mj robustness RUN"
        return [pages.missing("It has not been examined yet what noise can do:", cure)]
    found: list[pages.Part] = [*tables.robustness_tables(run.task, robustness)]
    if robustness.game is not None:
        return found
    if why := run.why_no_game:
        said = pages.missing(f"Noisy episodes stand in for the worst case, because {why}.")
    else:
        said = pages.missing(
            "The worst case has not been played yet. It comes with", "hyrl-mj robustness RUN"
        )
    return [said, *found]


def capital(sentence: str) -> str:
    """Returns a sentence with a capital letter."""
    return f"{sentence[:1].upper()}{sentence[1:]}"


# ---- stages and settings


def _stages(run: Run) -> list[tuple[str, str]]:
    """Returns the results of the stages that make the controller in a sentence each."""
    task, s, modes = run.task, run.settings, run.extended_sets.modes
    reach = "; ".join(f"mode {task.mode_name(q)}: {tables.extent(run, q)}" for q in modes)
    attempts = f"up to {s.stage6.attempts} times " if s.stage6.attempts > 1 else ""
    known = run.manifest.has(run.path / "retraining.json")
    given = [r for r in run.retraining.modes if r.policy in POLICIES] if known else []
    retrained = "nothing was trained"
    if count := len(modes) - len(given):
        many = f"each of {count} modes" if not given else f"{count} of {len(modes)} modes"
        retrained = f"a policy for {many}: {s.stage6.title}, {attempts}{s.stage6.samples:,} samples"
    if isinstance(s.stage1, Agent):
        first = f"none: the agent {s.stage1} takes its place"
    else:
        assert isinstance(run.policy, MlpPolicy)
        size = sum(weight.size for weight in run.policy.weights.values())
        first = f"{s.stage1.title}, {s.stage1.samples:,} samples, no noise: {size:,} weights"
        if (trainings := run.arrivals.trainings) > 1:
            first += f", the best of {trainings} trainings, the later ones paid for being near to the goal"
    return [
        ("train", first),
        ("critical-set", run.critical_set.sentence(task)),
        ("partition", run.partition.sentence(task, run.settings.ways)),
        ("extended-sets", f"{run.extended_sets.sentence(task)}; {reach}"),
        ("retrain", retrained),
    ]


def _texts(
    settings: Mapping[str, object], units: Mapping[str, str] = MappingProxyType({})
) -> dict[str, str]:
    """Returns the texts of settings by their names in words, without trainings, agents and options.

    The settings of a group stand one by one.
    """
    plain: dict[str, object] = {}
    for name, value in settings.items():
        if is_dataclass(value) and not isinstance(value, Training | Agent):
            plain |= {f"{name}: {field}": one for field, one in vars(value).items()}
        elif not isinstance(value, Training | Agent | Mapping):
            plain[name] = value
    return {
        name.replace("_", " "): _text(value, units.get(name, "")) for name, value in plain.items()
    }


def _text(value: object, unit: str) -> str:
    """Returns the text of a setting, a number with its unit."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, tuple):
        return ", ".join(map(str, value))
    return "by default" if value is None else f"{value} {unit}".rstrip()
