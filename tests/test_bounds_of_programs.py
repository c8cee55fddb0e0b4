"""Random programs stay within their bounds, NaN and infinity included: a seed is a program."""

import os

import numpy as np
import pytest

from hyrl_mj.errors import BadInput
from hyrl_mj.judging.proof.affine import Affine, Unbounded
from hyrl_mj.judging.proof.rules import Truth, bounds
from hyrl_mj.tracing import BATCH, trace

# Number of programs; more of them by HYRL_MJ_PROGRAMS=20000.
PROGRAMS = int(os.environ.get("HYRL_MJ_PROGRAMS", "600"))
BOXES, POINTS, DEPTH = 40, 12, 5

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


def check(function, centre, half, rng):
    """Asserts that what NumPy gives in boxes lies within the bounds."""
    program = trace(function, {"x": rng.normal(size=(BATCH, 3))}, "f", "bounded")
    # Points of a box are off by a rounding error; those of cells are widened, too.
    found = bounds(program, Affine.box(centre, half + 1e-12))
    for k in range(POINTS):
        shares = rng.uniform(-1, 1, centre.shape)
        x = centre + half * (shares if k % 3 else np.sign(shares))
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


@pytest.mark.parametrize("part", range(4))
def test_random_programs_stay_within_their_bounds(part):
    bounded, undefined, sharp = 0, 0, 0
    for seed in range(part, PROGRAMS, 4):
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
    assert bounded > 0.8 * PROGRAMS / 4
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
