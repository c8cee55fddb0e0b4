"""ONNX models as policies: first examined and tried in a process with limits, then run in this one."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from hyrl_mj.errors import BadArtifact, BadInput
from hyrl_mj.files import artifacts
from hyrl_mj.policies.functions import FunctionPolicy
from hyrl_mj.system import limits
from hyrl_mj.tasks import Task

# Limit on a file [bytes]: the largest MLP policies take a few megabytes.
LARGEST = 2**25
# Rows that a model answers at a time: so many as were tried.
ROWS = 1024
# The longest that the trial may last [s], of which its model may use the processor; and its memory [bytes].
LONGEST, SECONDS, MEMORY = 60, 4, 200 * 2**20
INSTEAD = "in Python, give a function of your own that runs it"


def from_onnx(path: Path, task: Task, remedy: str, n_stack: int = 1) -> FunctionPolicy:
    """Returns the policy of an ONNX file, after a first call of it.

    The model sees `n_stack` observations at once.
    """
    for package in ("onnx", "onnxruntime"):
        if find_spec(package) is None:
            raise BadInput(f'an .onnx file needs {package}: pip install "hyrl-mj[onnx]"')
    columns = n_stack * len(task.observation_low)
    with artifacts.reading(path, remedy):
        model = artifacts.read_limited(path, LARGEST)
        found = _examined(model, columns)
        takes_batches = _check_input(found["inputs"], task, columns)
        session = _session(model)
    input_name, output_name = found["inputs"][0][0], found["outputs"][0]

    def function(observation: np.ndarray) -> np.ndarray:
        n = len(observation)
        # No other numbers of rows than were tried.
        rows = ROWS if takes_batches and n > 1 else 1
        whole = np.pad(observation, ((0, -n % rows), (0, 0)))
        parts = [whole[i : i + rows] for i in range(0, len(whole), rows)]
        outputs = [session.run([output_name], {input_name: part})[0] for part in parts]
        actions = np.concatenate(outputs)
        # A wrong number of actions is kept: the policy's check names it.
        return actions[:n] if len(actions) == len(whole) else actions

    policy = FunctionPolicy(task, function, f"the model of {path}")
    try:
        policy.inputs(np.zeros((2, columns)))
    except BadInput as error:
        raise BadArtifact(str(error)) from error
    return policy


def _session(model: bytes) -> Any:
    """Returns onnxruntime's session of a model, on one thread."""
    import onnxruntime  # slow to import, and only needed here

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4  # errors are raised, too
    return onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])


def _examined(model: bytes, columns: int) -> dict[str, Any]:
    """Returns inputs and outputs of a model that was tried in another process.

    Raises:
        BadArtifact: it is not to be run.
        ValueError: it is no model.
    """
    trial, shape = Path(__file__).with_name("onnx_trial.py"), (str(columns), str(ROWS))
    most = {"seconds": SECONDS, "longest": LONGEST, "memory": MEMORY}
    try:
        found = limits.tried(trial, model, *shape, **most)
    except limits.Ended as ended:
        raise BadArtifact(f"for {ROWS} observations {ended}; {INSTEAD}") from None
    if "error" in found:
        raise ValueError(found["error"])
    if "problem" in found:
        raise BadArtifact(f"{found['problem']}; {INSTEAD}")
    return dict(found)


def _check_input(inputs: list[list[Any]], task: Task, k: int) -> bool:
    """Returns whether a model takes batches; other models take one observation at a time."""
    if len(inputs) != 1 or inputs[0][1] != "tensor(float)" or len(inputs[0][2]) != 2:
        takes = ", ".join(f"{name}: {kind} of shape {shape}" for name, kind, shape in inputs)
        raise BadArtifact(
            f"the model takes {takes or 'nothing'}: it has to take one input, observations (n, {k}) float32"
        )
    rows, columns = inputs[0][2]
    if isinstance(columns, int) and columns != k:
        raise BadArtifact(
            f"the model takes {columns} numbers, an observation of {task.name} has {k}"
        )
    if isinstance(rows, int) and rows != 1:
        raise BadArtifact(
            f"the model takes {rows} observations at a time: export it for any number of them, or for one"
        )
    return rows != 1
