"""Writes a traced program as an ONNX graph."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import onnx
from onnx import helper, numpy_helper

from hyrl_mj.tracing import BATCH, ELEMENTWISE, Operation, Program, Traced, apply

REDUCED = {
    "sum": "ReduceSum", "max": "ReduceMax", "min": "ReduceMin", "any": "ReduceMax", "all": "ReduceMin",
}  # fmt: skip


def write_graph(
    program: Program, outputs: Sequence[str], name: str, metadata: Mapping[str, str]
) -> onnx.ModelProto:
    """Returns a model that computes a program, with these names of its outputs, for batches of any size.

    Inputs and outputs of the program have one row for each row of the batch.
    """
    graph = _Graph(program)
    results = list(zip(outputs, program.outputs, strict=True))
    with np.errstate(all="ignore"):
        for operation in program.operations():
            graph.get(operation)
    graph.nodes += [helper.make_node("Identity", [graph.get(o)], [n], name=n) for n, o in results]
    model = helper.make_model(
        helper.make_graph(
            graph.nodes,
            name,
            [_described(o.operands[0], o) for o in program.inputs],
            [_described(n, o) for n, o in results],
            [numpy_helper.from_array(a, key) for key, a in graph.constants.values()],
        ),
        # The versions that the oldest supported onnxruntime reads.
        opset_imports=[helper.make_opsetid("", 18)],
        ir_version=8,
        producer_name="hyrl_mj",
    )
    helper.set_model_props(model, dict(metadata))
    onnx.checker.check_model(model)
    return model


def _described(name: str, operation: Operation) -> onnx.ValueInfoProto:
    kind = helper.np_dtype_to_tensor_dtype(operation.value.dtype)
    return helper.make_tensor_value_info(name, kind, ["n", *operation.value.shape[1:]])


class _Graph:
    """A graph under construction: its nodes, its constants, and the names of the operations' results."""

    def __init__(self, program: Program) -> None:
        self.batch = program.inputs[0]
        self.names: dict[Operation, str] = {o: o.operands[0] for o in program.inputs}
        self.nodes: list[onnx.NodeProto] = []
        self.constants: dict[tuple[Any, ...], tuple[str, np.ndarray]] = {}

    def node(self, kind: str, *inputs: str, **attributes: Any) -> str:
        """Adds a node; returns the name of its result."""
        result = f"{kind.lower()}_{len(self.nodes)}"
        # The node has a name, too: older versions of onnxruntime confuse nodes without one.
        self.nodes.append(helper.make_node(kind, list(inputs), [result], name=result, **attributes))
        return result

    def constant(self, value: Any, dtype: Any) -> str:
        """Returns the name of a constant."""
        array = np.ascontiguousarray(np.asarray(value, dtype)).reshape(np.shape(value))
        key = (array.dtype.name, array.shape, array.tobytes())
        return self.constants.setdefault(key, (f"constant_{len(self.constants)}", array))[0]

    def get(self, operand: Any, dtype: Any = None) -> str:
        """Returns the name of an operand, converted to a type if one is given."""
        if not isinstance(operand, Operation):
            return self.constant(operand, np.asarray(operand).dtype if dtype is None else dtype)
        if operand not in self.names:
            self.names[operand] = self.lower(operand)
        name = self.names[operand]
        return name if dtype is None or dtype == operand.value.dtype else self.cast(name, dtype)

    def operands(self, operation: Operation, dtype: Any = None) -> list[str]:
        """Returns the names of all operands, in this type or that of the result."""
        return [self.get(o, dtype or operation.value.dtype) for o in operation.operands]

    def cast(self, name: str, dtype: Any) -> str:
        """Converts a result to a type; returns the name of the converted one."""
        return self.node("Cast", name, to=helper.np_dtype_to_tensor_dtype(np.dtype(dtype)))

    def shape(self, operation: Operation) -> str:
        """Returns the name of a shape, with the size of the batch in place of `BATCH`."""
        rows = self.node("Shape", self.get(self.batch), start=0, end=1)
        sizes = operation.options["shape"]
        parts = [rows if size == BATCH else self.constant([size], np.int64) for size in sizes]
        return self.node("Concat", *parts, axis=0)

    def lower(self, operation: Operation) -> str:
        """Adds the nodes of an operation; returns the name of its result."""
        name, dtype = operation.name, operation.value.dtype
        is_bool = dtype.kind == "b"
        if name in EXPANDED:
            operands = (
                Traced(o).astype(dtype) if isinstance(o, Operation) else np.asarray(o, dtype)
                for o in operation.operands
            )
            return self.get(EXPANDED[name](*operands).operation)
        if name in ELEMENTWISE:
            values = (o.value if isinstance(o, Operation) else o for o in operation.operands)
            # NumPy compares numbers in the type that they have in common.
            common = np.result_type(*values) if is_bool else None
            return self.node(ELEMENTWISE[name], *self.operands(operation, common))
        if name in REDUCED:
            # ONNX has no reductions of bool.
            (x,) = self.operands(operation, np.int32 if is_bool else None)
            axes, keepdims = operation.options["axis"], operation.options["keepdims"]
            x = self.node(REDUCED[name], x, self.constant(axes, np.int64), keepdims=keepdims)
            return self.cast(x, bool) if is_bool else x
        return LOWERED[name](self, operation)


LOWERED: dict[str, Callable[[_Graph, Operation], str]] = {
    "astype": lambda g, o: g.get(o.operands[0], o.value.dtype),
    "reshape": lambda g, o: g.node("Reshape", g.get(o.operands[0]), g.shape(o)),
    "transpose": lambda g, o: g.node("Transpose", g.get(o.operands[0]), perm=o.options["axes"]),
    "argmax": lambda g, o: g.node("ArgMax", g.get(o.operands[0]), **o.options),
    "argmin": lambda g, o: g.node("ArgMin", g.get(o.operands[0]), **o.options),
    "where": lambda g, o: g.node(
        "Where", g.get(o.operands[0], bool), *(g.get(x, o.value.dtype) for x in o.operands[1:])
    ),
    "concatenate": lambda g, o: g.node("Concat", *g.operands(o), **o.options),
    "full": lambda g, o: g.node("Expand", *g.operands(o), g.shape(o)),
    "take": lambda g, o: g.node(
        "Gather", g.get(o.operands[0]), g.get(o.operands[1], np.int64), **o.options
    ),
    "fmod": lambda g, o: g.node("Mod", *g.operands(o), fmod=1),
}


# ---- operations that ONNX or onnxruntime lacks, as combinations of others


def _cos(x: Any) -> Any:
    """Returns 1 - 2 sin(x / 2)^2: older versions of onnxruntime have no cosine in float64."""
    sin = np.sin(x / 2)
    return 1 - 2 * sin * sin


def _remainder(x: Any, y: Any) -> Any:
    """Returns the remainder with the sign of y, from that of C, which has the sign of x."""
    rest = apply("fmod", x, y)
    return np.where(np.sign(rest) * np.sign(y) < 0, rest + y, rest)


def _arctan2(y: Any, x: Any) -> Any:
    """Returns the angles of points (x, y) in float64; onnxruntime has the arctan in float32 alone.

    The float32 angle is a first guess, off by some 1e-7 rad. Turned back by it, a point lies so close to the
    x axis that the tangent of the remaining angle is that angle.
    """
    # By |x|: a zero of x has a sign, too, which must not turn that of y.
    ahead = apply("arctan", (y / np.absolute(x)).astype(np.float32)).astype(x.dtype)
    guess = np.where(x < 0, np.where(y < 0, -np.pi - ahead, np.pi - ahead), ahead)
    cos, sin = _cos(guess), np.sin(guess)
    angle = guess + (y * cos - x * sin) / (x * cos + y * sin)
    return np.where((x == 0) & (y == 0), 0.0, angle)


EXPANDED: dict[str, Callable[..., Any]] = {
    "cos": _cos,
    "remainder": _remainder,
    "arctan2": _arctan2,
}
