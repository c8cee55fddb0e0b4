"""An exported controller does what the controller does, in both forms."""

import copy
import re
import sys
import threading
import time
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from runpy import run_path
from types import ModuleType

import numpy as np
import onnxruntime
import pytest
from command_line import python
from numpy import empty
from planted import AnalyticSet, Cube, Hall, ideal_controller, random_states
from scipy import special

import hyrl_mj
from hyrl_mj import BadInput, HybridController, MlpPolicy, export_numpy, export_onnx
from hyrl_mj.export import FORMS, files_of
from hyrl_mj.export.graph import write_graph
from hyrl_mj.export.source import write_function
from hyrl_mj.policies import ACTIVATIONS
from hyrl_mj.sets import Cloud, Everything, Grid, GridSet
from hyrl_mj.tracing import BATCH, trace

RNG = np.random.default_rng


def network(task, seed=0, activation="relu", kind=MlpPolicy):
    """A network with random weights, large enough that it answers differently from place to place."""
    rng, outputs = RNG(abs(seed)), task.learning.levels or len(task.inputs)
    sizes = [(32, len(task.observation_low)), (32, 32), (outputs, 32)]
    names = ("q_net.q_net.0.", "q_net.q_net.2.", "q_net.q_net.4.") if task.learning.levels else (
        "mlp_extractor.policy_net.0.", "mlp_extractor.policy_net.2.", "action_net.",
    )  # fmt: skip
    weights = {}
    for name, size in zip(names, sizes, strict=True):
        weights[f"{name}weight"] = rng.normal(size=size).astype(np.float32) / np.sqrt(size[1])
        weights[f"{name}bias"] = rng.normal(size=size[0]).astype(np.float32)
    return kind(task, "dqn" if task.learning.levels else "ppo", activation, weights)


def smooth_set(task, k, modes):
    """A set whose edge winds through the chart; `modes` of them overlap and cover it."""
    grid = Grid.with_cells(task.chart, 60)
    angle = (2 * np.pi * (grid.nodes - task.chart.origin) / task.chart.sides).sum(axis=1)
    return GridSet(grid, -np.cos(angle - 2 * np.pi * k / modes) - 0.2)


def planted(task, modes=(0, 1), **options):
    """A controller with random networks."""
    return HybridController(
        task,
        {q: network(task, seed=q, **options) for q in modes},
        {q: smooth_set(task, k, len(modes)) for k, q in enumerate(modes)},
    )


def as_numpy(controller, folder):
    path, _ = export_numpy(controller, folder)
    space = {"__file__": str(path)}
    exec(compile(path.read_text(), path, "exec"), space)
    return space["step"], space["initial_mode"]


def as_onnx(controller, folder):
    path = export_onnx(controller, folder / "controller.onnx")
    session = onnxruntime.InferenceSession(path)

    def step(q, measured):
        return session.run(None, {"q": q, "measured": measured})

    return step, lambda measured: step(np.full(len(measured), -1), measured)[1]


@pytest.fixture(params=(as_numpy, as_onnx), ids=("numpy", "onnx"))
def exported(request, tmp_path):
    """Returns an exported controller: its step and initial_mode."""
    return lambda controller: request.param(controller, tmp_path)


def assert_same(controller, exported, measured, tolerance=1e-6):
    step, initial_mode = exported
    q = RNG(1).choice(controller.modes, len(measured))
    (u, after), (exported_u, exported_after) = controller.step(q, measured), step(q, measured)
    assert exported_u.dtype == np.float64
    assert exported_after.dtype == np.int64
    np.testing.assert_array_equal(exported_after, after)
    np.testing.assert_allclose(exported_u, u, rtol=0, atol=tolerance)
    np.testing.assert_array_equal(initial_mode(measured), controller.initial_mode(measured))
    return u, q, after


# ---- agreement


def test_it_agrees_on_ten_thousand_states(task, exported):
    controller = planted(task)
    # Beyond the ends of the chart, too, and for the circle any winding.
    measured = random_states(task, 10_000, RNG(0)) * 1.5 - 0.25 * task.chart.sides
    u, q, after = assert_same(controller, exported(controller), measured)
    assert 0.05 < (q != after).mean() < 0.95
    assert len(np.unique(u)) > 2


@pytest.mark.parametrize("modes", [(1, 4, 7), (1, 4, 6, 9), (0, 1, 3, 7, 32)])
def test_three_modes_and_more_jump_to_the_deepest(modes, circle, exported):
    controller = planted(circle, modes=modes)
    _, q, after = assert_same(controller, exported(controller), random_states(circle, 2000, RNG(0)))
    assert {(a, b) for a, b in zip(q, after, strict=True) if a != b} == {
        (a, b) for a in modes for b in modes if a != b
    }


def test_it_begins_by_start_sets_where_there_are_some(vehicle, exported):
    controller = planted(vehicle)
    coarse = Grid.with_cells(vehicle.chart, 10)
    upper = GridSet(coarse, 0.3 - coarse.nodes[:, 1])
    controller = replace(controller, starts={0: upper, 1: ~upper})
    measured = random_states(vehicle, 2000, RNG(0))
    assert_same(controller, exported(controller), measured)
    by_flow = replace(controller, starts=None).initial_mode(measured)
    assert 0.05 < (controller.initial_mode(measured) != by_flow).mean() < 0.95


def test_on_the_edge_it_flows(vehicle, exported):
    grid = Grid(vehicle.chart, (2, 2))
    ramp = GridSet(grid, grid.nodes[:, 1].copy())  # its edge is y = 0, to the bit at the middle
    controller = HybridController(
        vehicle, {q: network(vehicle, q) for q in (0, 1)}, {0: ramp, 1: ~ramp}
    )
    near = np.array([0.0, 5e-10, -5e-10, 2e-9, -2e-9])
    measured = np.column_stack([np.ones(5), near])
    step, _ = exported(controller)
    for q in (0, 1):
        modes = np.full(5, q)
        np.testing.assert_array_equal(step(modes, measured)[1], controller.step(modes, measured)[1])


@pytest.mark.parametrize("d", [3, 4])
def test_charts_of_more_dimensions(d, exported):
    cube = Cube(lambda z: z[:, 0], d)
    cube.observation_low, cube.observation_high = (-1.0,) * d, (1.0,) * d
    grid = Grid.with_cells(cube.chart, 6)
    held = [GridSet(grid, RNG(k).normal(size=len(grid.nodes)) - 0.3) for k in (0, 1)]
    controller = HybridController(
        cube, {q: network(cube, q) for q in (0, 1)}, dict(enumerate(held))
    )
    assert_same(controller, exported(controller), random_states(cube, 2000, RNG(0)) * 1.2)


@pytest.mark.slow
def test_sets_on_scattered_nodes_go_to_numpy(tmp_path):
    hall = Hall()
    hall.observation_low, hall.observation_high = (-1.0,) * 6, (1.0,) * 6
    cloud = Cloud.even(hall.chart, 2_000, np.array(hall.noisy))
    lower = GridSet.from_mask(cloud, hall.level(cloud.nodes) <= 0)
    sets = {0: (~lower).dilated(0.1), 1: lower.dilated(0.1)}
    controller = HybridController(hall, {q: network(hall, q) for q in (0, 1)}, sets)
    module, _ = export_numpy(controller, tmp_path)
    exported = run_path(str(module))
    measured = random_states(hall, 300, RNG(0)) * 1.1
    q = RNG(1).choice(2, 300)
    for found, right in zip(
        exported["step"](q, measured), controller.step(q, measured), strict=True
    ):
        np.testing.assert_allclose(found, right, atol=1e-5)
    assert (exported["step"](q, measured)[1] != q).mean() > 0.2
    with pytest.raises(BadInput, match="export to numpy instead"):
        export_onnx(controller, tmp_path / "hall.onnx")


def test_one_mode_without_an_edge(circle, exported):
    controller = HybridController(circle, {0: network(circle)}, {0: Everything()})
    assert_same(controller, exported(controller), random_states(circle, 100, RNG(0)))


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_activations(activation, circle, exported):
    controller = planted(circle, activation=activation)
    assert_same(controller, exported(controller), random_states(circle, 500, RNG(0)), 1e-5)


class Squashed(MlpPolicy):
    """Its output goes through tanh and is stretched to the limits."""

    @property
    def output(self):
        return "squash"

    def inputs(self, observation):
        low, high = self.task.input_limits
        return low + (np.tanh(self.outputs(observation).astype(float)) + 1) / 2 * (high - low)


def test_an_output_that_is_squashed(circle, exported):
    controller = planted(circle, kind=Squashed)
    u, _, _ = assert_same(controller, exported(controller), random_states(circle, 2000, RNG(0)))
    assert (np.abs(u) < 1).mean() > 0.5


def test_a_task_of_the_user_s(puck, exported):
    controller = planted(puck)
    measured = RNG(0).uniform(-1, 1, (2000, puck.measurement_columns))
    assert_same(controller, exported(controller), measured)


# ---- what it says to bad values


def test_the_folder_refuses_what_the_controller_refuses(vehicle, tmp_path):
    step, initial_mode = as_numpy(planted(vehicle), tmp_path)
    with pytest.raises(ValueError, match="not finite"):
        step(np.array([0]), np.array([[np.nan, 0.0]]))
    with pytest.raises(ValueError, match=r"modes \[3\] are unknown"):
        step(np.array([3]), np.zeros((1, 2)))
    with pytest.raises(ValueError, match="as many modes"):
        step(np.array([0, 1]), np.zeros((1, 2)))
    with pytest.raises(ValueError, match=r"shape \(n, 2\)"):
        initial_mode(np.zeros(2))


def test_the_graph_answers_what_is_not_finite_with_nan(task, tmp_path):
    step, _ = as_onnx(planted(task), tmp_path)
    measured = random_states(task, 3, RNG(0))
    measured[:2, -1] = np.nan, np.inf
    u, after = step(np.array([0, 1, 0]), measured)
    assert np.isnan(u).all(axis=1).tolist() == [True, True, False]
    assert after[:2].tolist() == [0, 1]


def test_the_graph_says_what_it_is_of(vehicle, tmp_path):
    path = export_onnx(planted(vehicle), tmp_path / "vehicle.onnx")
    session = onnxruntime.InferenceSession(path)
    assert session.get_modelmeta().custom_metadata_map == {
        "task": "vehicle", "modes": "0, 1", "inputs": "lateral_velocity [m/s]", "sample_time": "0.05"
    }  # fmt: skip
    assert [(i.name, i.shape) for i in session.get_inputs()] == [
        ("q", ["n"]), ("measured", ["n", 2])
    ]  # fmt: skip


ALONE = """
import sys
from importlib.abc import MetaPathFinder
import numpy as np

class Refuse(MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] not in {"controller", "numpy", *sys.stdlib_module_names}:
            raise ImportError(name + " is not here")

sys.meta_path.insert(0, Refuse())
import controller
measured = np.load("measured.npy")
q = controller.initial_mode(measured)
np.savez("answer.npz", *controller.step(1 - q, measured))
"""


def test_the_folder_needs_numpy_alone(vehicle, tmp_path):
    controller = planted(vehicle)
    written = export_numpy(controller, tmp_path / "folder")
    measured = random_states(vehicle, 50, RNG(0))
    np.save(tmp_path / "folder" / "measured.npy", measured)
    done = python(ALONE, cwd=tmp_path / "folder", env={})
    assert done.returncode == 0, done.stderr
    imports = re.findall(r"^[ \t]*(?:from|import) .*", written[0].read_text(), re.MULTILINE)
    assert imports == ["import numpy as np"]
    q = 1 - controller.initial_mode(measured)
    with np.load(tmp_path / "folder" / "answer.npz") as answer:
        for there, here in zip(answer.values(), controller.step(q, measured), strict=True):
            np.testing.assert_allclose(there, here, atol=1e-6)


def test_files_of_two_exports_are_no_controller(circle, tmp_path):
    first, second = (planted(circle, activation=name) for name in ("relu", "tanh"))
    written = export_numpy(first, tmp_path)
    arrays = written[1].read_bytes()
    as_numpy(second, tmp_path)
    written[1].write_bytes(arrays)  # as where a process was ended between the two
    with pytest.raises(ImportError, match="of another export"):
        exec(written[0].read_text(), {"__file__": str(written[0])})


def test_both_loops_of_the_manual_drive_alike(vehicle, tmp_path, monkeypatch):
    page = (Path(__file__).parents[1] / "docs" / "export.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    examples = [block for block in blocks if "while" in block or "for _ in range" in block]
    assert len(examples) == 2
    controller = planted(vehicle)
    export_onnx(controller, tmp_path / "vehicle.onnx")
    export_numpy(controller, tmp_path / "vehicle_controller")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(time, "sleep", lambda seconds: None)
    ends = []
    for example in examples:
        space = {}
        exec(example, space)
        ends.append(space["measured"])
    np.testing.assert_allclose(ends[0], ends[1])
    assert ends[0][0, 0] == pytest.approx(3.0)


# ---- refusals


def with_method(task, name, method):
    """The same task with another method."""
    return type(task.name, (type(task),), {name: lambda self, measured: method(measured)})()


def through_a_part(x, taken):
    whole = np.hstack([x, x])
    part = taken(whole)
    part[...] = 1.0
    return whole


def quietly(x):
    seen = np.hstack([np.cos(x), np.sin(x)])
    with suppress(Exception):
        if (x > 6.2).any(axis=1):
            seen = 0 * seen
    return seen


def silently(x):
    try:
        return np.hstack([x, np.interp(x, [0, 7], [0, 7])])
    except:  # noqa: E722 - as code of users has it
        return np.hstack([x, x])


def perhaps_copied(x, copied):
    whole = np.hstack([x, x])
    part = copied(whole)
    whole[:, 0] -= 1
    return np.stack([part, whole[:, 1]], axis=1)


COPIED = (lambda a: a[:, 0:1].ravel(), lambda a: np.ascontiguousarray(a[:, 0]))
PARTS = (
    lambda a: a[:, :1],
    lambda a: a.reshape(-1, 1, 2),
    lambda a: a.T,
    lambda a: a[None][:, :, 0],
)
PART = "writes to a part of an array by a name of its own"


@pytest.mark.parametrize(
    ("method", "said"),
    [
        *((partial(through_a_part, taken=taken), PART) for taken in PARTS),
        *((partial(perhaps_copied, copied=copied), "may be a copy") for copied in COPIED),
        (quietly, "branches on values"),
        (silently, r"uses np\.interp"),
        (lambda x: np.hstack([np.cos(x), np.interp(x, [0, 7], [0, 1])]), r"uses np\.interp"),
        (lambda x: np.hstack([x, x]) if x[0, 0] > 1 else np.hstack([x, -x]), "picks single rows"),
        (lambda x: np.hstack([x, x]) if (x > 1).any(axis=1) else x, "branches on values"),
        (lambda x: np.array([[np.cos(a), np.sin(a)] for a in x[:, 0]]), "loops over the rows"),
        (lambda x: np.hstack([x, x - x.mean(axis=0)]), "each must stand for itself"),
        (lambda x: np.hstack([x[x > 1][:, None], x]), "depends on values"),
        (lambda x: np.hstack([x, np.linspace(0, 1, 9)[x.astype(int)]]), "plain numbers"),
        (lambda x: np.hstack([x, x.sum(axis=1, dtype=float)[:, None]]), r"np\.sum with arguments"),
        (lambda x: np.hstack([x, np.array(x[:, 0], ndmin=2).T]), "with ndmin"),
        (lambda x: np.hstack([x, x.spam]), r"uses \.spam"),
        (lambda x: np.hstack([x, np.arange(len(x))[:, None] * x]), "does not do what"),
    ],
)  # fmt: skip
def test_a_task_method_that_cannot_be_followed_is_named(method, said, circle, tmp_path):
    task = with_method(circle, "observation", method)
    with pytest.raises(BadInput, match=said) as refused:
        export_numpy(planted(task), tmp_path / "folder")
    assert "observation" in str(refused.value)
    assert not (tmp_path / "folder").exists()


def test_policies_and_sets_of_other_kinds_are_refused(vehicle, circle, tmp_path):
    usual, anywhere = planted(vehicle), dict.fromkeys((0, 1), AnalyticSet(lambda z: z[:, 0]))
    for controller, said in (
        (replace(usual, policies=ideal_controller(vehicle).policies), "0 is a ChartPolicy"),
        (replace(usual, flow_sets=anywhere), "flow set of mode 0 is a AnalyticSet"),
        (replace(usual, policies=planted(circle).policies), "for unit_circle, not vehicle"),
        (planted(vehicle, modes=(-1, 0)), r"modes \(-1, 0\)"),
    ):
        for name, export in FORMS.items():
            with pytest.raises(BadInput, match=said):
                export(controller, tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_bad_forms_and_places(circle, tmp_path):
    controller = planted(circle)
    with pytest.raises(BadInput, match="onnx, numpy"):
        files_of("tflite", tmp_path / "x")
    (tmp_path / "file").write_text("mine")
    for form in ("onnx", "numpy"):
        with pytest.raises(BadInput, match="a place that can be written"):
            FORMS[form](controller, tmp_path / "file" / "x")
    with pytest.raises(BadInput, match="a place that can be written"):
        FORMS["onnx"](controller, tmp_path)
    for name in ("controller.py", "controller.npz"):
        (mine := tmp_path / name).write_text("mine")
        with pytest.raises(BadInput, match=f"{name} exists and is no exported controller"):
            export_numpy(controller, tmp_path)
        assert mine.read_text() == "mine"
        assert {p.name for p in tmp_path.iterdir()} == {"file", name}
        FORMS["numpy"](controller, tmp_path)  # as with --force
        export_numpy(controller, tmp_path)
        for path in files_of("numpy", tmp_path):
            path.unlink()


def test_without_onnx_it_says_what_to_install(circle, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(BadInput, match=re.escape('pip install "hyrl-mj[onnx]"')):
        export_onnx(planted(circle), tmp_path / "x.onnx")


# ---- the vocabulary

UNARY = (
    "abs", "negative", "sign", "exp", "sin", "cos", "tan", "arctan", "tanh", "floor", "ceil", "rint",
    "isnan", "isfinite", "fabs", "square", "reciprocal", "radians", "deg2rad", "degrees", "rad2deg",
    "exp2", "expm1", "sinh", "cosh", "trunc", "positive",
)  # fmt: skip
BINARY = (
    "add", "subtract", "multiply", "divide", "remainder", "maximum", "minimum", "arctan2", "hypot",
    "fmax", "fmin", "logaddexp", "greater", "less_equal", "not_equal",
)  # fmt: skip


def assigned(x):
    made = np.empty((len(x), 4), dtype=float)
    made[:, [3, 1]] = x[:, :2]
    made[..., 0] = x[:, 2]
    made[:, 2] = 7
    made[x[:, 0] > 0, 1] = 5
    made[made < -1] = -1
    made[:, :2] *= 2
    return made


def by_parts(x):
    a, b, c = x.T
    made = np.array([a, b * c, np.where(a > b, a, c)]).T
    made += 1
    return np.asarray(made)


def under_other_names(x):
    made = np.array(x)
    as_it_is, of_its_type = np.asarray(made), made.astype(float, copy=False)
    as_it_is[x > 1] = 7
    of_its_type[:, 0] -= 1
    first, turned, flat = made[:, :2], made.T[1], made.reshape(-1, 3, 1)
    copied = made[:, 2].flatten()
    copied -= 3
    made[:, 2] = first[:, 0] + turned
    made[:, 1] = 2 * flat[:, 2, 0] - turned
    made[:, 0] += first[:, 1] + copied
    return made if isinstance(x, np.ndarray) else x


WHOLE = {
    **{name: lambda x, name=name: getattr(np, name)(x) for name in UNARY},
    **{name: lambda x, name=name: getattr(np, name)(x[:, :2], x[:, 1:]) for name in BINARY},
    "by numbers": lambda x: (2 * x - 1) ** 2 / 3 % 0.7,
    "negative divisor": lambda x: np.mod(x, -0.3),
    "whole numbers": lambda x: (x * 10).astype(int) % 3 + np.ones(3, dtype=np.int32),
    "single precision": lambda x: x.astype(np.float32) * 3 + 1,
    "arcsin": lambda x: np.arcsin(np.clip(x, -1, 1)),
    "arccos": lambda x: np.arccos(x.clip(-1, 1)),
    "arctan2 at the axes": lambda x: np.arctan2(np.rint(x) + 0.0, np.rint(x[:, ::-1]) + 0.0),
    "arctan2 near -0": lambda x: np.arctan2(np.rint(x) + 0.5, np.rint(x[:, ::-1])),
    "log": lambda x: np.log(np.abs(x)) + np.log1p(x * x) + np.log2(x * x) + np.log10(x * x),
    "sqrt and power": lambda x: np.sqrt(np.abs(x)) + np.power(np.abs(x), 0.3),
    "bools": lambda x: ((x > 0) & (x < 1) | ~(x < -1)) ^ (x[:, :1] == 0),
    "reductions": lambda x: np.stack(
        [x.sum(axis=1), x.prod(axis=-1), x.max(axis=1), np.min(x, axis=1), np.mean(x, axis=1)], axis=1
    ),
    "any and all": lambda x: np.column_stack([(x > 1).any(axis=1), np.all(x > -1, axis=1)]),
    "argmax": lambda x: np.argmax(x, axis=1) - x.argmin(axis=1),
    "lists": lambda x: np.stack(
        [np.min([*x.T], axis=0), np.maximum.reduce([*x.T]), np.linalg.norm([*x.T], axis=0)], axis=1
    ),
    "lists of bools": lambda x: np.any([*(x > 1).T], axis=0) ^ np.logical_and.reduce([*(x > 0).T]),
    "norm": lambda x: x / np.linalg.norm(x, axis=1, keepdims=True),
    "norm of rows": lambda x: np.linalg.norm(x[:, :2], axis=1),
    "shapes": lambda x: np.reshape(x, (len(x), 3, 1)).transpose(0, 2, 1).reshape(-1, 3)[:, ::2],
    "axes": lambda x: np.squeeze(np.swapaxes(np.expand_dims(x, 1), 1, 2), axis=2),
    "stacks": lambda x: np.hstack([np.vstack([x.T, x.T]).T, np.zeros((len(x), 2)), np.ones_like(x)]),
    "full": lambda x: np.full((len(x), 2), 0.5) + np.full_like(x[:, :2], 2) + np.zeros_like(x[:, 1:]),
    "full of a row": lambda x: x * np.full((len(x), 3), [1.0, 2.0, 3.0]),
    "repeated rows": lambda x: np.concatenate(
        [x * np.tile([1.0, 2.0, 3.0], (len(x), 1)), np.broadcast_to([4.0], (len(x), 1))], axis=1
    ),
    "under other names": under_other_names,
    "deep copies": lambda x: copy.deepcopy(x) + copy.copy(x),
    "indices": lambda x: np.concatenate([x[:, [2, 0]], x[:, -1:], x[:, 1][:, None]], axis=1),
    "mask of columns": lambda x: x[:, np.array([True, False, True])],
    "take": lambda x: np.take(np.linspace(0, 1, 50), np.clip(x * 9 + 20, 0, 49).astype(int)),
    "matrix": lambda x: x @ np.arange(6.0).reshape(3, 2) + np.dot(x, np.eye(3)[:, :2]),
    "select": lambda x: np.select([x > 1, x > 0], [x, x * x], default=-1.0),
    "differences": lambda x: np.diff(x, axis=1) + np.round(x[:, :2], 1),
    "large constants": lambda x: x[:, :1] * np.linspace(0, 1, 40),
    "strong scalars": lambda x: x.astype(np.float32) * np.float64(0.1) + np.where(x > 1, np.inf, 0),
    "assigned": assigned,
    "by parts": by_parts,
    "itself": lambda x: x.copy(),
}  # fmt: skip


def written_function(program):
    """The function that is written for a program, as NumPy executes it."""
    arrays = {}
    space = {"np": np, "ARRAYS": arrays}
    exec(write_function("f", "It does something.", program, arrays), space)
    return space["f"]


@pytest.mark.parametrize("name", WHOLE)
def test_operations_survive_both_forms(name):
    program = trace(WHOLE[name], {"x": RNG(0).normal(size=(BATCH, 3))}, name)
    function = written_function(program)
    model = write_graph(program, ("y",), "f", {})
    read = {name for node in model.graph.node for name in node.input}
    assert {constant.name for constant in model.graph.initializer} <= read
    session = onnxruntime.InferenceSession(model.SerializeToString())
    for n in (1, 5, 300):
        x = 2 * RNG(n).normal(size=(n, 3))
        wanted = WHOLE[name](x)
        for result in (function(x), session.run(None, {"x": x})[0]):
            assert result.dtype == wanted.dtype
            np.testing.assert_allclose(result, wanted, rtol=1e-12, atol=1e-14)


def test_gelu_takes_the_error_function_of_scipy():
    def gelu(x):
        return x * special.erf(x / np.sqrt(np.float32(2)))

    x = np.linspace(-5, 5, BATCH, dtype=np.float32)[:, None]
    found = written_function(trace(gelu, {"x": x}, "gelu"))(x)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, gelu(x), rtol=0, atol=2e-6)


# ---- code of many shapes, and NumPy as it is for everybody else


def in_a_function(x):
    made = empty((len(x), 2))
    made[:, 0], made[:, 1] = x[:, 0], 1
    return made


def with_an_import_of_its_own(x):
    import numpy
    from numpy import zeros

    made = zeros((len(x), 2))
    made[:, 0] = numpy.asarray(x)[:, 0]
    return made


def with_a_function_in_it(x):
    def halved(x, times):
        return np.array([x[:, 0], x[:, 1]]).T if times == 0 else halved(x / 2, times - 1)

    return halved(x, times=2)


class Encoder:
    scale = 3.0

    def encode(self, x):
        made = np.empty((len(x), 2))
        made[:, 0] = self.offset + self.shifted(x[:, 0])
        made[:, 1] = type(self).scale
        return made

    @property
    def offset(self):
        return float(np.zeros((BATCH, 1))[0, 0]) + type(self).scale

    @staticmethod
    def shifted(x):
        return np.asarray(x + 1)

    @classmethod
    def twice(cls, x):
        return np.array([x[:, 0], cls.scale * x[:, 1]]).T * 2


class Further(Encoder):
    scale = 5.0

    def encode(self, x):
        assert isinstance(self, Further)
        return np.hstack([super().encode(x), self.twice(x), Encoder.encode(self, x)])


SHAPES = {
    "a function": in_a_function,
    "an import": with_an_import_of_its_own,
    "a function in a function": with_a_function_in_it,
    "a partial function": lambda x: partial(in_a_function)(x),
    "a function of another module": lambda x: in_another_module.columns(x),
    "a method": Encoder().encode,
    "an inherited method": Further().encode,
    "a class method": Further.twice,
}
in_another_module = ModuleType("in_another_module")
exec(
    "import numpy as np\ndef columns(x): return np.array([x[:, 1], x[:, 0]]).T",
    vars(in_another_module),
)


@pytest.mark.parametrize("shape", SHAPES)
def test_code_is_followed_into(shape):
    program = trace(SHAPES[shape], {"x": RNG(0).normal(size=(BATCH, 2))}, shape)
    x = RNG(1).normal(size=(5, 2))
    np.testing.assert_allclose(written_function(program)(x), SHAPES[shape](x), rtol=1e-15)


def test_methods_of_other_objects_run_as_they_are():
    encoder, x = Encoder(), np.ones((BATCH, 2))
    with pytest.raises(BadInput, match=r"np\.empty in methods of other objects"):
        trace(lambda x: encoder.encode(x), {"x": x}, "f")
    # What they make of plain arrays can be used.
    assert trace(lambda x: x * encoder.encode(np.ones((1, 2))), {"x": x}, "f").operations()


def test_methods_of_the_chart_are_followed(circle, tmp_path):
    class Charted(type(circle)):
        def observation(self, measured):
            z = self.chart.wrap(measured)
            far = self.chart.difference(z, np.array([1.0]))
            return np.hstack([far, self.chart.contains(z)[:, None]])

    controller = planted(Charted())
    assert_same(controller, as_numpy(controller, tmp_path), 9 * RNG(0).normal(size=(500, 1)))


def made_arrays(task):
    """Arrays that must stay plain outside of traced code."""
    x = np.zeros((BATCH, 2))
    return [
        x, np.empty((BATCH, 3)), np.ones(BATCH), np.full((BATCH, 2), 7.0), np.arange(BATCH),
        np.array([x, x]), np.asarray(x), np.take(np.arange(9.0), np.zeros(BATCH, dtype=int)),
        empty((BATCH, 1)), task.observation(x),
    ]  # fmt: skip


def test_other_threads_have_their_arrays_and_numpy_its_functions(vehicle):
    """The traced code waits until another thread is done."""
    before = dict(vars(np))
    inside, done, made, changed = threading.Event(), threading.Event(), [], []

    class Waiting(type(vehicle)):
        def observation(self, measured):
            seen = super().observation(measured)
            numpy = sys.modules["numpy"]
            changed.extend(name for name, value in before.items() if vars(numpy)[name] is not value)
            inside.set()
            assert done.wait(60)
            return seen

    def work():
        inside.wait(60)
        made.extend(made_arrays(vehicle))
        done.set()

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    program = trace(Waiting().observation, {"measured": np.ones((BATCH, 2))}, "observation")
    thread.join()
    assert program.operations()
    assert [type(array) for array in made] == [np.ndarray] * len(made_arrays(vehicle))
    assert changed == []


def test_numpy_is_itself_again_after_a_trace():
    before = dict(vars(np))
    with pytest.raises(BadInput):
        trace(lambda x: np.interp(x, [0, 1], [0, 1]), {"x": np.zeros((BATCH, 1))}, "f")
    assert all(vars(np)[name] is value for name, value in before.items())
    assert hyrl_mj.export_onnx is export_onnx
