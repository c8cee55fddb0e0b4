"""What people would do instead of HyRL, made and judged beside it."""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass, field, replace
from functools import partial
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any
from uuid import uuid4

import numpy as np

from hyrl_mj.errors import BadInput, brief, unknown
from hyrl_mj.files.manifest import locked
from hyrl_mj.files.sources import digest_of
from hyrl_mj.judging import Budget, ExamineOptions, attack, examine
from hyrl_mj.judging.game import Game, Robustness, curve_grid, percent
from hyrl_mj.pipeline.runs import (
    RunOptions,
    checked_seeds,
    complete,
    run,
    setting_values,
    settings_of,
    several,
    usable_task,
)
from hyrl_mj.pipeline.steps import subject_of
from hyrl_mj.policies import Controller, as_controller, is_memory, memory_at_start
from hyrl_mj.ranges import By, Checked
from hyrl_mj.runs import compared
from hyrl_mj.runs.compared import Compared, Row
from hyrl_mj.runs.directory import Run
from hyrl_mj.simulation import LoopSettings, Noise, closed_loop
from hyrl_mj.system import cores
from hyrl_mj.system.progress import Say
from hyrl_mj.tasks import Task, reference

# Starts, and rounds of the attack, by which a setting is chosen where no game can be played.
CHOICE_STARTS, CHOICE_ROUNDS = 128, 3
# Episodes from which the distance to the set-point and the variation of inputs are measured.
EPISODES = 1_000


@dataclass(frozen=True)
class CompareOptions(Checked):
    """The options of a comparison.

    Attributes:
        eps: bound of the measurement noise, in the units of the chart; by default 0.1, or what covers the
            sensors that the task declares.
        seeds: seeds of the runs, as 0-4: a run of HyRL and one of each alternative for each.
        preset: fast, paper or smoke, as for `hyrl-mj run`.
        set: settings of the runs to change, as for `hyrl-mj run`; by default none.
        only: names of alternatives, as held,recurrent; by default all. The policy of stage 1 and HyRL always
            stand beside them.
        out: the folder of the comparison; by default runs/TASK_compare.
    """

    eps: float | None = None
    seeds: Annotated[tuple[int, ...], By(checked_seeds)] = (0,)
    preset: str = "fast"
    set: Annotated[dict[str, Any], By(setting_values)] = field(default_factory=dict)
    only: Annotated[tuple[str, ...], By(several)] = ()
    out: str | Path | None = None


def compare(
    task: str | Path | Task,
    options: CompareOptions | None = None,
    *,
    say: Say = print,
    **changes: Any,
) -> Compared:
    """Compares HyRL with what people would do instead: makes each alternative, tunes it, and judges it.

    Each alternative may train with as many samples as the whole run of HyRL took. All are judged alike, by
    the same starts, noise and attack. What is done is not done again. With `using_pool` alternatives are made
    side by side.

    Args:
        task: as for `run`.
        options: the options, by default `CompareOptions()`.
        say: receives a line about each alternative.
        changes: fields of the options to change.

    Raises:
        BadInput: a value that cannot be used, or a folder that holds something else.
    """
    from hyrl_mj.alternatives import registered
    from hyrl_mj.viz.compared_page import write_page

    options, known = complete(CompareOptions, options, changes), registered()
    task = usable_task(task)
    for name in options.only:
        if name not in known:
            raise unknown("alternative", name, known)
    chosen = [n for n in known if not options.only or n in (*options.only, "policy", "hyrl")]
    if not options.seeds:
        raise BadInput("a comparison needs at least one seed: give one or more")
    folder = Path(options.out or Path("runs") / f"{task.name}_compare")
    common = RunOptions(eps=options.eps, preset=options.preset, set=options.set)
    of_runs = [replace(common, seed=s, out=folder / f"hyrl-{s}") for s in options.seeds]
    # A wrong value is reported before the work.
    eps = {settings_of(task, one).eps for one in of_runs}.pop()
    fresh = Compared(reference(task), eps, options.preset, options.set, task.tells_arrival)
    compared.opened(folder, fresh)
    with locked(folder):
        found = _without_outdated(compared.opened(folder, fresh), task, say)
        found.save(folder)  # from now on it can be resumed
        for seed, one in zip(options.seeds, of_runs, strict=True):
            open_ = [n for n in chosen if (r := found.row(n, seed)) is None or r.state != "done"]
            if not open_:
                say(f"seed {seed}: done before")
                continue
            made = run(task, one, say=lambda text: say(f"hyrl: {text}"))
            for row in cores.in_processes(partial(judged, made, seed=seed), open_):
                found = found.with_row(row)
                found.save(folder)
                say(_told(row))
        write_page(found, folder)
    return found


def _without_outdated(found: Compared, task: Task, say: Say) -> Compared:
    """Returns a comparison without the rows that another code has made, of the task or of an alternative."""
    from hyrl_mj.alternatives import registered

    def is_of_now(row: Row) -> bool:
        now = _code(task, row.name)
        return row.code == now or (row.name not in registered() and row.code[:64] == now[:64])

    kept = tuple(filter(is_of_now, found.rows))
    if gone := sorted({row.name for row in found.rows} - {row.name for row in kept}):
        say(
            f"{', '.join(gone)}: left out, because their code or that of the task has changed or is in no "
            "file"
        )
    return replace(found, rows=kept)


def _code(task: Task, name: str) -> str:
    """Returns digests of the code that makes a row: of the package and the task, and of the alternative."""
    from hyrl_mj.alternatives import registered

    common = sha256(f"{version('hyrl-mj')} {task.code}".encode()).hexdigest()
    if name not in registered():
        return common
    module = sys.modules.get(type(registered()[name]).__module__)
    file = Path(getattr(module, "__file__", None) or "")
    # What a notebook defines, or a script that is piped into Python, may be another each time.
    return common + (digest_of(file) if file.is_file() else uuid4().hex)


def _told(row: Row) -> str:
    """Returns a line about a row."""
    if row.state == "unfit":
        return f"{row.name}: {row.sentence}"
    shares = {"under attack": row.figures.get("worst"), "in the game": row.figures.get("won")}
    won = " and ".join(f"{percent(v, False)} {how}" for how, v in shares.items() if v is not None)
    return f"{row.name}: {row.title}, {row.sentence}, wins {won} ({row.seconds:.0f} s)"


def judged(made: Run, name: str, *, seed: int) -> Row:
    """Returns the row of an alternative: the best of its settings, judged as HyRL is."""
    from hyrl_mj.alternatives import registered

    kind = registered()[name]
    row = Row(name, kind.title[: compared.LONGEST_TITLE], seed, code=_code(made.task, name))
    try:
        return _made(made, row)
    except BadInput as error:  # the others go on
        return replace(row, state="unfit", sentence=str(error))
    except Exception as error:  # whatever a user's class raises
        if type(kind).__module__.startswith("hyrl_mj."):
            raise
        return replace(row, state="unfit", sentence=f"it raises {brief(error)}")


def _made(made: Run, row: Row) -> Row:
    """Returns the row of an alternative with its results.

    Raises:
        BadInput: it does not fit the task.
    """
    from hyrl_mj.alternatives import Candidate, Given, registered

    began, seed = time.monotonic(), row.seed
    # What it does to the policies of the run that it is given changes no other row.
    candidates = [*registered()[row.name].candidates(Given(made.anew(), seed))]
    if not candidates or not all(isinstance(each, Candidate) for each in candidates):
        raise BadInput("candidates() yields no setting: let it yield a Candidate for each")
    tried = dict.fromkeys((each.label for each in candidates), 0.0)
    if len(tried) < len(candidates) or (why := replace(row, tried=tried).why_not):
        why = why if len(tried) == len(candidates) else "several settings of one label"
        raise BadInput(
            f"candidates() yields {why}: let it yield fewer, each with a short label of its own"
        )
    loops, number = [as_controller(each.acts) for each in candidates], 0
    if len(candidates) > 1:
        by_game = all(_playable(made, loop) for loop in loops)
        scores = [_worst(made, loop, seed, by_game) for loop in loops]
        tried, number = dict(zip(tried, scores, strict=True)), int(np.argmax(scores))
    best, seconds = candidates[number], time.monotonic() - began
    return replace(
        row,
        state="done",
        sentence=best.label,
        tried=tried if len(tried) > 1 else {},
        samples=best.samples,
        seconds=seconds,
        figures=figures_of(made, loops[number], seed),
    )


def _playable(made: Run, controller: Controller) -> bool:
    """Returns whether the worst-case game can be played against a controller, and is no estimate."""
    return made.exact and not is_memory(memory_at_start(controller, 1))


def _worst(made: Run, controller: Controller, seed: int, by_game: bool) -> float:
    """Returns the share of starts that a controller wins in the worst case that is found soon.

    That is the game on the lattice of the curve where it can be played against all settings, else a short
    attack from other starts than those of the examination. By this settings are chosen.
    """
    task, s = made.task, made.settings
    if by_game:
        grid = curve_grid(task, s.lattice)
        game = Game(task, made.split, {"one": controller}, s.eps, s.everywhere, grid)
        return game.score("one", s.eps).won
    starts = task.starts(CHOICE_STARTS, np.random.default_rng([seed, 2]))
    budget = Budget(rounds=CHOICE_ROUNDS)
    found = attack(task, {"one": controller}, starts, s.eps, budget, s.everywhere, seed, s.attack)
    count = found["one"].count
    return 1 - (count.lost + count.unaided) / count.starts


def figures_of(made: Run, controller: Controller, seed: int) -> dict[str, float]:
    """Returns what an examination says of a controller, by name.

    These are: of the winnable starts the shares `proved`, and not `won` by any noise that is known
    (`won_quiet` without noise), where the game can be played; of the `attacked` starts, which are the same
    for all controllers, winnable or not, the shares `worst`, won whatever the attack tried, and
    `lost_quiet`, lost without noise; of those that are won without noise the shares `reached` under each
    kind of noise, and `late` under the worst of them; `miss` [chart units], the median distance from the
    set-point at the end under uniform noise, of a task that tells one; and `variation`, how far inputs go in
    a second there, as multiples of their range (median).
    """
    subject = replace(
        subject_of(made, {"one": controller}, made.split),
        playable=_playable(made, controller),
        winnable=False,
        curves=False,
    )
    effort = subject.effort
    options = ExamineOptions(
        episodes=effort.episodes, attack_starts=effort.attack_starts, seed=1_000 + seed
    )
    result = examine(subject, options, attacked=True).robustness
    found = {**_shares(result), **_manners(made, controller, seed)}
    return {name: value for name, value in found.items() if np.isfinite(value)}


def _shares(result: Robustness) -> dict[str, float]:
    """Returns shares of starts from an examination of one controller."""
    found: dict[str, float] = {}
    game = result.game
    # What is lost where it is played in MuJoCo is not won, whatever the game says.
    replays = game.replays_of("one") if game else None
    if game is not None and not (replays and replays.failures):
        quiet, last = (game.scores["one"][i] for i in (0, -1))
        found |= {"winnable": last.winnable, "won": last.not_broken, "won_quiet": quiet.not_broken}
        if last.proved is not None:
            found["proved"] = last.proved
    for count in result.attacks:
        found |= {"attacked": count.starts, "lost_quiet": count.unaided / count.starts}
        found["worst"] = 1 - (count.lost + count.unaided) / count.starts
    for one in result.comparisons:
        if one.compared:
            found[f"reached_{one.noise}"] = 1 - one.lost["one"] / one.compared
            found["late"] = max(found.get("late", 0.0), one.late["one"] / one.compared)
    return found


def _manners(made: Run, controller: Controller, seed: int) -> dict[str, float]:
    """Returns how runs under uniform noise end, and how much their inputs vary."""
    task, s = made.task, made.settings
    z0 = task.starts(EPISODES, np.random.default_rng([seed, 3]))
    settings = LoopSettings(record=True, states=False, quiet=True)
    noise = Noise("uniform", s.eps, s.everywhere)
    play = closed_loop(task, controller, z0, noise, seed=seed, settings=settings)
    low, high = task.input_limits
    moved = np.abs(np.diff(play.u, axis=0)) / (high - low)
    seconds = np.maximum(play.length - 1, 1) * task.dt
    variation = np.nansum(moved, axis=(0, 2)) / seconds
    found = {"variation": float(np.median(variation))}
    if task.abilities.side_by_side is None:  # environments do not tell how far off they end
        found["miss"] = float(np.median(task.miss(play.path[-1])))
    return found
