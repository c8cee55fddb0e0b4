"""ONNX models as policies: first examined and tried in a process with limits, then run in this one."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from hyrl_mj.errors import BadArtifact, BadInput
from hyrl_mj.files import artifacts
from hyrl_mj.policies.functions import FunctionPolicy, check_scaled
from hyrl_mj.policies.sb3_zip import REMEDY
from hyrl_mj.system import limits
from hyrl_mj.tasks import Task

# Rows that a model answers at a time: so many as were tried.
ROWS = 1024


def from_onnx(path: Path, task: Task, n_stack: int) -> FunctionPolicy:
    """Returns the policy of an ONNX file, after a first call of it.

    The model sees `n_stack` observations at once.
    """
    for package in ("onnx", "onnxruntime"):
        if find_spec(package) is None:
            raise BadInput(f'an .onnx file needs {package}: pip install "hyrl-mj[onnx]"')
    columns = n_stack * len(task.observation_low)
    with artifacts.reading(path, REMEDY):
        model = artifacts.read_limited(path, 2**25)  # the largest MLP policies take a few megabytes
        found = _examined(model, columns, task)
        from hyrl_mj.policies.onnx_trial import session_of  # slow to import, and only needed here

        session = session_of(model)
    input_name, output_name = found["input"], found["output"]

    def function(observation: np.ndarray) -> np.ndarray:
        n = len(observation)
        # No other numbers of rows than were tried.
        rows = ROWS if found["batches"] and n > 1 else 1
        # An environment may observe float64.
        whole = np.pad(observation.astype(np.float32), ((0, -n % rows), (0, 0)))
        parts = [whole[i : i + rows] for i in range(0, len(whole), rows)]
        outputs = [session.run([output_name], {input_name: part})[0] for part in parts]
        actions = np.concatenate(outputs)
        # A wrong number of actions is kept: the policy's check names it.
        return actions[:n] if len(actions) == len(whole) else actions

    policy = FunctionPolicy(task, function, f"the model of {path}")
    try:
        if found["squashed"]:
            check_scaled(task, policy.name)
        policy.inputs(np.zeros((2, columns)))
    except BadInput as error:
        raise BadArtifact(str(error)) from error
    return policy


def _examined(model: bytes, columns: int, task: Task) -> dict[str, Any]:
    """Returns what is known of a model that was tried in another process: see `onnx_trial`.

    Raises:
        BadArtifact: it is not to be run.
        ValueError: it is no model.
    """
    trial = Path(__file__).with_name("onnx_trial.py")
    instead = "in Python, give a function of your own that runs it"
    try:
        # So long the model may use the processor, and so long all may last [s]; and its memory [bytes].
        found = limits.tried(
            trial, model, str(columns), str(ROWS), task.name,
            seconds=4, longest=60, memory=200 * 2**20,
        )  # fmt: skip
    except limits.Ended as ended:
        raise BadArtifact(f"for {ROWS} observations {ended}; {instead}") from None
    if "error" in found:
        raise ValueError(found["error"])
    if "problem" in found:
        raise BadArtifact(f"{found['problem']}; {instead}")
    return dict(found)
