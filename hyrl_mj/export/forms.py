"""The two forms of an exported controller: a folder with NumPy source, and an ONNX file."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hyrl_mj import artifacts
from hyrl_mj.errors import BadInput, brief, unknown
from hyrl_mj.export.source import literal, write_function
from hyrl_mj.export.tracing import trace
from hyrl_mj.export.vocabulary import BATCH
from hyrl_mj.policies import ACTIVATIONS, MlpPolicy
from hyrl_mj.sets import Everything, Grid, GridSet, StateSet
from hyrl_mj.stages import ON_EDGE, HybridController
from hyrl_mj.tasks import Task

if TYPE_CHECKING:
    import onnx

TEMPLATE = Path(__file__).parents[1] / "templates" / "controller.py"
# Where the part of the template begins and ends that belongs to the task.
BEGIN, END = "# ---- the task", "# ---- the controller\n"
# What functions of that part are for.
SENTENCES = {
    "chart_point": "Chart points (n, d) of measurements (n, p).",
    "observation": "What the networks are fed (n, k) for measurements (n, p).",
}
# Rows of the batches in which a form is held against the controller, and the share of rows in which rounding
# may decide differently between two levels or modes; how far other inputs may be off [of their range].
CHECKED, TIES, CLOSE = (1, 7, 1000), 0.002, 1e-5
# The depth of a set without an edge: deeper than any other, and finite.
DEEPEST = -1e300
Step = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


def export_numpy(controller: HybridController, folder: str | Path) -> list[Path]:
    """Write a controller as controller.py and controller.npz, which need NumPy alone.

    The module has `step(q, measured) -> (u, q_next)` and `initial_mode(measured)`, as the controller does.

    Args:
        controller: its modes have networks as policies, and sets on grids as flow sets.
        folder: where to; made if it is not there.

    Returns:
        Both files.

    Raises:
        BadInput: the controller cannot be exported, or the files cannot be written.
    """
    folder = Path(folder)
    path = folder / TEMPLATE.name
    first_line = TEMPLATE.read_text(encoding="utf-8").splitlines(keepends=True)[0]
    there = path.read_text(encoding="utf-8", errors="replace") if path.exists() else first_line
    if not there.startswith(first_line):
        raise BadInput(f"{path} is there and is no exported controller: choose another folder")
    with tempfile.TemporaryDirectory() as temporary:
        written = _write(controller, Path(temporary))
        _check(controller, _load(written[0])["step"], "the NumPy form")
        for source in reversed(written):  # the arrays first
            with artifacts.replacing(folder / source.name) as partial:
                partial.write_bytes(source.read_bytes())
    return [folder / source.name for source in written]


def export_onnx(controller: HybridController, path: str | Path) -> Path:
    """Write a controller as one ONNX file: modes, sets and the jump rule in one graph.

    Its inputs are q (n,) int64 and measured (n, p) float64, its outputs u (n, m) float64 and q_next (n,)
    int64. A graph cannot refuse anything: a q that is no mode, such as -1, is answered as if the loop began,
    with the initial mode; a measurement that is not finite with q itself and u = NaN.

    Args:
        controller: its modes have networks as policies, and sets on grids as flow sets.
        path: the file.

    Returns:
        The file.

    Raises:
        BadInput: the controller cannot be exported, the file cannot be written, or the packages onnx and
            onnxruntime are missing.
    """
    path = Path(path)
    try:
        import onnx  # noqa: F401
        import onnxruntime
    except ImportError as error:
        raise BadInput(
            f'ONNX takes the packages onnx and onnxruntime ({error}): pip install "hyrl-mj[onnx]"'
        ) from error
    with tempfile.TemporaryDirectory() as temporary:
        model = _graph(controller, _load(_write(controller, Path(temporary))[0]))
    content = model.SerializeToString()

    def step(q: np.ndarray, measured: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return tuple(session.run(None, {"q": q, "measured": measured}))

    try:
        session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    # onnxruntime has its own exceptions, all of them plain ones.
    except Exception as error:
        raise BadInput(
            f"{controller.task.name} cannot be exported to ONNX: {brief(error)}"
        ) from error
    _check(controller, step, "the ONNX form")
    with artifacts.replacing(path) as partial:
        partial.write_bytes(content)
    return path


FORMS: dict[str, Callable[..., Any]] = {"onnx": export_onnx, "numpy": export_numpy}


def export(controller: HybridController, form: str, out: Path) -> None:
    """Write a controller in one of `FORMS`.

    Raises:
        BadInput: the form is unknown, or what the form says.
    """
    if form not in FORMS:
        raise unknown("form", form, FORMS)
    FORMS[form](controller, out)


def _write(controller: HybridController, folder: Path) -> tuple[Path, Path]:
    """Write controller.py and controller.npz."""
    arrays = _arrays(controller)
    text = TEMPLATE.read_text(encoding="utf-8")
    begin, end = text.index(BEGIN), text.index(END)
    path = folder / TEMPLATE.name
    path.write_text(text[:begin] + _task_part(controller, arrays) + text[end:], encoding="utf-8")
    artifacts.write_arrays(path.with_suffix(".npz"), arrays, kind="controller")
    return path, path.with_suffix(".npz")


def _arrays(controller: HybridController) -> dict[str, np.ndarray]:
    """What the template reads of modes, chart, inputs, sets and networks."""
    task, chart = controller.task, controller.task.chart
    if min(controller.modes) < 0:
        raise BadInput(f"modes {controller.modes} cannot be exported: -1 stands for no mode yet")
    low, high = task.input_limits
    arrays: dict[str, Any] = {
        "modes": np.array(controller.modes, dtype=np.int64),
        "on_edge": np.array(ON_EDGE),
        "chart_low": chart.origin,
        "chart_sides": chart.sides,
        "chart_periodic": np.array(chart.periodic),
        "input_low": low,
        "input_high": high,
    }
    if task.input_levels is not None:
        arrays["levels"] = task.input_levels
    for k, q in enumerate(controller.modes):
        sets = {"flow": controller.flow_sets[q]}
        if controller.starts is not None:
            sets["start"] = controller.starts[q]
        for kind, held in sets.items():
            on_grid = _grid_set(held, task, f"{kind} set of mode {q}")
            arrays[f"{kind}_{k}"] = on_grid.values
            arrays[f"{kind}_{k}_counts"] = np.array(on_grid.grid.counts, dtype=np.int64)
            arrays[f"{kind}_{k}_spacing"] = on_grid.grid.spacing
        layers = _policy(controller, q).layers
        arrays[f"layers_{k}"] = np.array(len(layers))
        for i, (weight, bias) in enumerate(layers):
            arrays[f"weight_{k}_{i}"], arrays[f"bias_{k}_{i}"] = weight, bias
    return arrays


def _grid_set(held: StateSet, task: Task, what: str) -> GridSet:
    """A set on a grid."""
    if isinstance(held, GridSet) and held.grid.chart == task.chart:
        return held
    if isinstance(held, Everything):
        grid = Grid(task.chart, (2,) * task.chart.dimension)
        return GridSet(grid, np.full(2**task.chart.dimension, DEEPEST))
    raise BadInput(
        f"the {what} is a {type(held).__name__}: only a GridSet on the chart of "
        f"{task.name}, or Everything, can be exported"
    )


def _policy(controller: HybridController, q: int) -> MlpPolicy:
    """The network of a mode."""
    policy = controller.policies[q]
    if not isinstance(policy, MlpPolicy):
        raise BadInput(
            f"the policy of mode {q} is a {type(policy).__name__}: only networks, MlpPolicy, can be "
            "exported"
        )
    if policy.task.name != controller.task.name:
        raise BadInput(
            f"the policy of mode {q} is for {policy.task.name}, not {controller.task.name}"
        )
    return policy


def _task_part(controller: HybridController, arrays: dict[str, np.ndarray]) -> str:
    """The part of the template that belongs to the task; large constants go to `arrays`."""
    task = controller.task
    policies = [_policy(controller, q) for q in controller.modes]
    units = task.input_units or ("",) * len(task.inputs)
    inputs = tuple(f"{i} [{u}]" if u else i for i, u in zip(task.inputs, units, strict=True))
    activations = [policy.activation for policy in policies]
    lines = [
        f"{BEGIN} {task.name}",
        f"TASK = {literal(task.name)}",
        f"SAMPLE_TIME = {task.dt!r}  # [s]",
        f"MEASUREMENT_COLUMNS = {task.measurement_columns}",
        f"INPUTS = {literal(inputs)}",
        f"OUTPUTS = {literal(tuple(policy.output for policy in policies))}\n\n",
    ]
    measured = {"measured": _measurements(task, BATCH, np.random.default_rng(0))}
    x = {"x": np.linspace(-3, 3, BATCH, dtype=np.float32)[:, None]}
    programs = {
        "chart_point": trace(task.z, measured, f"the method z of {task.name}"),
        "observation": trace(task.observation, measured, f"the method observation of {task.name}"),
        **{a: trace(ACTIVATIONS[a], x, f"the activation {a}") for a in dict.fromkeys(activations)},
    }
    for name, program in programs.items():
        sentence = SENTENCES.get(name, "Between the layers of a network.")
        lines += [*write_function(name, sentence, program, arrays), "", ""]
    return "\n".join([*lines, f"ACTIVATIONS = ({', '.join(activations)},)", "", ""])


def _graph(controller: HybridController, names: dict[str, Any]) -> onnx.ModelProto:
    """What `answer` of an exported controller.py does, as a graph."""
    from hyrl_mj.export.graph import write_graph

    task, rng = controller.task, np.random.default_rng(0)
    samples = {
        "q": rng.choice(controller.modes, BATCH),
        "measured": _measurements(task, BATCH, rng),
    }
    program = trace(names["answer"], samples, f"the step of {task.name}")
    metadata = {
        "task": task.name,
        "modes": ", ".join(map(str, controller.modes)),
        "inputs": ", ".join(names["INPUTS"]),
        "sample_time": str(task.dt),
    }
    return write_graph(program, ("u", "q_next"), task.name, metadata)


def _load(path: Path) -> dict[str, Any]:
    """The names in an exported controller.py."""
    names = {"__file__": str(path)}
    exec(compile(path.read_text(encoding="utf-8"), path, "exec"), names)
    return names


def _measurements(task: Task, n: int, rng: np.random.Generator) -> np.ndarray:
    """Noisy measurements (n, p) all over the chart."""
    z = rng.uniform(task.chart.low, task.chart.high, (n, task.chart.dimension))
    plant = task.plant(n)
    plant.set_state(*task.state(z, rng))
    return plant.measurement + rng.uniform(-0.1, 0.1, (n, task.measurement_columns))


def _check(controller: HybridController, step: Step, what: str) -> None:
    """Refuse a form that does other than the controller."""
    task, rng = controller.task, np.random.default_rng(1)
    refusal = (
        f"{what} of {task.name} cannot be exported: it does not do what the controller does ({{}}); do z() "
        "and observation() of the task compute each row from that row alone, whatever its values are?"
    )
    low, high = task.input_limits
    wrong = 0
    for n in CHECKED:
        measured = _measurements(task, n, rng)
        q = rng.choice(controller.modes, n)
        u, q_next = controller.step(q, measured)
        try:
            u_there, q_there = step(q, measured)
        # A form that does not fit fails in the ways of NumPy or onnxruntime.
        except Exception as error:
            raise BadInput(refusal.format(brief(error))) from error
        if u_there.shape != u.shape or q_there.shape != q.shape:
            raise BadInput(refusal.format(f"u has shape {u_there.shape} for a batch of {n}"))
        far = np.abs(u_there - u) > CLOSE * (high - low)
        wrong += int(np.count_nonzero(far.any(axis=1) | (q_there != q_next)))
    if wrong > TIES * sum(CHECKED):
        raise BadInput(refusal.format(f"{wrong} of {sum(CHECKED)} answers differ"))
