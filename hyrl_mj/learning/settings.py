"""The settings of a run, in frozen dataclasses; `presets` makes them."""

from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Self

from hyrl_mj.errors import BadInput, check_bound, check_seed, unknown
from hyrl_mj.judging import VerdictSettings
from hyrl_mj.learning.options import check_options
from hyrl_mj.policies import ACTIVATIONS, ALGORITHMS, Agent, algorithms
from hyrl_mj.ranges import (
    By,
    Checked,
    Flag,
    Instance,
    Integer,
    Number,
    OneOf,
    Optional,
    Several,
    Text,
)
from hyrl_mj.sets import Grid, covering
from hyrl_mj.simulation import AttackSettings, Sensor
from hyrl_mj.tasks import SEARCHES, Task

PRESETS = ("fast", "paper", "smoke")

# Grid cells along the longest side of a chart.
CELLS = Integer(2, 10**6)
_SHARE = Number(0, 1)
# Samples of a training, and widths of its layers, at most.
MOST, WIDEST = 10**9, 4_096
# Share of the episodes that start anywhere, of trainings that learn a scene that nobody has tuned them for.
REHEARSED = 0.4


# ---- what decides in stages 2 to 6 beside trainings and attacks: the defaults serve all tasks


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
        may_break: a policy that loses no larger share than this under attack is not trained: no training is
            expected to do better. Nor does it end how a policy is judged by noisy episodes: no policy may win
            some of them.
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


# ---- trainings, and whole runs


@dataclass(frozen=True)
class Training(Checked):
    """How SB3 trains one policy. A field beside whose type a rule stands is checked by it.

    Attributes:
        algorithm: one of `hyrl_mj.policies.ALGORITHMS`, or `module:Class` of another one.
        samples: total number of environment samples.
        envs: number of episodes side by side.
        hidden: widths of the hidden layers.
        activation: function between the layers, one of `hyrl_mj.policies.ACTIVATIONS`.
        learning_rate: learning rate at the start.
        anneal: whether the learning rate falls linearly,
        final_rate: to this share of its first value, not to zero: the last samples count, too.
        gamma: discount factor.
        symmetric: whether the network respects the task's mirror symmetry, if it has one. The weights are
            used twice, and the policy has twice the width.
        spread: whether the kinks of the first layer are spread over the observations of the whole chart at
            first, and do not all pass through the origin.
        normalize: whether rewards are divided by the standard deviation of the return so far, as SB3's
            `VecNormalize` does. Without it, PPO learns slowly from returns that are far from 1.
        rehearse: share of the episodes that start anywhere on the chart, and not where the task starts
            (stage 1 only),
        rehearse_lost: of them, the share that starts where the latest policy lost,
        rehearse_deciding: and the share that starts where it decided between ways.
        warm_start: whether the first attempt continues from the policy of stage 1 (stage 6 only): DQN from
            its weights, PPO from its distilled actions on the mode's part. A Gaussian policy of small spread
            does not explore the other way any more.
        episode: samples until an episode is truncated, by default the task's; shorter episodes cover more
            starts.
        shaped: whether episodes are paid for being near to the goal by the shortest way around what ends
            them, in place of the task's reward (stage 1 only; those of the modes follow it).
        attempts: number of trainings, each with another seed, until a policy is good enough; the best policy
            is kept. In stage 1 it is good enough if it arrives from 99% of the starts, or after two attempts
            from half of them. All but the first are `shaped` there, the third and later ones with twice the
            samples and widths.
        minutes: no further attempt begins if it would end later than so many minutes after the first began
            (stage 1 only).
        action_noise: standard deviation of the exploration noise of TD3 and DDPG on inputs scaled to -1..1.
        options: further keyword arguments of the SB3 algorithm.
    """

    algorithm: Annotated[str, Text()]
    samples: Annotated[int, Integer(1, MOST)]
    envs: Annotated[int, Integer(1, 2**16)]
    hidden: Annotated[tuple[int, ...], Several(Integer(1, WIDEST), 1, 16)]
    activation: Annotated[str, OneOf(ACTIVATIONS)]
    learning_rate: Annotated[float, Number(0, 1, above=True)]
    anneal: Annotated[bool, Flag()]
    gamma: Annotated[float, Number(0, 1, above=True)]
    symmetric: Annotated[bool, Flag()]
    spread: Annotated[bool, Flag()] = False
    normalize: Annotated[bool, Flag()] = False
    final_rate: Annotated[float, Number(0, 1)] = 0.02
    rehearse: Annotated[float, Number(0, 1)] = 0.0
    rehearse_lost: Annotated[float, Number(0, 1)] = 0.4
    rehearse_deciding: Annotated[float, Number(0, 1)] = 0.4
    warm_start: Annotated[bool, Flag()] = False
    episode: Annotated[int | None, Optional(Integer(1, 100_000))] = None
    shaped: Annotated[bool, Flag()] = False
    attempts: Annotated[int, Integer(1, 1_000)] = 1
    minutes: Annotated[float, Number(0, 100_000)] = 10.0
    action_noise: Annotated[float, Number(0, 10)] = 0.0
    options: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        if ":" not in self.algorithm and self.algorithm not in ALGORITHMS:
            raise unknown("algorithm", self.algorithm, [*ALGORITHMS, "or module:Class"])
        check_options(self.algorithm, self.options, samples=self.samples, envs=self.envs)
        if self.rehearse_lost + self.rehearse_deciding > 1:
            raise BadInput(
                f"rehearse_lost {self.rehearse_lost:g} and rehearse_deciding {self.rehearse_deciding:g} "
                "cannot be used, because they are shares of the same episodes: together give at most 1"
            )
        if self.action_noise and self.algorithm in ("ppo", "a2c", "dqn"):
            raise BadInput(
                f"action_noise {self.action_noise:g} cannot be used, because {self.algorithm} explores "
                "without it: give 0"
            )

    def attempt(self, number: int) -> Self:
        """Returns the settings of an attempt of stage 1, from 0 on; see `attempts`."""
        if not number:
            return self
        more = 1 if number == 1 or self.samples > MOST // 2 or max(self.hidden) > WIDEST // 2 else 2
        return replace(
            self,
            shaped=True,
            rehearse=self.rehearse or REHEARSED,
            samples=more * self.samples,
            hidden=tuple(more * width for width in self.hidden),
        )

    @property
    def title(self) -> str:
        """The name of the algorithm, such as "PPO"."""
        return algorithms.title(self.algorithm)


@dataclass(frozen=True)
class Settings(Checked):
    """All settings of a run; `config.json` holds them.

    Attributes:
        task: name of the task, or the file that defines it.
        preset: name of the preset of the other settings.
        seed: seed of all random numbers.
        eps: bound of the measurement noise that the controller has to survive.
        horizon: time T of the backward propagation [s]; None to size the sets to the noise.
        stage1: training of the first policy (stage 1), or the agent in its place.
        stage6: training of each mode's policy (stage 6).
        cells: grid cells along the longest side of the chart, square in scaled units. In three dimensions the
            nodes of this grid are shared out by the noise; in more there are `cells`**4 scattered nodes.
        rods: grid points along the longest side from which the search for critical points starts; in more
            than three dimensions there are `rods`**4 scattered ones.
        lattice: lattice cells along the longest side for the worst-case game, fewer where these do not fit
            into the memory; 0 for the usual number.
        resolution: length of the last rods, as a share of the first.
        search: search method for critical points, "rods" or "outcome".
        everywhere: whether the noise acts on all coordinates, not only on the task's noisy ones.
        sensor: what the sensors do that the noise covers; None if they add noise of its bound alone.
        ways: how ways are told apart (stages 2 and 3).
        overlap: how far the parts are extended (stages 4 and 5).
        modes: where the policies of modes are trained, and when they are good enough (stage 6).
        table: how tables of inputs are made (stage 6).
        attack: what signals attacks try, in stage 6 and in the examination.
        verdict: what a verdict asks for.
    """

    task: Annotated[str, Text()]
    preset: Annotated[str, OneOf(PRESETS)]
    seed: Annotated[int, By(check_seed)]
    eps: Annotated[float, By(check_bound)]
    horizon: Annotated[float | None, Optional(Number(0, 3_600, above=True))]
    stage1: Annotated[Training | Agent, Instance((Training, Agent))]
    stage6: Annotated[Training, Instance((Training,))]
    cells: Annotated[int, CELLS]
    rods: Annotated[int, CELLS]
    lattice: Annotated[int, Integer(0, 10**6)]
    resolution: Annotated[float, Number(1e-6, 1)] = 1 / 32
    search: Annotated[str, OneOf(SEARCHES)] = "rods"
    everywhere: Annotated[bool, Flag()] = False
    sensor: Annotated[str | None, Optional(Text())] = None
    ways: Annotated[WaySettings, Instance((WaySettings,))] = WaySettings()
    overlap: Annotated[OverlapSettings, Instance((OverlapSettings,))] = OverlapSettings()
    modes: Annotated[ModeSettings, Instance((ModeSettings,))] = ModeSettings()
    table: Annotated[TableSettings, Instance((TableSettings,))] = TableSettings()
    attack: Annotated[AttackSettings, Instance((AttackSettings,))] = AttackSettings()
    verdict: Annotated[VerdictSettings, Instance((VerdictSettings,))] = VerdictSettings()

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.stage6.gamma == 1:
            raise BadInput(
                "stage6.gamma 1.0 cannot be used, because the cost of leaving a mode's set for ever would be "
                "infinite: give a number less than 1"
            )
        if self.stage6.algorithm not in ALGORITHMS:
            raise unknown("stage6.algorithm", self.stage6.algorithm, ALGORITHMS)

    def noisy(self, task: Task) -> Task:
        """Returns a task with the noise of these settings.

        Raises:
            BadInput: the bound does not cover what the sensor does.
        """
        if self.sensor is not None:
            bound, shares = Sensor.parse(self.sensor).on(task)
            if bound != self.eps:
                raise BadInput(
                    f"the sensor {self.sensor} needs a noise bound of {bound:g} on {task.name}, and not "
                    f"{self.eps:g}: start a new run"
                )
            return task.with_sensor(self.sensor, shares)
        return task.noisy_everywhere() if self.everywhere else task

    def check(self, task: Task) -> None:
        """Raises `BadInput` if a value does not fit the task: its chart, its episodes, or its inputs."""
        task.check_noise(self.eps, self.everywhere)
        longest = task.max_steps * task.dt
        if self.horizon is not None and self.horizon > longest:
            raise BadInput(
                f"horizon {self.horizon:g} s cannot be used: give at most {longest:g} s, the length of an "
                f"episode of {task.name}"
            )
        trainings = [t for t in (self.stage1, self.stage6) if isinstance(t, Training)]
        for name in {training.algorithm for training in trainings} & set(ALGORITHMS):
            algorithms.check(name, task.name, task.learning.levels)
        for count in (self.cells, self.rods):
            covering(task.chart, count)
        if self.lattice and task.chart.dimension < 3:
            Grid.with_cells(task.chart, CELLS.checked("lattice", self.lattice))
