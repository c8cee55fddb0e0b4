"""The worst-case game of one task: scores of controllers on the nodes, and the worst noise signals."""

from collections.abc import Iterable, Mapping
from functools import cached_property

import numpy as np

from hyrl_mj.errors import BadInput, unknown
from hyrl_mj.judging.game.adversary import WorstEstimate, WorstNoise
from hyrl_mj.judging.game.lattice import Lattice
from hyrl_mj.judging.game.limit import Limit
from hyrl_mj.judging.game.resolution import lattice_grid
from hyrl_mj.judging.game.result import LIMIT, MapClass, NodeScore
from hyrl_mj.judging.game.solver import NEVER, Answers, Moves, lasting, noisy_moves, solve
from hyrl_mj.policies import Controller, Policy, as_controller
from hyrl_mj.sets import Grid, GridSet
from hyrl_mj.simulation import LoopSettings, Recorded, Signal, closed_loop
from hyrl_mj.tasks import Task

# The bounds of the curve, as shares of the largest; and how large that is at least [chart units].
CURVE, LARGEST = tuple(k / 24 for k in range(25)), 0.3


def largest_bound(task: Task, eps: float, everywhere: bool) -> float:
    """Returns the largest noise bound of the curve of a run: three times its own, eps, or `LARGEST`.

    It is no more than 0.4 of the noisy sides of the chart, of which noise of 0.5 tells nothing.
    """
    share = task.noise_in_chart(1.0, everywhere)
    most = 0.4 * float((task.chart.sides[share > 0] / share[share > 0]).min())
    return max(eps, float(f"{min(max(3 * eps, LARGEST), most):.10g}"))


class Game:
    """The worst-case game of one task, for several controllers and any noise bound.

    Args:
        task: the robot and its problem.
        parts: M_i of each mode, or a `Partition`; the limit takes its sides from them.
        controllers: controllers or policies by name; each must be a pure function.
        largest: the largest noise bound that can be played.
        everywhere: whether noise acts on all coordinates, not only on the task's noisy ones.
        grid: nodes of the lattice, by default the finest.

    Raises:
        BadInput: the chart has more than three dimensions, the plant's state is more than the chart, or a
            controller gives inputs that cannot be applied.
    """

    def __init__(
        self,
        task: Task,
        parts: Iterable[GridSet],
        controllers: Mapping[str, Controller | Policy],
        largest: float = LARGEST,
        everywhere: bool = False,
        grid: Grid | None = None,
    ):
        self.task, self.everywhere, self.largest = task, everywhere, largest
        task.check_noise(largest, everywhere)
        if grid is None:
            Lattice.check(task)
            Lattice.check(task, grid := lattice_grid(task))
        self.lattice = Lattice.tabulate(task, grid)
        self.limit = Limit.solve(self.lattice, parts)
        self._noises: dict[tuple[str, float], Signal] = {}
        self._values: dict[tuple[str, float], np.ndarray] = {}
        most = self.bound(largest)
        self.controllers = {name: as_controller(loop) for name, loop in controllers.items()}
        self.answers = {
            name: Answers.ask(self.lattice, loop, most) for name, loop in self.controllers.items()
        }

    def bound(self, eps: float) -> np.ndarray:
        """Returns the noise bounds by coordinate (d,)."""
        return self.task.noise_in_chart(eps, self.everywhere)

    @cached_property
    def starts(self) -> np.ndarray:
        """(N,) bool, the nodes of the start region; where it lies between nodes, those next to starts."""
        grid, running = self.lattice.grid, self.lattice.running
        nodes = self.task.may_start(grid.nodes) & running
        if not nodes.any():
            drawn = self.task.starts(1_000, np.random.default_rng(0))
            nodes[grid.nearest(drawn)] = True
        return nodes & running

    def moves(self, name: str, eps: float) -> Moves:
        """Returns the adversary's moves against a controller, or against the limit."""
        if name not in (*self.answers, LIMIT):
            raise unknown("controller", name, (*self.answers, LIMIT))
        self.task.check_noise(eps, self.everywhere)
        if eps > self.largest + 1e-9:
            raise BadInput(
                f"noise {eps:g} exceeds the largest bound of this game, {self.largest:g}: "
                "create Game with a larger `largest`"
            )
        bound = self.bound(eps)
        return self.limit.moves(bound) if name == LIMIT else noisy_moves(self.answers[name], bound)

    def value(self, name: str, eps: float) -> np.ndarray:
        """Returns the game's value (modes + 1, places), the last row for runs that have not started.

        Only what happens within an episode counts: a value below `NEVER` is at most the task's `max_steps`.
        """
        known = self._values.get((name, eps))
        return self._value(name, self.moves(name, eps), eps) if known is None else known

    def winnable(self, eps: float) -> np.ndarray:
        """Returns the nodes (N,) bool where holding the way of the first measurement wins in time."""
        return self.limit.winnable(self.bound(eps))

    def score(self, name: str, eps: float) -> NodeScore:
        """Returns the score of a controller or of the limit on the nodes."""
        moves = self.moves(name, eps)
        value = self._value(name, moves, eps)[:, :-2]
        region = self.starts & self.winnable(eps)
        still = lasting(moves) & ~self.lattice.failed
        excursion = None
        if still.any():
            excursion = float(self.task.miss(self.lattice.grid.nodes[still]).max())
        winnable = float(region.sum() / max(self.starts.sum(), 1))
        return NodeScore(eps, winnable, *won_in(region, value, self.task.dt), excursion)

    def _value(self, name: str, moves: Moves, eps: float) -> np.ndarray:
        value = solve(moves, self.task.max_steps)
        if name == LIMIT:  # it holds the mode that it picks by the first measurement
            held = self.limit.held(self.bound(eps))
            value[-1, :-2] = np.where(held <= self.task.max_steps, held, NEVER)
        self._values[name, eps] = value
        return value

    def map(self, name: str, eps: float) -> np.ndarray:
        """Returns the `MapClass` (N,) of every node, as if nodes were all states."""
        value = self.value(name, eps)[:, :-2]
        classes = np.full(self.lattice.nodes, MapClass.BEATEN, dtype=np.int8)
        classes[value[-1] < NEVER] = MapClass.WON_FROM_SOME
        classes[(value < NEVER).all(axis=0)] = MapClass.WON
        classes[(classes == MapClass.BEATEN) & ~self.winnable(eps)] = MapClass.UNWINNABLE
        classes[~self.lattice.running] = MapClass.OVER
        return classes

    def margin(self, name: str, near: tuple[float, float] | None = None) -> float | None:
        """Returns the largest noise bound at which all winnable nodes of the start region are won.

        It is found by bisection to one cell of the lattice; None if some nodes are lost without noise.

        Args:
            name: the controller.
            near: bounds between which it probably lies, to begin with.
        """
        cell = float(self.lattice.grid.spacing[self.bound(1.0) > 0].min())

        def all_won(cells: int) -> bool:
            own = self.value(name, cells * cell)[-1, :-2]
            return share(own[self.starts & self.winnable(cells * cell)] < NEVER) == 1

        last = int(self.largest / cell + 1e-6)
        low, high = (min(round(eps / cell), last) for eps in near or (0.0, self.largest))
        if not all_won(low):
            low, high = 0, low
            if not low < high or not all_won(low):
                return None
        elif all_won(high):
            low, high = high, last
            if all_won(high):
                return high * cell
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (middle, high) if all_won(middle) else (low, middle)
        return low * cell

    def worst_noise(self, name: str, eps: float) -> Signal:
        """Returns the adversary's noise, to simulate with."""
        if (name, eps) not in self._noises:
            answers, bound = self.answers[name], self.bound(eps)
            self._noises[name, eps] = (
                WorstEstimate(self.lattice, answers.modes, self.value(name, eps), bound)
                if self.lattice.estimate
                else WorstNoise(answers, bound)
            )
        return self._noises[name, eps]


def share(won: np.ndarray) -> float:
    """Returns the share of (n,) bool that is true; 0 if n is 0, as nothing is won where nothing can be."""
    return float(won.mean()) if len(won) else 0.0


def won_in(region: np.ndarray, value: np.ndarray, dt: float) -> tuple[float, float, float, float]:
    """Returns what is won of a region (N,) bool by a value of the game (modes + 1, N).

    These are the shares that are won if the controller picks its start mode, and from every start mode; and
    the latest arrivals [s] from these.
    """
    own, worst = value[-1, region], value[:-1, region].max(axis=0, initial=0)
    latest, latest_any = (float(x[x < NEVER].max(initial=0) * dt) for x in (own, worst))
    return share(own < NEVER), share(worst < NEVER), latest, latest_any


def worst_signal(
    game: Game,
    name: str,
    z0: np.ndarray,
    eps: float,
    q0: int | None = None,
    steps: int | None = None,
) -> Recorded:
    """Returns the worst noise signal against a controller from starts (n, d), sample by sample.

    `simulate` with this signal from the same starts gives the runs of the game. The signal has a number of
    steps, by default the task's limit.
    """
    noise = game.worst_noise(name, eps)
    modes = None if q0 is None else np.full(len(z0), q0)
    loop, settings = game.controllers[name], LoopSettings(steps=steps, record=True)
    rollout = closed_loop(game.task, loop, z0, noise, modes, settings=settings)
    if not len(rollout.measured):  # all runs are over where they start
        none = np.zeros((1, len(z0), game.task.measurement_columns))
        return Recorded(none, eps, kind="worst", after="none")
    chart = game.task.chart
    rows = [
        (measured, chart.near(z, game.task.z(measured)))
        for measured, z in zip(rollout.measured, rollout.path[:-1], strict=True)
    ]
    true = np.stack([game.task.with_z(measured, z) for measured, z in rows])
    values = np.where(np.isnan(rollout.u).any(axis=-1)[..., None], 0.0, rollout.measured - true)
    limits = noise.limits
    # The differences are rounded; and a run of a replay that goes on after those of the game has no noise.
    values = np.clip(values, -limits, limits)
    return Recorded(values, eps, kind="worst", after="none", shares=limits / (eps or 1.0))
