"""ONNX models of a stranger: each must be refused, in one sentence."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from attacks.crafted_agents import ESCAPE, sparse

FLOAT = TensorProto.FLOAT


def constant(name: str, values: Any) -> onnx.TensorProto:
    return numpy_helper.from_array(np.asarray(values), name)


def model(
    folder: Path,
    nodes: Sequence[onnx.NodeProto],
    constants: Sequence[onnx.TensorProto] = (),
    output: tuple[int, Any] | None = (FLOAT, ("n", 1)),
    given: tuple[int, Any] = (FLOAT, ("n", 2)),
    opset: int = 17,
    **more: Any,
) -> str:
    """Writes a model from "obs" to "u"."""
    outputs = [] if output is None else [helper.make_tensor_value_info("u", *output)]
    inputs = [helper.make_tensor_value_info("obs", *given)]
    graph = helper.make_graph(list(nodes), "g", inputs, outputs, list(constants))
    opsets = more.pop("opsets", [helper.make_opsetid("", opset)])
    made = helper.make_model(graph, opset_imports=opsets, ir_version=8, **more)
    (folder / "agent.onnx").write_bytes(made.SerializeToString())
    return "agent.onnx"


def node(kind: str, given: Sequence[str], gives: str = "u", **attributes: Any) -> onnx.NodeProto:
    return helper.make_node(kind, list(given), [gives], **attributes)


SUM = (node("ReduceSum", ("obs", "axis")), constant("axis", np.array([1])))


def honest_model(folder: Path) -> str:
    return model(folder, SUM[:1], SUM[1:])


def expanded(folder: Path) -> str:
    """The input, repeated until it fills the memory."""
    big = node("Expand", ("obs", "shape"), "big")
    shape = constant("shape", np.array([2**14, 2**16, 1, 2]))
    total = node("ReduceMax", ("big",), "most", keepdims=0)
    summed = node("ReduceSum", ("obs", "axis"), "sum")
    return model(folder, [big, total, summed, node("Add", ("sum", "most"))], [shape, SUM[1]])


def elsewhere(folder: Path, location: str, inside: str = "", **more: int) -> str:
    """Weights that lie in another file, named by the graph, inside a node, or inside a function."""
    weights = constant("w", np.zeros((2, 1), np.float32))
    weights.ClearField("raw_data")
    weights.data_location = TensorProto.EXTERNAL
    for key, value in {"location": location, "offset": 0, "length": 8, **more}.items():
        entry = weights.external_data.add()
        entry.key, entry.value = key, f"{value}"
    product = node("MatMul", ("obs", "w"))
    if not inside:
        return model(folder, [product], [weights])
    nodes = [node("Constant", (), "w", value=weights), product]
    if inside == "node":
        return model(folder, nodes)
    opsets = [helper.make_opsetid("", 17), helper.make_opsetid("own", 1)]
    function = helper.make_function("own", "F", ["obs"], ["u"], nodes, opsets[:1])
    return model(folder, [node("F", ("obs",), domain="own")], functions=[function], opsets=opsets)


def nested(folder: Path) -> str:
    """A thousand branches, each in the one before."""
    info = helper.make_tensor_value_info
    inner = helper.make_graph(
        [node("Identity", ("sum",), "u")], "leaf", [], [info("u", FLOAT, None)]
    )
    for _ in range(90):
        branch = helper.make_node("If", ["yes"], ["u"], then_branch=inner, else_branch=inner)
        inner = helper.make_graph([branch], "branch", [], [info("u", FLOAT, None)])
        if inner.ByteSize() > 2**22:
            break
    branch = helper.make_node("If", ["yes"], ["u"], then_branch=inner, else_branch=inner)
    summed = node("ReduceSum", ("obs", "axis"), "sum")
    drawn = node("RandomNormalLike", ("sum",), "not_used")
    return model(folder, [summed, drawn, branch], [constant("yes", np.bool_(True)), SUM[1]])


FILES: dict[str, Callable[[Path], str]] = {
    "onnx, a branch in a branch, and chance": nested,
    "onnx, an input that fills the memory": expanded,
    "onnx, weights in another file": partial(elsewhere, location="victim/secret.txt"),
    "onnx, weights in a file above": partial(elsewhere, location="../../../../../../etc/passwd"),
    "onnx, weights in a device": partial(elsewhere, location="/dev/zero", length=2**40),
    "onnx, weights of a node in another file": partial(
        elsewhere, location="victim/secret.txt", inside="node"
    ),
    "onnx, weights of a function in another file": partial(
        elsewhere, location="victim/secret.txt", inside="function", offset=2**60
    ),
    "onnx, an output of no node": lambda folder: model(folder, [], []),
    "onnx, strings": lambda folder: model(
        folder, [node("Identity", ("obs",))], given=(TensorProto.STRING, ("n", 2)),
        output=(TensorProto.STRING, ("n", 2)),
    ),
    "onnx, an unknown operator": lambda folder: model(folder, [node(ESCAPE, ("obs",))]),
    "onnx, of opset 10**6": lambda folder: model(folder, SUM[:1], SUM[1:], opset=10**6),
    "onnx, 4 GB of nothing": partial(sparse, name="agent.onnx"),
}  # fmt: skip
