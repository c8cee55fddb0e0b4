"""ONNX models of a stranger: each must be refused, in one sentence."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from attacks.crafted_agents import ESCAPE, garbage, sparse

FLOAT, INT64, BOOL = TensorProto.FLOAT, TensorProto.INT64, TensorProto.BOOL


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


def looped(folder: Path, turns: int, body_adds: bool = False) -> str:
    """A loop of so many turns; with `body_adds` each turn also doubles a tensor."""
    body_nodes = [node("Identity", ("go",), "go_on")]
    body_nodes.append(
        helper.make_node("Concat", ["x", "x"], ["x_on"], axis=0)
        if body_adds
        else node("Identity", ("x",), "x_on")
    )
    info = helper.make_tensor_value_info
    body = helper.make_graph(
        body_nodes,
        "body",
        [info("turn", INT64, ()), info("go", BOOL, ()), info("x", FLOAT, None)],
        [info("go_on", BOOL, ()), info("x_on", FLOAT, None)],
    )
    loop = helper.make_node("Loop", ["turns", "yes", "sum"], ["u"], body=body)
    summed = node("ReduceSum", ("obs", "axis"), "sum")
    constants = [constant("turns", np.int64(turns)), constant("yes", np.bool_(True)), SUM[1]]
    return model(folder, [summed, loop], constants)


def random(folder: Path, kind: str) -> str:
    """A model that draws random numbers."""
    summed = node("ReduceSum", ("obs", "axis"), "sum")
    if kind == "Dropout":
        drawn = node("Dropout", ("sum", "ratio", "training"), "u")
        more = [constant("ratio", np.float32(0.5)), constant("training", np.bool_(True))]
        return model(folder, [summed, drawn], [SUM[1], *more])
    if kind == "Bernoulli":
        squashed = node("Sigmoid", ("sum",), "share")
        return model(folder, [summed, squashed, node(kind, ("share",))], SUM[1:])
    drawn = node(kind, ("sum",), "drawn")
    return model(folder, [summed, drawn, node("Add", ("sum", "drawn"))], SUM[1:])


def filled(folder: Path, shape: Sequence[int]) -> str:
    """A constant that the file does not hold, but whose shape it names."""
    big = node("ConstantOfShape", ("shape",), "big")
    total = node("ReduceMax", ("big",), "most", keepdims=0)
    summed = node("ReduceSum", ("obs", "axis"), "sum")
    nodes = [big, total, summed, node("Add", ("sum", "most"))]
    return model(folder, nodes, [constant("shape", np.array(shape)), SUM[1]])


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
    "onnx, a loop of 2**60 turns": partial(looped, turns=2**60),
    "onnx, a loop of 10**8 turns": partial(looped, turns=10**8),
    "onnx, a loop that doubles a tensor": partial(looped, turns=60, body_adds=True),
    **{
        f"onnx, {kind}": partial(random, kind=kind)
        for kind in ("RandomNormalLike", "RandomUniformLike", "Bernoulli", "Dropout")
    },
    "onnx, a branch in a branch, and chance": nested,
    "onnx, 2**50 zeros": partial(filled, shape=(2**25, 2**25)),
    "onnx, 2**31 zeros": partial(filled, shape=(2**15, 2**16)),
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
    "onnx, without outputs": lambda folder: model(folder, SUM[:1], SUM[1:], output=None),
    "onnx, an output of no node": lambda folder: model(folder, [], []),
    "onnx, strings": lambda folder: model(
        folder, [node("Identity", ("obs",))], given=(TensorProto.STRING, ("n", 2)),
        output=(TensorProto.STRING, ("n", 2)),
    ),
    "onnx, NaN": lambda folder: model(
        folder, [node("Log", ("minus",), "nan"), node("Add", ("obs", "nan"), "sum"),
                 node("ReduceSum", ("sum", "axis"))],
        [constant("minus", np.float32([-1.0])), SUM[1]],
    ),
    "onnx, three inputs for one": lambda folder: model(
        folder, [node("Concat", ("obs", "obs"), axis=1)], output=(FLOAT, ("n", 4))
    ),
    "onnx, the rows of a batch depend on each other": lambda folder: model(
        folder, [node("ReduceMean", ("obs",), "mean", keepdims=0),
                 node("ReduceSum", ("obs", "axis"), "sum"), node("Add", ("sum", "mean"))],
        SUM[1:],
    ),
    "onnx, an unknown operator": lambda folder: model(folder, [node(ESCAPE, ("obs",))]),
    "onnx, of another domain": lambda folder: model(
        folder, [node("Python", ("obs",), domain="evil.ops")]
    ),
    "onnx, of opset 10**6": lambda folder: model(folder, SUM[:1], SUM[1:], opset=10**6),
    "onnx, garbage": partial(garbage, name="agent.onnx", content=b"\x08\x96\x01" * 1000),
    "onnx, empty": partial(garbage, name="agent.onnx", content=b""),
    "onnx, 4 GB of nothing": partial(sparse, name="agent.onnx"),
}  # fmt: skip
