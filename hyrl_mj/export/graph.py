"""Writes what code does as an ONNX graph."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import onnx
from onnx import helper, numpy_helper

from hyrl_mj.export.traced_array import Operation, Program
from hyrl_mj.export.vocabulary import BATCH, ELEMENTWISE

# Those of the oldest onnxruntime that is asked for, and older ones read.
OPSET, IR_VERSION = 18, 8
REDUCED = {
    "sum": "ReduceSum", "max": "ReduceMax", "min": "ReduceMin", "any": "ReduceMax", "all": "ReduceMin",
}  # fmt: skip


def write_graph(
    program: Program, outputs: Sequence[str], name: str, metadata: Mapping[str, str]
) -> onnx.ModelProto:
    """The model that does what a program does, on batches of any size.

    Args:
        program: its inputs and outputs have one row for each of the batch.
        outputs: names of its outputs.
        name: of the graph.
        metadata: is kept with the model.
    """
    graph = _Graph(program)
    for operation in program.operations():
        graph.names[id(operation)] = graph.lower(operation)
    results = list(zip(outputs, program.outputs, strict=True))
    graph.nodes += [helper.make_node("Identity", [graph.get(o)], [n], name=n) for n, o in results]
    model = helper.make_model(
        helper.make_graph(
            graph.nodes,
            name,
            [_described(o.operands[0], o) for o in program.inputs],
            [_described(n, o) for n, o in results],
            [numpy_helper.from_array(a, key) for key, a in graph.constants.values()],
        ),
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
        producer_name="hyrl_mj",
    )
    helper.set_model_props(model, dict(metadata))
    onnx.checker.check_model(model)
    return model


def _described(name: str, operation: Operation) -> onnx.ValueInfoProto:
    kind = helper.np_dtype_to_tensor_dtype(operation.value.dtype)
    return helper.make_tensor_value_info(name, kind, ["n", *operation.value.shape[1:]])


class _Graph:
    """A graph in the making: nodes, constants, and what the result of each operation is called."""

    def __init__(self, program: Program) -> None:
        self.batch = program.inputs[0]
        self.names = {id(o): o.operands[0] for o in program.inputs}
        self.nodes: list[onnx.NodeProto] = []
        self.constants: dict[tuple[Any, ...], tuple[str, np.ndarray]] = {}

    def node(self, kind: str, *inputs: str, **attributes: Any) -> str:
        """Add a node; the name of what it gives."""
        result = f"{kind.lower()}_{len(self.nodes)}"
        # With a name: older versions of onnxruntime take nodes without one for the same node.
        self.nodes.append(helper.make_node(kind, list(inputs), [result], name=result, **attributes))
        return result

    def constant(self, value: Any, dtype: Any) -> str:
        """The name of a constant."""
        array = np.ascontiguousarray(np.asarray(value, dtype)).reshape(np.shape(value))
        key = (array.dtype.name, array.shape, array.tobytes())
        return self.constants.setdefault(key, (f"constant_{len(self.constants)}", array))[0]

    def get(self, operand: Any, dtype: Any = None) -> str:
        """The name of an operand, of this type."""
        if not isinstance(operand, Operation):
            return self.constant(operand, np.asarray(operand).dtype if dtype is None else dtype)
        name = self.names[id(operand)]
        same = dtype is None or dtype == operand.value.dtype
        return name if same else self.cast(name, dtype)

    def operands(self, operation: Operation, dtype: Any = None) -> list[str]:
        """The names of all operands, of this type or that of the result."""
        return [self.get(o, dtype or operation.value.dtype) for o in operation.operands]

    def cast(self, name: str, dtype: Any) -> str:
        return self.node("Cast", name, to=helper.np_dtype_to_tensor_dtype(np.dtype(dtype)))

    def shape(self, shape: tuple[int, ...]) -> str:
        """The name of a shape that has the size of the batch where the program had `BATCH`."""
        rows = self.node("Shape", self.get(self.batch), start=0, end=1)
        parts = [rows if size == BATCH else self.constant([size], np.int64) for size in shape]
        return self.node("Concat", *parts, axis=0)

    def lower(self, operation: Operation) -> str:
        """Add what an operation takes; the name of its result."""
        name, is_bool = operation.name, operation.value.dtype.kind == "b"
        if name in ELEMENTWISE:
            values = (o.value if isinstance(o, Operation) else o for o in operation.operands)
            # NumPy compares numbers in the type that they have in common.
            names = self.operands(operation, np.result_type(*values) if is_bool else None)
            return self.node(ELEMENTWISE[name], *names)
        if name in REDUCED:
            (x,), axes = self.operands(operation), operation.options["axis"]
            x = self.cast(x, np.int32) if is_bool else x
            keepdims = operation.options["keepdims"]
            x = self.node(REDUCED[name], x, self.constant(axes, np.int64), keepdims=keepdims)
            return self.cast(x, bool) if is_bool else x
        return LOWERED[name](self, operation)


def _getitem(g: _Graph, o: Operation) -> str:
    result, axis = g.get(o.operands[0]), 0
    sizes = iter(o.operands[0].value.shape)
    for item in o.options["item"]:
        if item is None:
            result = g.node("Unsqueeze", result, g.constant([axis], np.int64))
        else:
            size = next(sizes)
            if item != slice(None) if isinstance(item, slice) else True:
                picked = g.constant(np.arange(size)[item], np.int64)
                result = g.node("Gather", result, picked, axis=axis)
        axis += not isinstance(item, int)
    return result


def _where(g: _Graph, o: Operation) -> str:
    condition, *values = o.operands
    return g.node("Where", g.get(condition, bool), *(g.get(v, o.value.dtype) for v in values))


def _take(g: _Graph, o: Operation) -> str:
    array, indices = o.operands
    return g.node("Gather", g.get(array), g.get(indices, np.int64), **o.options)


def _remainder(g: _Graph, o: Operation) -> str:
    dtype, (x, y) = o.value.dtype, g.operands(o)
    if dtype.kind == "i":
        return g.node("Mod", x, y)
    # Of numbers that are not whole ONNX has the remainder of C, with the sign of x; NumPy's has that of y.
    zero, rest = g.constant(0, dtype), g.node("Mod", x, y, fmod=1)
    other_sign = g.node("Less", g.node("Mul", g.node("Sign", rest), g.node("Sign", y)), zero)
    return g.node("Where", other_sign, g.node("Add", rest, y), rest)


def _cos(g: _Graph, x: str, dtype: np.dtype) -> str:
    """cos(x) = 1 - 2 sin(x / 2)^2: older versions of onnxruntime have no cosine in float64."""
    half, one, two = (g.constant(number, dtype) for number in (0.5, 1, 2))
    sin = g.node("Sin", g.node("Mul", x, half))
    return g.node("Sub", one, g.node("Mul", two, g.node("Mul", sin, sin)))


def _arctan2(g: _Graph, o: Operation) -> str:
    """The angle of points, of which onnxruntime knows the arctan in float32 alone.

    That is a first guess, off by some 1e-7 rad. Turned back by it, a point lies so close to the x axis that
    the tangent of what is left is its angle.
    """
    dtype, (y, x) = o.value.dtype, g.operands(o)
    zero, pi = g.constant(0, dtype), g.constant(np.pi, dtype)
    # By |x|: a zero of x has a sign, too, which must not turn that of y.
    slope = g.cast(g.node("Div", y, g.node("Abs", x)), np.float32)
    ahead = g.cast(g.node("Atan", slope), dtype)
    half_turn = g.node("Where", g.node("Less", y, zero), g.node("Neg", pi), pi)
    behind = g.node("Sub", half_turn, ahead)
    guess = g.node("Where", g.node("Less", x, zero), behind, ahead)
    cos, sin = _cos(g, guess, dtype), g.node("Sin", guess)
    across = g.node("Sub", g.node("Mul", y, cos), g.node("Mul", x, sin))
    along = g.node("Add", g.node("Mul", x, cos), g.node("Mul", y, sin))
    angle = g.node("Add", guess, g.node("Div", across, along))
    origin = g.node("And", g.node("Equal", x, zero), g.node("Equal", y, zero))
    return g.node("Where", origin, zero, angle)


LOWERED: dict[str, Callable[[_Graph, Operation], str]] = {
    "getitem": _getitem,
    "astype": lambda g, o: g.get(o.operands[0], o.value.dtype),
    "reshape": lambda g, o: g.node("Reshape", g.get(o.operands[0]), g.shape(o.options["shape"])),
    "transpose": lambda g, o: g.node("Transpose", g.get(o.operands[0]), perm=o.options["axes"]),
    "argmax": lambda g, o: g.node("ArgMax", g.get(o.operands[0]), **o.options),
    "argmin": lambda g, o: g.node("ArgMin", g.get(o.operands[0]), **o.options),
    "where": _where,
    "concatenate": lambda g, o: g.node("Concat", *g.operands(o), **o.options),
    "full": lambda g, o: g.node("Expand", *g.operands(o), g.shape(o.options["shape"])),
    "take": _take,
    "remainder": _remainder,
    "cos": lambda g, o: _cos(g, g.operands(o)[0], o.value.dtype),
    "arctan2": _arctan2,
}
