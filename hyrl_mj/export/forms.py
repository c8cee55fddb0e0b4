"""The two forms of an exported controller: a folder with NumPy source, and an ONNX file."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from contextlib import ExitStack, suppress
from hashlib import sha256
from pathlib import Path
from runpy import run_path
from typing import TYPE_CHECKING, Any

import numpy as np

from hyrl_mj.errors import BadArtifact, BadInput, brief, unknown
from hyrl_mj.export.source import write_function
from hyrl_mj.fields import FocusController, exported_controller
from hyrl_mj.files import artifacts
from hyrl_mj.policies import ACTIVATIONS, ON_EDGE, HybridController, MlpPolicy
from hyrl_mj.sets import Cloud, Everything, Grid, GridSet, StateSet
from hyrl_mj.tasks import Task
from hyrl_mj.tracing import BATCH, trace

if TYPE_CHECKING:
    import onnx

TEMPLATE = Path(__file__).parent / "templates" / "controller.py"


# Controllers that can be exported; the step of the second one is written in NumPy's functions of arrays.
Exportable = HybridController | FocusController
Step = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


def export_numpy(
    controller: Exportable, folder: str | Path, field: str | Path | None = None
) -> list[Path]:
    """Writes a controller as controller.py and controller.npz, which need NumPy alone; returns their paths.

    The module has `step(q, measured) -> (u, q_next)` and `initial_mode(measured)`, as the controller does.

    Args:
        controller: its policies are networks, and its sets are on grids.
        folder: is created if it does not exist.
        field: for a run of field, the file of a field with as many posts as will be seen; by default one.

    Raises:
        BadInput: the controller cannot be exported, or the files cannot be written.
    """
    if taken := [path for path in files_of("numpy", Path(folder)) if not _is_free(path)]:
        raise BadInput(f"{taken[0]} exists and is no exported controller: choose another folder")
    return _write_numpy(controller, folder, field)


def _write_numpy(
    controller: Exportable, folder: str | Path, field: str | Path | None = None
) -> list[Path]:
    """Does what `export_numpy` does, whatever files are there."""
    controller, folder = exported_controller(controller, field), Path(folder)
    with tempfile.TemporaryDirectory() as temporary:
        written = _write(controller, Path(temporary))
        _check(controller, run_path(str(written[0]))["step"], "the NumPy form")
        with ExitStack() as stack:  # all is written before anything is renamed, the arrays first
            for source in written:
                partial = stack.enter_context(artifacts.replacing(folder / source.name))
                partial.write_bytes(source.read_bytes())
    return [folder / source.name for source in written]


def _is_free(path: Path) -> bool:
    """Returns whether there is no file, or one of a controller that was exported."""
    if not path.exists():
        return True
    if path.suffix == ".npz":
        with suppress(BadArtifact):
            return bool(artifacts.read_arrays(path, kind="controller"))
        return False
    first_line = TEMPLATE.read_text(encoding="utf-8").partition("\n")[0]
    return first_line in path.read_text(encoding="utf-8", errors="replace")


def export_onnx(controller: Exportable, path: str | Path, field: str | Path | None = None) -> Path:
    """Writes a controller as one ONNX file, and returns its path: modes, sets and the jump rule in one graph.

    Its inputs are q (n,) int64 and measured (n, p) float64, its outputs u (n, m) float64 and q_next (n,)
    int64. A graph cannot refuse anything: for a q that is no mode, such as -1, it begins in the initial mode;
    for a measurement that is not finite it returns q itself and u = NaN.

    Args:
        controller: its policies are networks, and its sets are on grids.
        path: the file to write.
        field: as in `export_numpy`.

    Raises:
        BadInput: the controller cannot be exported, the file cannot be written, or the packages onnx and
            onnxruntime are missing.
    """
    controller, path = exported_controller(controller, field), Path(path)
    sets: list[StateSet] = []
    if isinstance(controller, HybridController):
        sets = [*controller.flow_sets.values(), *(controller.starts or {}).values()]
    if any(isinstance(s, GridSet) and isinstance(s.grid, Cloud) for s in sets):
        raise BadInput(
            f"the sets of {controller.task.name} lie on scattered nodes, which an ONNX graph does not "
            "search: export to numpy instead"
        )
    try:
        import onnx  # noqa: F401
        import onnxruntime
    except ImportError as error:
        raise BadInput(
            f'ONNX needs the packages onnx and onnxruntime ({error}): pip install "hyrl-mj[onnx]"'
        ) from error
    with tempfile.TemporaryDirectory() as temporary:
        module_path, _ = _write(controller, Path(temporary))
        model = _graph(controller, run_path(str(module_path)))
    content = model.SerializeToString()

    def step(q: np.ndarray, measured: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return tuple(session.run(None, {"q": q, "measured": measured}))

    try:
        session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's own exceptions have no other base
        raise BadInput(
            f"{controller.task.name} cannot be exported to ONNX: {brief(error)}"
        ) from error
    _check(controller, step, "the ONNX form")
    with artifacts.replacing(path) as partial:
        partial.write_bytes(content)
    return path


# For the command line, which has asked whether the files may be written.
FORMS: dict[str, Callable[..., Any]] = {"onnx": export_onnx, "numpy": _write_numpy}


def files_of(form: str, out: Path) -> list[Path]:
    """Returns the files that a form writes; raises `BadInput` if the form is unknown."""
    if form not in FORMS:
        raise unknown("form", form, FORMS)
    return (
        [out / TEMPLATE.name, (out / TEMPLATE.name).with_suffix(".npz")]
        if form == "numpy"
        else [out]
    )


def _write(controller: Exportable, folder: Path) -> tuple[Path, Path]:
    """Writes controller.py and controller.npz."""
    text = TEMPLATE.read_text(encoding="utf-8")
    begin, end = text.index("# ---- the task"), text.index("# ---- the controller\n")
    if isinstance(controller, HybridController):
        networks = [_network(controller, q) for q in controller.modes]
        arrays = _arrays(controller, networks)
        text = text[:begin] + _task_part(controller.task, networks, arrays) + text[end:]
    else:
        arrays = {"modes": np.array(controller.modes, dtype=np.int64)}
        task_part = _constants(controller.task) + "\n\n\n"
        checks = text[end : text.index("LOW, SIDES, PERIODIC =")]
        text = text[:begin] + task_part + checks + _traced_step(controller, arrays)
    # By this both files know each other: a process may be ended between their renames.
    digest = sha256(text.encode())
    for name, array in arrays.items():
        digest.update(name.encode() + np.asarray(array).tobytes())
    export = digest.hexdigest()
    text = text.replace('EXPORT = "name"', f'EXPORT = "{export}"')
    arrays["export"] = np.array(export)
    path = folder / TEMPLATE.name
    path.write_text(text, encoding="utf-8")
    artifacts.write_arrays(path.with_suffix(".npz"), arrays, kind="controller")
    return path, path.with_suffix(".npz")


def _traced_step(controller: FocusController, arrays: dict[str, np.ndarray]) -> str:
    """Returns the function `answer` of a controller that is written in NumPy's functions of arrays."""
    task, rng = controller.task, np.random.default_rng(0)
    q, measured = rng.choice((*controller.modes, -1), BATCH), _measurements(task, BATCH, rng)
    what = f"the controller of {task.name}"
    answer = trace(controller.begin, {"q": q, "measured": measured}, what)
    sentence = "Does `step` without checks; where q is -1, begins in the initial mode."
    finite = """


def answer(q, measured):
    \"""Does `moves`. Where a measurement is not finite, q stays and u is NaN.\"""
    finite = np.isfinite(measured).all(axis=1)
    u, q_next = moves(q, np.where(finite[:, None], measured, 0.0))
    return np.where(finite[:, None], u, np.nan), np.where(finite, q_next, q)
"""
    return write_function("moves", sentence, answer, arrays) + finite


def _network(controller: HybridController, q: int) -> MlpPolicy:
    """Returns the network of a mode."""
    policy, task = controller.policies[q], controller.task.name
    if not isinstance(policy, MlpPolicy):
        raise BadInput(
            f"the policy of mode {q} is a {type(policy).__name__}: only networks, MlpPolicy, can be "
            "exported; where hyrl_mj is installed, take run.controller"
        )
    if policy.task.name != task:
        raise BadInput(f"the policy of mode {q} is for {policy.task.name}, not {task}")
    return policy


def _arrays(controller: HybridController, networks: list[MlpPolicy]) -> dict[str, np.ndarray]:
    """Returns what the template reads of modes, chart, inputs, sets and networks."""
    task, chart = controller.task, controller.task.chart
    if min(controller.modes) < 0:
        raise BadInput(
            f"modes {controller.modes} cannot be exported: give modes >= 0, since -1 stands for no mode"
        )
    low, high = task.input_limits
    arrays: dict[str, Any] = {
        "modes": np.array(controller.modes, dtype=np.int64), "on_edge": ON_EDGE, "chart_low": chart.origin,
        "chart_sides": chart.sides, "chart_periodic": chart.periodic, "chart_scale": chart.scale,
        "input_low": low, "input_high": high,
    }  # fmt: skip
    if task.input_levels is not None:
        arrays["levels"] = task.input_levels
    for k, q in enumerate(controller.modes):
        sets = {"flow": controller.flow_sets[q]}
        if controller.starts is not None:
            sets["start"] = controller.starts[q]
        for kind, state_set in sets.items():
            on_grid = _grid_set(state_set, task, f"{kind} set of mode {q}")
            arrays[f"{kind}_{k}"] = on_grid.values
            more = on_grid.grid.exported(on_grid.values)
            arrays |= {f"{kind}_{k}_{name}": array for name, array in more.items()}
        arrays[f"layers_{k}"] = len(networks[k].layers)
        for i, (weight, bias) in enumerate(networks[k].layers):
            arrays[f"weight_{k}_{i}"], arrays[f"bias_{k}_{i}"] = weight, bias
    return {name: np.array(value) for name, value in arrays.items()}


def _grid_set(state_set: StateSet, task: Task, what: str) -> GridSet:
    """Returns a set on a grid or on scattered nodes; `what` names it in messages."""
    if isinstance(state_set, GridSet) and state_set.grid.chart == task.chart:
        return state_set
    if isinstance(state_set, Everything):
        grid = Grid(task.chart, (2,) * task.chart.dimension)
        # Deeper than any other set, and finite.
        return GridSet(grid, np.full(len(grid.nodes), -1e300))
    raise BadInput(
        f"the {what} is a {type(state_set).__name__}: only a GridSet on the chart of "
        f"{task.name}, or Everything, can be exported"
    )


def _task_part(task: Task, networks: list[MlpPolicy], arrays: dict[str, np.ndarray]) -> str:
    """Returns the task's part of the template; large constants go to `arrays`."""
    activations = [network.activation for network in networks]
    measured = {"measured": _measurements(task, BATCH, np.random.default_rng(0))}
    x = {"x": np.linspace(-3, 3, BATCH, dtype=np.float32)[:, None]}
    z = trace(task.z, measured, f"the method z of {task.name}")
    observation = trace(task.observation, measured, f"the method observation of {task.name}")
    outputs = f"OUTPUTS = {tuple(network.output for network in networks)!r}"
    parts = [
        f"{_constants(task)}\n{outputs}",
        write_function("chart_point", "Returns chart points (n, d).", z, arrays),
        write_function("observation", "Returns observations (n, k).", observation, arrays),
    ]
    for name in dict.fromkeys(activations):
        program = trace(ACTIVATIONS[name], x, f"the activation {name}")
        parts.append(write_function(name, "Activates a layer of a network.", program, arrays))
    return "\n\n\n".join([*parts, f"ACTIVATIONS = [{', '.join(activations)}]\n\n"])


def _constants(task: Task) -> str:
    units = task.input_units or ("",) * len(task.inputs)
    inputs = tuple(f"{i} [{u}]" if u else i for i, u in zip(task.inputs, units, strict=True))
    lines = [
        f"# ---- the task {task.name}",
        f"TASK = {task.name!r}",
        f"SAMPLE_TIME = {task.dt!r}  # [s]",
        f"MEASUREMENT_COLUMNS = {task.measurement_columns}",
        f"INPUTS = {inputs!r}",
    ]
    return "\n".join(lines)


def _graph(controller: Exportable, module: dict[str, Any]) -> onnx.ModelProto:
    """Returns the function `answer` of an exported controller.py, a namespace, as a graph."""
    from hyrl_mj.export.graph import write_graph

    task, rng = controller.task, np.random.default_rng(0)
    q, measured = rng.choice(controller.modes, BATCH), _measurements(task, BATCH, rng)
    program = trace(module["answer"], {"q": q, "measured": measured}, f"the step of {task.name}")
    metadata = {
        "task": task.name,
        "modes": ", ".join(map(str, controller.modes)),
        "inputs": ", ".join(module["INPUTS"]),
        "sample_time": str(task.dt),
    }
    return write_graph(program, ("u", "q_next"), task.name, metadata)


def _measurements(task: Task, n: int, rng: np.random.Generator) -> np.ndarray:
    """Draws noisy measurements (n, p) from the whole chart."""
    z = task.chart.draw(n, rng)
    return task.placed(z, rng).measurement + rng.uniform(-0.1, 0.1, (n, task.measurement_columns))


def _check(controller: Exportable, step: Step, form: str) -> None:
    """Raises `BadInput` where a form does not do what the controller does."""
    task, rng, wrong, rows = controller.task, np.random.default_rng(1), 0, (1, 7, 1000)
    refusal = (
        f"{form} of {task.name} cannot be exported: it does not do what the controller does ({{}}); do z() "
        "and observation() of the task compute each row from that row alone, whatever its values are?"
    )
    low, high = task.input_limits
    # What may be different: the share of rows in which rounding decides between two levels or modes, and the
    # error of other inputs [share of their range].
    ties, close = 0.002, 1e-5
    for n in rows:
        measured = _measurements(task, n, rng)
        q = rng.choice(controller.modes, n)
        u, q_next = controller.step(q, measured)
        try:
            exported_u, exported_q = step(q, measured)
        except Exception as error:  # NumPy and onnxruntime fail in many ways
            raise BadInput(refusal.format(brief(error))) from error
        if exported_u.shape != u.shape or exported_q.shape != q.shape:
            raise BadInput(refusal.format(f"u has shape {exported_u.shape} for a batch of {n}"))
        far = np.abs(exported_u - u) > close * (high - low)
        wrong += int(np.count_nonzero(far.any(axis=1) | (exported_q != q_next)))
    if wrong > ties * sum(rows):
        raise BadInput(refusal.format(f"{wrong} of {sum(rows)} answers differ"))
