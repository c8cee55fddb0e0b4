"""Bounds over boxes: whatever code, network or set says inside of a box lies within what was bounded.

Random programs do so, too, NaN and infinity included: a seed is a program.
"""

import copy
import os

import numpy as np
import pytest
from planted import AnalyticSet
from test_export import WHOLE

from hyrl_mj.errors import BadInput
from hyrl_mj.judging.game import Lattice
from hyrl_mj.judging.proof.affine import Affine, Unbounded
from hyrl_mj.judging.proof.answers import BoundedAnswers, Boxes
from hyrl_mj.judging.proof.assumptions import check_assumptions
from hyrl_mj.judging.proof.cells import Cells
from hyrl_mj.judging.proof.networks import BoundedPolicy
from hyrl_mj.judging.proof.rules import RULES, Truth, bounds
from hyrl_mj.policies import (
    ACTIVATIONS,
    HybridController,
    MlpPolicy,
    Normalization,
    PreprocessedPolicy,
    Preprocessing,
)
from hyrl_mj.sets import Everything, Grid, GridSet
from hyrl_mj.tasks import Outcome, get_task
from hyrl_mj.tracing import BATCH, trace

RNG = np.random.default_rng
# Functions of the export that have no bounds, and what their messages name.
REFUSED = {
    "remainder": "remainder with a divisor",
    "negative divisor": "remainder with a divisor",
    "sqrt and power": "the exponent 0.3",
    "argmax": "argmax",
    "take": "looks up values",
}


def inside(centre, half, rng, draws=20):
    """Points in boxes, their corners among them."""
    for draw in range(draws):
        shares = rng.uniform(-1, 1, centre.shape)
        yield centre + half * (np.sign(shares) if draw % 4 == 0 else shares)


def check(function, centre, half, rng):
    """Asserts that a function stays within its bounds over boxes; returns these."""
    program = trace(function, {"x": rng.normal(size=(BATCH, centre.shape[1]))}, "f", "bounded")
    # Points of a box are off by a rounding error; those of cells are widened, too.
    found = bounds(program, Affine.box(centre, half + 1e-12))
    for x in inside(centre, half, rng, 12):
        with np.errstate(all="ignore"):
            y = np.asarray(function(x))
        if isinstance(found, Truth):
            assert not (y & ~found.possibly).any(), "true where it is not possible"
            assert not (~y & found.surely).any(), "false where it is sure"
            continue
        nan = np.isnan(y)
        assert not (nan & ~found.nan).any(), "NaN where it is not possible"
        outside = ~nan & ((y < found.low) | (y > found.high))
        assert not outside.any(), (y[outside], found.low[outside], found.high[outside])
        assert not (~nan & found.nonnegative & (y < 0)).any()
    return found


@pytest.mark.parametrize("name", [name for name in WHOLE if name not in REFUSED])
def test_code_stays_within_its_bounds(name):
    rng = RNG(0)
    for size in (0.01, 0.5):
        check(WHOLE[name], rng.normal(size=(100, 3)), np.full(3, size), rng)


@pytest.mark.parametrize("name", REFUSED)
def test_code_without_bounds_is_refused_with_its_operation(name):
    program = trace(WHOLE[name], {"x": RNG(0).normal(size=(BATCH, 3))}, "f")
    with pytest.raises(Unbounded, match=REFUSED[name]):
        bounds(program, Affine.box(np.ones((5, 3)), np.ones(3)))


def test_there_is_a_rule_for_every_operation_that_is_not_refused():
    from hyrl_mj.tracing.vocabulary import REDUCTIONS, UFUNCS

    others = {"where", "astype", "concatenate", "reshape", "transpose", "take", "full"}
    assert {*UFUNCS, *REDUCTIONS, *others} - RULES.keys() == {"argmax", "argmin", "arctan"}


@pytest.mark.parametrize("name", ["vehicle", "unit_circle", "rover", "quadrotor"])
@pytest.mark.parametrize("method", ["observation", "ending", "verdict", "z"])
def test_tasks_stay_within_their_bounds(name, method):
    task, rng = get_task(name), RNG(1)
    p = task.measurement_columns
    low, high = (np.resize(end, p) for end in (task.chart.low, task.chart.high))
    check(getattr(task, method), rng.uniform(low, high, (500, p)), np.full(p, 0.003), rng)


def test_what_is_left_of_a_smooth_function_falls_with_the_square_of_the_box(vehicle):
    rng = RNG(0)
    centre = rng.uniform((0, 0.9), (1, 1.4), (200, 2))
    rests = [
        check(vehicle.observation, centre, np.full(2, half), rng).remainder[:, 0].max()
        for half in (0.02, 0.01, 0.005)
    ]
    assert rests[0] / rests[1] == pytest.approx(4, rel=0.1)
    assert rests[1] / rests[2] == pytest.approx(4, rel=0.1)


# ---- random programs

# Number of programs; more of them by HYRL_MJ_PROGRAMS=20000.
PROGRAMS = int(os.environ.get("HYRL_MJ_PROGRAMS", "100"))
BOXES, DEPTH = 40, 5

ONE = (
    np.sqrt, np.log, np.exp, np.sin, np.cos, np.tanh, np.tan, np.absolute, np.negative, np.sign,
    np.floor, np.ceil, np.rint, np.trunc, np.square, np.reciprocal, np.arcsin, np.arccos, np.arctan,
    np.log1p, np.expm1, np.cosh, np.sinh, np.log2,
)  # fmt: skip
TWO = (
    np.add, np.subtract, np.multiply, np.divide, np.maximum, np.minimum, np.arctan2, np.hypot,
    np.fmax, np.fmin,
)  # fmt: skip
COMPARED = (np.less, np.less_equal, np.greater, np.greater_equal, np.equal, np.not_equal)
LOGICAL = (np.logical_and, np.logical_or, np.logical_xor)
# Numbers at the edges of domains.
EDGES = (0.0, -0.0, 1.0, -1.0, 0.5, 2.0, -2.5, np.pi, 1e-6, np.inf, -np.inf, np.nan)


def constant(rng):
    return float(rng.choice(EDGES[:9] if rng.random() < 0.9 else EDGES))


def number(rng, depth):
    """A random function from points (n, 3) to numbers (n,)."""
    kind = rng.choice(
        ["one", "two", "power", "where", "remainder", "reduced", "cast", "matrix", "single"],
        p=[0.3, 0.3, 0.08, 0.12, 0.06, 0.06, 0.02, 0.04, 0.02],
    )
    if depth == 0:
        column, c = int(rng.integers(3)), constant(rng)
        return (lambda x: x[:, column]) if rng.random() < 0.85 else (lambda x: x[:, 0] * 0 + c)
    a, b = number(rng, depth - 1), number(rng, int(rng.integers(depth)))
    match kind:
        case "one":
            function = ONE[rng.integers(len(ONE))]
            return lambda x: function(a(x))
        case "two":
            function, c = TWO[rng.integers(len(TWO))], constant(rng)
            other = (lambda x: c) if rng.random() < 0.3 else b
            return lambda x: function(a(x), other(x))
        case "power":
            exponent = float(rng.choice([2, 3, 4, -1, -2, 0.5]))
            return lambda x: a(x) ** exponent
        case "where":
            condition = truth(rng, depth - 1)
            return lambda x: np.where(condition(x), a(x), b(x))
        case "remainder":
            divisor = float(rng.choice([0.7, 1.0, 2 * np.pi]))
            return lambda x: np.remainder(a(x), divisor)
        case "reduced":
            name = rng.choice(["sum", "max", "min", "mean"])
            return lambda x: getattr(np, name)(np.stack([a(x), b(x)], axis=1), axis=1)
        case "cast":
            return lambda x: np.clip(a(x), -9, 9).astype(int) * 2
        case "matrix":
            matrix = rng.normal(size=(2, 1))
            return lambda x: (np.stack([a(x), b(x)], axis=1) @ matrix)[:, 0]
        case _:
            return lambda x: a(x).astype(np.float32) * 3 + 0.1


def truth(rng, depth):
    """A random condition on points (n, 3)."""
    compare, logical = COMPARED[rng.integers(6)], LOGICAL[rng.integers(3)]
    a, b, c = number(rng, depth), number(rng, max(depth - 1, 0)), constant(rng)
    kind = rng.integers(6) if depth else 0
    if kind == 1:
        return lambda x: logical(compare(a(x), b(x)), a(x) > c)
    if kind == 2:
        return lambda x: ~compare(a(x), b(x))
    if kind == 3:
        return lambda x: np.isnan(a(x)) | np.isfinite(b(x))
    if kind == 4:
        return lambda x: np.stack([compare(a(x), c), b(x) > 0], axis=1).any(axis=1)
    if kind == 5:  # sums and products of conditions are conditions
        return lambda x: (a(x) > c) + (b(x) > 0) * (a(x) < b(x)) == True  # noqa: E712
    return lambda x: compare(a(x), b(x) if c < 0 else c)


def drawn_boxes(rng):
    """Centres (n, 3) and half sides (n, 3) of boxes: wide and narrow ones, points, some around zero."""
    centre = rng.uniform(-3, 3, (BOXES, 3)) * (rng.random((BOXES, 3)) < 0.85)
    half = rng.choice([0.0, 1e-9, 1e-3, 0.05, 1.0], (BOXES, 1)) * rng.random((BOXES, 3))
    return centre, half


@pytest.mark.slow
def test_random_programs_stay_within_their_bounds():
    bounded, undefined, sharp = 0, 0, 0
    for seed in range(PROGRAMS):
        rng = np.random.default_rng(seed)
        depth = int(rng.integers(1, DEPTH))
        function = (truth if seed % 3 == 0 else number)(rng, depth)
        try:
            found = check(function, *drawn_boxes(rng), rng)
        except (Unbounded, BadInput):
            continue
        except AssertionError as error:
            raise AssertionError(f"program {seed}: {error}") from error
        bounded += 1
        if isinstance(found, Truth):
            sharp += (found.surely == found.possibly).any()
        else:
            undefined += found.nan.any()
            sharp += (np.isfinite(found.radius) & ~found.nan).any()
    assert bounded > 0.8 * PROGRAMS
    assert sharp > 0.5 * bounded, "bounds tell something"
    assert undefined > 0.1 * bounded


@pytest.mark.parametrize(
    ("condition", "sure"),
    [
        (lambda x: x[:, 1] <= np.sqrt(x[:, 0]), False),
        (lambda x: ~(x[:, 1] > np.sqrt(x[:, 0])), True),
        (lambda x: x[:, 1] != np.sqrt(x[:, 0]), True),
        (lambda x: x[:, 1] <= np.arcsin(x[:, 0] - 1), False),
        (lambda x: x[:, 1] <= np.maximum(np.sqrt(x[:, 0]), 9), False),
        (lambda x: x[:, 1] <= np.fmax(np.sqrt(x[:, 0]), -9), False),
    ],
)
def test_a_comparison_with_nan_is_false(condition, sure):
    centre, half = np.array([[-2.0, -1.0, 0.0]]), np.full((1, 3), 0.1)
    found = check(condition, centre, half, np.random.default_rng(0))
    assert bool(found.surely[0]) == sure


def test_a_distance_is_never_nan():
    """A square is no less than 0, though its bounds are."""
    rng = np.random.default_rng(0)
    centre, half = rng.uniform(-0.1, 0.1, (200, 3)), np.full((200, 3), 0.1)
    for distance in (
        lambda x: np.sqrt((x * x).sum(axis=1)),
        lambda x: np.linalg.norm(x, axis=1),
        lambda x: np.hypot(x[:, 0], x[:, 1] ** 2),
    ):
        assert not check(distance, centre, half, rng).nan.any()


@pytest.mark.parametrize(
    ("code", "says"),
    [
        (lambda x: np.sqrt(x[:, 0]).astype(int), "may be NaN or infinite"),
        (lambda x: (x[:, 0] * 1e12).astype(np.int32), "may be too large"),
        (lambda x: (x[:, 0] * 1e6).astype(np.int64) ** 4, "may be too large"),
    ],
)
def test_integers_that_numpy_cannot_hold_are_refused(code, says):
    program = trace(code, {"x": np.ones((BATCH, 3))}, "f", "bounded")
    with pytest.raises(Unbounded, match=says):
        bounds(program, Affine.box(np.zeros((5, 3)), np.ones(3)))


# ---- networks


def network(task, activation="tanh", hidden=16, outputs=None, seed=0, scale=2.0):
    """A network with random weights."""
    rng, k = RNG(seed), len(task.observation_low)
    n = outputs or (len(task.inputs) if task.input_levels is None else len(task.input_levels))
    sizes = {
        "mlp_extractor.policy_net.0": (hidden, k),
        "mlp_extractor.policy_net.2": (hidden, hidden),
    }
    weights = {}
    for stem, (rows, columns) in (sizes | {"action_net": (n, hidden)}).items():
        normal = rng.normal(size=(rows, columns)) * scale / np.sqrt(columns)
        weights[f"{stem}.weight"] = normal.astype(np.float32)
        weights[f"{stem}.bias"] = rng.normal(size=rows).astype(np.float32)
    return MlpPolicy(task, "ppo", activation, weights)


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_the_levels_that_a_network_chooses_in_a_box_are_among_those_that_are_possible(
    vehicle, activation
):
    policy, rng = network(vehicle, activation), RNG(0)
    centre = rng.uniform(vehicle.chart.low, vehicle.chart.high, (300, 2))
    for size in (0.1, 0.002):
        possible = BoundedPolicy.from_policy(policy).levels(centre, np.full(2, size))
        chosen = np.zeros_like(possible)
        for x in inside(centre, size, rng, 40):
            u = policy.act(x)[:, 0]
            level = np.abs(u[:, None] - vehicle.input_levels[:, 0]).argmin(axis=1)
            chosen[np.arange(len(u)), level] = True
        assert not (chosen & ~possible).any()
    assert (possible.sum(axis=1) == 1).mean() > 0.9, "small boxes have one answer"


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_the_inputs_that_a_network_gives_in_a_box_lie_between_its_ends(circle, activation):
    policy, rng = network(circle, activation), RNG(0)
    centre = rng.uniform(0, 2 * np.pi, (300, 1))
    for half in (0.001, 0.05):
        low, high = np.moveaxis(
            BoundedPolicy.from_policy(policy).inputs(centre, np.array([half])), 1, 0
        )
        for x in inside(centre, half, rng):
            u = policy.act(x)
            assert ((low <= u) & (u <= high)).all()
    # The ends are no farther apart than the policy is steep, but for a remainder.
    steep = np.abs(np.diff(policy.act(np.linspace(0, 2 * np.pi, 20_000)[:, None])[:, 0])).max()
    narrow = np.ptp(
        BoundedPolicy.from_policy(policy).inputs(centre, np.array([1e-3])), axis=1
    ).max()
    assert narrow <= 2.5 * steep * 1e-3 / (np.pi / 20_000) + 1e-4


def test_a_normalised_observation_is_bounded_too(vehicle):
    statistics = Normalization(np.array([1.0, 2.0, 0.1]), np.array([0.5, 0.7, 0.2]), 1.5)
    policy = PreprocessedPolicy(network(vehicle), Preprocessing(statistics))
    rng = RNG(0)
    centre = rng.uniform(vehicle.chart.low, vehicle.chart.high, (300, 2))
    possible = BoundedPolicy.from_policy(policy).levels(centre, np.full(2, 0.02))
    for x in inside(centre, 0.02, rng):
        level = np.abs(policy.act(x) - vehicle.input_levels[:, 0]).argmin(axis=1)
        assert possible[np.arange(len(x)), level].all()


def test_the_observation_of_a_task_that_builds_on_another_is_bounded(vehicle):
    class Own(type(vehicle)):
        def observation(self, measured):
            return super().observation(measured) * 1.0

    policy, own = network(vehicle), network(vehicle)
    object.__setattr__(own, "task", Own())
    centre = RNG(0).uniform(vehicle.chart.low, vehicle.chart.high, (300, 2))
    expected, found = (
        BoundedPolicy.from_policy(p).levels(centre, np.full(2, 0.02)) for p in (policy, own)
    )
    assert not (expected & ~found).any()
    assert (expected != found).mean() < 0.01


def test_what_is_no_network_is_refused(vehicle):
    with pytest.raises(Unbounded, match="a policy that is a PreprocessedPolicy"):
        BoundedPolicy.from_policy(PreprocessedPolicy(network(vehicle), Preprocessing(None, 2)))


@pytest.mark.parametrize("operation", ["sort", "argmax"])
def test_an_observation_without_bounds_is_told_with_its_operation(vehicle, operation):
    class Ordered(type(vehicle)):
        def observation(self, measured):
            return getattr(np, operation)(measured, axis=1).reshape(len(measured), -1)[
                :, :1
            ] * np.ones(3)

    policy = network(vehicle)
    object.__setattr__(policy, "task", Ordered())
    message = rf"the method observation of vehicle cannot be bounded: it uses np\.{operation}"
    with pytest.raises(Unbounded, match=message):
        BoundedPolicy.from_policy(policy).levels(np.zeros((3, 2)), np.full(2, 0.1))


# ---- sets and cells


@pytest.fixture(scope="module")
def cells(vehicle):
    return Cells.cover(Lattice.tabulate(vehicle, Grid.with_cells(vehicle.chart, 120)))


@pytest.fixture(scope="module")
def ring(circle):
    return Cells.cover(Lattice.tabulate(circle, Grid.with_cells(circle.chart, 600)))


def test_the_distances_of_a_set_in_a_box_are_those_of_points_in_it(vehicle, circle, cells, ring):
    for task, of, count in ((vehicle, cells, 70), (vehicle, cells, 400), (circle, ring, 2880)):
        grid, rng = Grid.with_cells(task.chart, count), RNG(2)
        near = np.abs(grid.nodes - grid.nodes[len(grid.nodes) // 3]).max(axis=1) < 0.4
        members = GridSet.from_mask(grid, near ^ (rng.random(len(grid.nodes)) < 0.01))
        boxes = Boxes.around(of, task.noise_in_chart(0.1))
        least, greatest = boxes.distances(members)
        index = np.stack(np.unravel_index(np.arange(least.size), boxes.counts), axis=-1)
        for _ in range(20):
            z = boxes.low + boxes.step * (index + rng.uniform(0, 1, index.shape))
            found = members.signed_distance(z).reshape(least.shape)
            assert (least <= found).all()
            assert (found <= greatest).all()
        assert np.median(greatest - least) < 3 * np.linalg.norm(boxes.step), "and no farther apart"
    with pytest.raises(Unbounded, match="a AnalyticSet cannot be bounded"):
        boxes.distances(AnalyticSet(np.sin))
    assert np.isneginf(boxes.distances(Everything())[1]).all()


@pytest.mark.parametrize("which", ["vehicle", "unit_circle"])
def test_a_cell_moves_onto_cells_that_hold_whatever_the_plant_does(which, cells, ring):
    of, rng = (cells if which == "vehicle" else ring), RNG(3)
    task, n = of.lattice.task, 1_000
    start = rng.choice(np.flatnonzero(of.running), n)
    z = of.middle(start) + rng.uniform(-0.5, 0.5, (n, len(of.counts))) * of.lattice.grid.spacing
    low, high = task.input_limits
    u = rng.uniform(low, high, (n, len(low)))
    if task.input_levels is not None:
        u = task.input_levels[rng.integers(len(task.input_levels), size=n)]
    plant = task.plant(n)
    plant.set_state(*task.state(z))
    plant.step(u)
    after = plant.measurement
    first, last = of.shifts(u, u)
    assert (last - first <= (0 if which == "vehicle" else 1)).all(), "and onto no other"
    ending = task.ending(after)
    for k in range(n):
        shifts = {tuple(first[k]), tuple(last[k])}
        places = {int(of.after(np.array(shift))[start[k]]) for shift in shifts}
        if ending[k] == Outcome.RUNNING and task.chart.contains(after[k : k + 1])[0]:
            assert int(of.place(after[k : k + 1])[0]) in places
        elif ending[k] == Outcome.REACHED:
            assert places == {of.nodes}
        else:
            assert places <= {of.nodes + 1} | set(np.flatnonzero(of.failed).tolist())


@pytest.mark.parametrize("which", ["vehicle", "unit_circle"])
def test_answers_hold_all_that_a_controller_does_under_noise(which, cells, ring):
    of, rng, n = (cells if which == "vehicle" else ring), RNG(6), 5_000
    task = of.lattice.task
    grid = Grid.with_cells(task.chart, 60)
    first = grid.nodes[:, -1] < grid.nodes[:, -1].mean() + 0.1
    sets = {0: GridSet.from_mask(grid, first), 1: GridSet.from_mask(grid, ~first)}
    controller = HybridController(task, {q: network(task, seed=q) for q in (0, 1)}, sets)
    bound = task.noise_in_chart(0.1)
    answers = BoundedAnswers.enclose(of, controller, bound)
    place = rng.integers(of.nodes, size=n)
    for noise in (bound, 0 * bound):
        z = of.draw(place, rng) + noise * rng.choice([-1.0, 1.0, rng.uniform(-1, 1)], (n, 1))
        for before, possible in zip((0, 1, -1), answers.possible(noise), strict=True):
            found = {(mode, *shift): where for mode, shift, where in possible}
            q = controller.initial_mode(z) if before < 0 else np.full(n, before)
            u, after = controller.step(q, z)
            box = np.floor((task.chart.wrap(z) - answers.boxes.low) / answers.boxes.step).astype(
                int
            )
            assert answers.goes[(before, after, *box.T)].all()
            for k, *shifts in zip(range(n), *of.shifts(u, u), strict=True):
                assert all(found[after[k], *shift][place[k]] for shift in shifts)
            assert np.mean([where.mean() for where in found.values()]) < 0.6, "and little else"


def test_cells_fail_where_any_of_their_states_does(cells):
    task, rng = cells.lattice.task, RNG(4)
    for cell in rng.choice(cells.nodes, 300, replace=False):
        off = rng.uniform(-0.5, 0.5, (200, 2)) * cells.lattice.grid.spacing
        ends = task.ending(cells.middle(np.array([cell])) + off)
        assert cells.failed[cell] or (ends <= Outcome.REACHED).all()
    share = cells.failed.mean()
    nodes = cells.lattice.failed.mean()
    assert nodes < share < nodes + 0.06


def test_corners_and_neighbours_of_cells(cells, ring):
    for of in (cells, ring):
        nodes = np.ones(of.lattice.nodes, dtype=bool)
        nodes[7] = False
        touched = np.flatnonzero(of.some_corner(~nodes))
        assert (~of.all_corners(nodes) == of.some_corner(~nodes)).all()
        assert len(touched) == 2
        distance = of.lattice.grid.chart.difference(of.middle(touched), of.lattice.grid.nodes[7])
        np.testing.assert_allclose(np.abs(distance), np.tile(of.lattice.grid.spacing / 2, (2, 1)))
        all_but = np.ones(of.nodes, dtype=bool)
        all_but[touched[0]] = False
        around = np.flatnonzero(~of.all_around(all_but))
        assert 7 in around
        assert len(around) == 2 ** len(of.counts)


def test_a_plant_that_moves_states_differently_is_refused(vehicle):
    lattice = Lattice.tabulate(vehicle, Grid.with_cells(vehicle.chart, 60))
    object.__setattr__(lattice, "uneven", np.array([0.01, 0.0]))
    with pytest.raises(Unbounded, match="does not move all states alike"):
        Cells.cover(lattice)


def test_an_end_at_a_node_that_was_not_followed_is_noticed(vehicle):
    class Spot(type(vehicle)):
        def ending(self, measurement):
            ends = super().ending(measurement)
            if type(measurement) is np.ndarray:
                ends[(np.abs(measurement - [2.4, 0.8]) < 1e-3).all(axis=1)] = Outcome.CRASHED
            return ends

    lattice = Lattice.tabulate(Spot(), Grid.with_cells(vehicle.chart, 60))
    with pytest.raises(Unbounded, match=r"ending of .* another result at x = 2\.4 m, y = 0\.8 m"):
        Cells.cover(lattice)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"observation": lambda self, measured: np.hstack([measured, measured])},
            "method observation of .* tells whole turns of theta apart, or may do so: let it use the sine",
        ),
        ({"measure": lambda self, sensors: sensors + 0.1}, r"in methods of its own \(measure\)"),
        ({"z": lambda self, measured: 1.0 * measured}, r"in methods of its own \(z\)"),
    ],
)
def test_a_circle_that_cannot_be_covered_by_cells_is_told_why(circle, change, message):
    task = type("Changed", (type(circle),), change)()
    with pytest.raises(Unbounded, match=message):
        check_assumptions(task)


def test_constraints_have_to_be_switched_off(vehicle):
    class Constrained(type(vehicle)):
        @property
        def model(self):
            model = copy.copy(super().model)
            model.opt.disableflags = 0
            return model

    lattice = Lattice.tabulate(Constrained(), Grid.with_cells(vehicle.chart, 60))
    with pytest.raises(Unbounded, match='<flag constraint="disable"/>'):
        Cells.cover(lattice)


def test_the_inputs_of_a_box_move_cells_wherever_some_of_them_does(circle):
    """On a lattice on which full speed moves nodes onto nodes, speeds in between do not."""
    ring = Cells.cover(Lattice.tabulate(circle, Grid.with_cells(circle.chart, 1_256)))
    assert not ring.exact.any()
    first, last = ring.shifts(np.array([[0.3001]]), np.array([[0.3001]]))
    h = ring.lattice.grid.spacing[0]
    assert first[0, 0] * h <= 0.3001 * circle.dt <= last[0, 0] * h
    assert last[0, 0] > first[0, 0]
