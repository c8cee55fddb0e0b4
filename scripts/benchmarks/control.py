"""What a controller costs at run time, and what the package costs before it does anything."""

from collections.abc import Callable, Iterator
from itertools import pairwise

import numpy as np

from benchmarks import Figure
from benchmarks.runs import Runs, child
from hyrl_mj import Run, get_task
from hyrl_mj.fields import for_posts
from hyrl_mj.learning.training import build
from hyrl_mj.tasks import LEFT, RIGHT, Field

MANY, REPEATS = 100_000, 2_000


def figures(runs: Runs) -> Iterator[Figure]:
    """One state, many states; import and help."""
    for name in ("vehicle", "unit_circle"):
        run = runs.load(name)
        against = "SB3's predict on one observation"
        target = ">= 2x, <= 40 us"
        one, other = _step(run, 1, REPEATS), _predict(run)
        yield Figure(f"controller.step, {name}, one state", "us", against, target, one, other)
        many = _step(run, MANY, 1)
        yield Figure(f"controller.step, {name}, {MANY:,} states", "ms", "", "<= 100 ms", many)
    name = "controller.step, a field of 12 posts, one state"
    yield Figure(name, "us", "", "<= 1000 us", _steps_in_field(12))
    ours, other = _python("import hyrl_mj"), _python("import mujoco, gymnasium")
    target = "<= 1.15x the time, ratio >= 0.87"
    yield Figure("import hyrl_mj", "s", "import mujoco, gymnasium", target, ours, other, least=0.0)
    show = _python("from hyrl_mj.cli import main; main()", "--help")
    yield Figure("hyrl-mj --help", "s", "", "<= 0.5 s", show, least=0.0)


def _step(run: Run, n: int, repeats: int) -> Callable[[], int]:
    task, controller, rng = run.task, run.controller, np.random.default_rng(0)
    z = rng.uniform(task.chart.low, task.chart.high, (n, task.chart.dimension))
    plant = task.plant(n)
    plant.set_state(task.state(z)[0])
    measured, q = plant.measurement, rng.choice(controller.modes, n)

    def work() -> int:
        for _ in range(repeats):
            controller.step(q, measured)
        return repeats

    return work


def _steps_in_field(posts: int) -> Callable[[], int]:
    """Returns the steps of one robot at 50 places in a field of so many posts."""
    field, network = get_task("field"), _Network(17, 2)
    assert isinstance(field, Field)
    controller = for_posts(field, {LEFT: network, RIGHT: network}, 0.1, posts)
    task, rng = controller.task, np.random.default_rng(0)
    x, y, heading = rng.uniform(-10, 0, 50), rng.uniform(-4, 4, 50), rng.uniform(-3, 3, 50)
    plant = task.plant(50)
    plant.set_state(*task.state(np.column_stack([x, y, heading])))
    measured = plant.measurement
    q = controller.initial_mode(measured)
    rows = [(q[i : i + 1], measured[i : i + 1]) for i in range(50)]

    def work() -> int:
        for q, measured in rows:
            controller.step(q, measured)
        return len(rows)

    return work


class _Network:
    """A network of the size that stage 6 trains."""

    def __init__(self, inputs: int, outputs: int):
        rng = np.random.default_rng(0)
        sizes = inputs, 64, 64, outputs
        self.layers = [rng.normal(0, 0.1, pair) for pair in pairwise(sizes)]

    def inputs(self, observation: np.ndarray) -> np.ndarray:
        """Returns inputs (n, m) for observations (n, k)."""
        for layer in self.layers:
            observation = np.tanh(observation @ layer)
        return observation


def _predict(run: Run) -> Callable[[], int]:
    model = build(run.task, run.settings.stage1, 0, start_from=run.policy)
    observation = model.observation_space.sample()

    def work() -> int:
        for _ in range(REPEATS):
            model.predict(observation, deterministic=True)
        return REPEATS

    return work


def _python(code: str, *arguments: str) -> Callable[[], int]:
    def work() -> int:
        child(["-c", code, *arguments])
        return 1

    return work
