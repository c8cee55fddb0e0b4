"""The settings of stages 2 to 6 beside trainings and attacks, in frozen dataclasses: what decides in them.

Each field has a unit and a range. The defaults serve all tasks, and no preset changes them.
"""

from dataclasses import dataclass
from typing import Annotated

from hyrl_mj.ranges import Checked, Integer, Number, Several

_SHARE = Number(0, 1)


@dataclass(frozen=True)
class WaySettings(Checked):
    """How ways are told apart: where they part (stage 2), and which of them are modes (stage 3).

    Attributes:
        samples: samples simulated from both ends of a rod: enough for runs to part, too few to pass an
            obstacle.
        parting: two runs part if their distance grows by this share of the sum of their displacements.
            Displacements of equal length with 50 degrees between them reach it: sin(25 degrees).
        link: points of M* that are closer belong to one piece [grid cells]: more than the diagonal of a cell,
            because two points may lie in neighbouring cells.
        wedge: M* is found across failures up to this wide [noise bounds]: the noise can push a run there.
        least_share: a way that fewer of the nodes go from which a run can start is no mode [share].
        near_share: near where ways part, a start decides if an obstacle lies between it and the end at this
            share of the angle at which they part.
    """

    samples: Annotated[int, Integer(1, 1_000)] = 5
    parting: Annotated[float, Number(0, 1, above=True)] = 0.42
    link: Annotated[float, Number(1, 100)] = 2.5
    wedge: Annotated[float, Number(0, 100)] = 4.0
    least_share: Annotated[float, _SHARE] = 0.01
    near_share: Annotated[float, _SHARE] = 0.5


@dataclass(frozen=True)
class OverlapSettings(Checked):
    """How far the parts are extended over M* (stages 4 and 5).

    Attributes:
        filled: a horizon is long enough when the propagated sets fill this share of the overlap that the
            noise needs; not all of it, because single nodes may be reached much later.
        gap: gaps of this width between the samples of backward runs are closed [grid cells]: more than the
            diagonal of a square cell.
        longest: the longest horizon that is tried [s].
        patience: no longer horizon is tried once the sets have not gained for this time [s].
    """

    filled: Annotated[float, Number(0, 1, above=True)] = 0.995
    gap: Annotated[float, Number(0, 100)] = 1.5
    longest: Annotated[float, Number(0, 3_600, above=True)] = 2.0
    patience: Annotated[float, Number(0, 3_600)] = 0.5


@dataclass(frozen=True)
class ModeSettings(Checked):
    """Where the policy of a mode is trained, and when it is good enough (stage 6).

    Attributes:
        lost_share: share of the training's episodes that start where the game is lost, if it is somewhere.
        task_share: of the others, the share that starts where the task starts; the rest starts anywhere in
            the mode's set.
        urgency: states that lose in k samples are drawn in proportion to k to this power: those near the end
            are learned first.
        allowed_delay: the latest arrival may take this share longer than the fewest samples possible.
        few: share of a mode's states that may be lost where the mode is never selected.
        margin: where the worst case cannot be computed, noise of so many times the bound has to be survived:
            a few lost episodes in a thousand may be missed, but not under larger noise.
        batches: numbers of episodes of each kind of noise, in batches. Most policies are bad and fail in the
            first; all are so many that a policy that loses a few in a thousand is found out.
        allowed_miss: there, unless the task has a precision, a policy may end this many times as far off the
            set-point as the stage-1 policy, because it goes the long way, too;
        miss_share: or by this share of the distance that counts as arrived, if that is more.
        alike: how much less of its episodes a mirror image may win than the policy that it is the image of
            [share], where no policy is expected to win all.
        worth_attacking: a policy has to win this share without noise before it is attacked, which takes long.
        may_break: a policy that loses no larger share than this is not trained: no training is expected to
            do better.
    """

    lost_share: Annotated[float, _SHARE] = 0.2
    task_share: Annotated[float, _SHARE] = 0.7
    urgency: Annotated[float, Number(-10, 10)] = -1.5
    allowed_delay: Annotated[float, Number(0, 10, above=True)] = 0.03
    few: Annotated[float, _SHARE] = 1e-3
    margin: Annotated[float, Number(1, 10)] = 1.2
    batches: Annotated[tuple[int, ...], Several(Integer(1, 100_000), 1, 16)] = (
        64,
        64,
        128,
        256,
        512,
    )
    allowed_miss: Annotated[float, Number(0, 100)] = 2.0
    miss_share: Annotated[float, Number(0, 1, above=True)] = 0.75
    alike: Annotated[float, _SHARE] = 0.02
    worth_attacking: Annotated[float, _SHARE] = 0.9
    may_break: Annotated[float, _SHARE] = 0.05


@dataclass(frozen=True)
class TableSettings(Checked):
    """How a table of inputs is made, in the place of the policy of a mode (stage 6).

    Attributes:
        cells: inputs are held until the robot has usually gone so far [grid cells],
        bounds: and so far [noise bounds]: farther than noise can hide,
        longest: but for no longer [samples].
        tables: tables that are made one from the other.
        worst: noise shows what is worst for a table with this probability, and anything else otherwise, once
            for each held input. If it always showed the worst, it would hold the robot somewhere on nearly
            all ways through narrow corridors, and all tables would be equally bad.
    """

    cells: Annotated[float, Number(0, 100)] = 2.0
    bounds: Annotated[float, Number(0, 100)] = 1.5
    longest: Annotated[int, Integer(1, 10_000)] = 64
    tables: Annotated[int, Integer(1, 100)] = 6
    worst: Annotated[float, _SHARE] = 0.8
