"""The values that describe a task: how episodes end, its mirror symmetry, its scene, training and effort."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any

import numpy as np

# Positions qpos (n, nq), and velocities qvel (n, nv), None at rest.
FullState = tuple[np.ndarray, np.ndarray | None]
# The searches for the critical set.
SEARCHES = ("rods", "outcome")


class Outcome(IntEnum):
    """State of an episode. One that is RUNNING at its end was truncated on its way."""

    RUNNING = 0
    REACHED = 1
    CRASHED = 2
    OUT_OF_BOUNDS = 3
    STALLED = 4
    UNSTABLE = 5

    @property
    def label(self) -> str:
        """The name in messages and in `info`: "reached", "crashed", ..."""
        return self.name.lower()


@dataclass(frozen=True)
class Mirror:
    """A mirror symmetry: mirrored observations call for mirrored inputs and earn the same reward.

    Attributes:
        observation: (k,) signs +1 or -1 of the observation's columns in the mirror.
        inputs: (m,) signs +1 or -1 of the inputs in the mirror.
    """

    observation: tuple[int, ...]
    inputs: tuple[int, ...]


@dataclass(frozen=True)
class Scene:
    """What replays and figures show of a task: starts, names, and the view of the MJCF.

    Attributes:
        starts: (k, d) chart points from which the replayed runs start.
        time: how long runs are shown [s].
        mode_names: what the runs of each mode do, in the order of the modes, as ("left", "right"); by
            default they are named after the obstacles, as "left of a, right of b".
        policy_starts: (l, d) chart points from which the figure of the policy draws runs, by default
            `starts`.
        title: the task's name in figures, by default its `name` in words.
        camera: the MJCF's camera of the replay; where it has no such one, "overhead" looks from above, and
            "free" is MuJoCo's free camera.
        tracked: the MJCF's site, body or geom whose path the replay draws; where it has none of that name,
            "tracked" is the first body that moves.
    """

    starts: Sequence[Sequence[float]]
    time: float
    mode_names: Sequence[str] = ()
    policy_starts: Sequence[Sequence[float]] = ()
    title: str = ""
    camera: str = "overhead"
    tracked: str = "tracked"

    def __post_init__(self) -> None:
        if not len(self.policy_starts):
            object.__setattr__(self, "policy_starts", self.starts)

    def mode_name(self, mode: int) -> str:
        """Returns the number of a mode with its name: "0 (left)"."""
        named = 0 <= mode < len(self.mode_names)
        return f"{mode} ({self.mode_names[mode]})" if named else str(mode)


@dataclass(frozen=True)
class Abilities:
    """What a task's plant can do. Environments of others can do less than copies of a model.

    Attributes:
        stopped_by_walls: whether contacts stop the robot, so that no run comes to states inside of walls.
        restarts: whether it can begin anywhere in the middle of an episode, as tables and the game have it.
        arrival_ends: whether an episode ends where it arrives, and does not go on to be judged at its end.
        side_by_side: how many episodes it can play side by side; None for any number.
    """

    stopped_by_walls: bool = False
    restarts: bool = True
    arrival_ends: bool = True
    side_by_side: int | None = None


@dataclass(frozen=True)
class Learning:
    """Defaults of a task's training and of the stages after it; a run's settings can differ.

    Attributes:
        algorithm: an algorithm of SB3, as "dqn", or "module:Class".
        levels: number of equally spaced levels of each input; None for continuous inputs.
        search: the search for the critical set, by "rods" or by "outcome"; see `find_critical_set`.
        horizon: the paper's horizon T of the backward propagation [s].
        cells: the most grid cells along the longest side of the chart, where runs from more would take too
            long; the critical set is then found to a sixteenth of a cell. None for no such limit.
        training: fields of `Training` in which stage 1 with this algorithm differs from preset fast, as
            {"samples": 1_000_000, "hidden": (256, 256)}; preset smoke has its own number of samples.
        modes: the same of stage 6, which trains one policy for each mode, as {"gamma": 0.97}.
    """

    algorithm: str = "ppo"
    levels: int | None = None
    search: str = "outcome"
    horizon: float = 0.5
    cells: int | None = None
    training: Mapping[str, Any] = field(default_factory=dict)
    modes: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Effort:
    """How much the stages try of a task, and how a mode is judged.

    Attributes:
        starts: that are drawn to see whether they lie in the box of starts, and chart points that are
            measured all over the chart (none of the latter if `everywhere` is false).
        everywhere: whether the robot is put all over the chart to see how it is measured there.
        side_by_side: episodes that a trial of the task plays side by side, at most.
        mirrored: runs that are compared with their mirror images.
        checkpoints: at which the policy that is trained is judged.
        trainings: of a mode, at most; None as the preset says.
        batches: of episodes by which a policy of a mode is judged, at most.
        attacked: whether the policies of modes are judged by an attack, after those that need no training
            (the stage-1 policy, those of stage 4, a table of inputs) have been tried.
        looks_ahead: whether noise is chosen by simulating ahead from the middle of episodes.
        transitions: of a lattice that is fitted into the memory, at most.
        nodes: from which a controller is attacked where the game is an estimate, for each start mode.
        episodes: of each kind of noise where the worst case cannot be computed.
        attack_starts, attack_rounds: starts and rounds of an attack where the worst case cannot be computed.
            Of so many starts none may be lost for 99% to be within the 95% interval of what is won (Wilson);
            so many rounds try every rule, and search for a few rounds more.
    """

    starts: int = 4_000
    everywhere: bool = True
    side_by_side: int = 256
    mirrored: int = 2_000
    checkpoints: int = 32
    trainings: int | None = None
    batches: int = 5
    attacked: bool = False
    looks_ahead: bool = True
    transitions: int = 2**23
    nodes: int = 1_000
    episodes: int = 1_000
    attack_starts: int = 400
    attack_rounds: int = 10


# Where each sample runs the Python code of an environment it takes about a hundred times as long.
SPARING = Effort(
    starts=64,
    everywhere=False,
    side_by_side=64,
    mirrored=64,
    checkpoints=8,
    trainings=1,
    batches=3,
    attacked=True,
    looks_ahead=False,
    transitions=2**22,
    nodes=48,
    episodes=200,
    attack_starts=100,
    attack_rounds=3,
)
