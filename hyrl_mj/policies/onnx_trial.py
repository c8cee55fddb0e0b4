"""A program that examines and tries an ONNX model within limits of time and memory; see `onnx_model`.

It runs in a process of its own, `python onnx_trial.py SECONDS MEMORY COLUMNS ROWS TASK < model`, and writes a
JSON object: the names of `input` and `output` of the model, and whether it takes `batches` or one observation
at a time; or the `problem` because of which it is refused, or an `error` of the reader.
"""

import json
import runpy
import sys
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime

SINGLY = 32  # calls of a model that takes one observation at a time
# A policy is made of these operators. Others repeat, branch, draw, read files, or belong to a vendor.
OPERATORS = {
    "Abs", "Acos", "Acosh", "Add", "And", "ArgMax", "ArgMin", "Asin", "Asinh", "Atan", "Atanh",
    "AveragePool", "BatchNormalization", "Cast", "CastLike", "Ceil", "Celu", "Clip", "Concat", "Constant",
    "ConstantOfShape", "Conv", "Cos", "Cosh", "CumSum", "DequantizeLinear", "Div", "Dropout", "Einsum",
    "Elu", "Equal", "Erf", "Exp", "Expand", "Flatten", "Floor", "Gather", "GatherElements", "GatherND",
    "Gelu", "Gemm", "GlobalAveragePool", "GlobalMaxPool", "Greater", "GreaterOrEqual", "GroupNormalization",
    "HardSigmoid", "HardSwish", "Hardmax", "Identity", "InstanceNormalization", "IsInf", "IsNaN",
    "LayerNormalization", "LeakyRelu", "Less", "LessOrEqual", "Log", "LogSoftmax", "LpNormalization",
    "MatMul", "Max", "MaxPool", "Mean", "MeanVarianceNormalization", "Min", "Mish", "Mod", "Mul", "Neg",
    "Not", "OneHot", "Or", "PRelu", "Pad", "Pow", "QuantizeLinear", "RMSNormalization", "Range",
    "Reciprocal", "ReduceL1", "ReduceL2", "ReduceLogSum", "ReduceLogSumExp", "ReduceMax", "ReduceMean",
    "ReduceMin", "ReduceProd", "ReduceSum", "ReduceSumSquare", "Relu", "Reshape", "Round",
    "ScatterElements", "ScatterND", "Selu", "Shape", "Shrink", "Sigmoid", "Sign", "Sin", "Sinh", "Size",
    "Slice", "Softmax", "Softplus", "Softsign", "Split", "Sqrt", "Squeeze", "Sub", "Sum", "Swish", "Tan",
    "Tanh", "ThresholdedRelu", "Tile", "TopK", "Transpose", "Trilu", "Unsqueeze", "Where", "Xor",
}  # fmt: skip
# The inputs that set the size of an operator's output: they must not depend on the observation.
SIZES = {
    "ConstantOfShape": (0,), "Expand": (1,), "OneHot": (1,), "Pad": (1, 3), "Range": (0, 1, 2),
    "Reshape": (1,), "Slice": (1, 2, 3, 4), "Split": (1,), "Squeeze": (1,), "Tile": (1,), "TopK": (1,),
    "Unsqueeze": (1,),
}  # fmt: skip


class Refused(Exception):
    """The model is not run."""


def check(model: onnx.ModelProto) -> None:
    """Raises `Refused` if a model has an operator or a reference that a policy does not need."""
    for function in model.functions:
        if function.domain in ("", "ai.onnx"):
            raise Refused(f"it has a function with the name of an operator, {function.name}")
    if model.functions:
        from onnx.inliner import inline_local_functions

        model = inline_local_functions(model)
    graph = model.graph
    tensors = list(graph.initializer)
    tensors += [t for s in graph.sparse_initializer for t in (s.values, s.indices)]
    constants = {tensor.name for tensor in graph.initializer}
    seen = {value.name for value in graph.input} - constants
    known = seen | constants | {s.values.name for s in graph.sparse_initializer} | {""}
    for node in graph.node:
        if not known.issuperset(node.input):  # onnxruntime would sort them
            raise Refused(f"its operator {node.op_type} stands before what it takes is computed")
        known.update(node.output)
        if node.domain not in ("", "ai.onnx") or node.op_type not in OPERATORS:
            name = ".".join(filter(None, (node.domain, node.op_type)))
            raise Refused(f"its operator {name} is none that a policy needs")
        if node.op_type == "Dropout" and len(node.input) > 2 and node.input[2]:
            raise Refused("its operator Dropout draws random numbers")
        sizes = [node.input[i] for i in SIZES.get(node.op_type, ()) if i < len(node.input)]
        if seen.intersection(sizes):
            raise Refused(
                f"the size of what its operator {node.op_type} gives depends on the observation"
            )
        if node.op_type not in ("Shape", "Size") and seen.intersection(node.input):
            seen.update(node.output)
        for attribute in node.attribute:
            tensors += [attribute.t, *attribute.tensors]
            tensors += [attribute.sparse_tensor.values, attribute.sparse_tensor.indices]
    if any(t.external_data or t.data_location == onnx.TensorProto.EXTERNAL for t in tensors):
        raise Refused("its numbers are in another file (external data): save it in one file")


def _last_operator(graph: onnx.GraphProto) -> str:
    """Returns the operator that gives the numbers of the first output, before it is only shaped or cast."""
    nodes, name = (
        {output: node for node in graph.node for output in node.output},
        graph.output[0].name,
    )
    while (node := nodes.get(name)) and node.op_type in (
        "Identity",
        "Cast",
        "Reshape",
        "Squeeze",
        "Flatten",
    ):
        name = node.input[0]
    return node.op_type if node else ""


def session_of(content: bytes) -> Any:
    """Returns onnxruntime's session of a model, on one thread."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4  # errors are raised, too
    # Else a content that is both would be read as a file of onnxruntime's own, which nobody has examined.
    options.add_session_config_entry("session.load_model_format", "ONNX")
    return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])


def examine(content: bytes, columns: int, rows: int, task: str) -> dict[str, Any]:
    """Returns what is known of a model, after it has answered random observations more than once.

    Raises:
        Refused: it is not run, or it is no function of the observation.
    """
    check(model := onnx.load_model_from_string(content))
    session = session_of(content)
    inputs = session.get_inputs()
    outputs = [o.name for o in session.get_outputs()]
    if not outputs:
        raise Refused("it gives no output")
    if len(inputs) != 1 or inputs[0].type != "tensor(float)" or len(inputs[0].shape) != 2:
        takes = ", ".join(f"{i.name}: {i.type} of shape {list(i.shape)}" for i in inputs)
        raise Refused(
            f"the model takes {takes or 'nothing'}: it has to take one input, observations (n, {columns}) "
            "float32"
        )
    name, (batch, width) = inputs[0].name, inputs[0].shape
    if isinstance(width, int) and width != columns:
        raise Refused(f"the model takes {width} numbers, an observation of {task} has {columns}")
    if isinstance(batch, int) and batch != 1:
        raise Refused(
            f"the model takes {batch} observations at a time: export it for any number of them, or for one"
        )
    _try(lambda o: session.run(outputs[:1], {name: o})[0], columns, rows, batch == 1)
    squashed = _last_operator(model.graph) == "Tanh"
    return {"input": name, "output": outputs[0], "batches": batch != 1, "squashed": squashed}


def _try(answer: Any, columns: int, rows: int, one: bool) -> None:
    """Raises `Refused` if the model answers an observation otherwise the second time, or beside others."""
    observation = np.random.default_rng(0).normal(size=(rows, columns)).astype(np.float32)
    if one:
        parts = np.split(observation[:SINGLY], SINGLY)
        first, again = (np.concatenate([answer(part) for part in parts]) for _ in range(2))
    else:
        first, again = answer(observation), answer(observation)
    if not np.array_equal(first, again, equal_nan=first.dtype.kind == "f"):
        raise Refused("it answers the same observations otherwise the second time")
    if one:
        return
    if not first.shape or len(first) != rows:
        return  # reported with its shape where it is first used
    one_by_one = [answer(observation[i : i + 1]) for i in range(SINGLY)]
    fewer = answer(np.ascontiguousarray(observation[:1:-2]))
    if {len(part) for part in one_by_one} != {1} or len(fewer) != len(first[:1:-2]):
        raise Refused("its number of answers is not that of the observations")
    # Sums in another order differ in their last digits.
    found, expected = (
        np.concatenate([*one_by_one, fewer]),
        np.concatenate([first[:SINGLY], first[:1:-2]]),
    )
    same = np.isclose(found, expected, rtol=1e-3, atol=1e-4, equal_nan=True)
    if np.mean(same) < 0.99:
        raise Refused("its answer to an observation depends on the other observations of the batch")


def main() -> None:
    *numbers, task = sys.argv[1:]
    seconds, memory, columns, rows = map(int, numbers)
    content = sys.stdin.buffer.read()
    limits = runpy.run_path(str(Path(__file__).parents[1] / "system" / "limits.py"))
    limits["limit"](seconds, memory)
    result: dict[str, Any]
    try:
        result = examine(content, columns, rows, task)
    except Refused as refused:
        result = {"problem": str(refused)}
    except MemoryError:
        result = {"problem": f"it needs more than {memory >> 20} MB of memory"}
    except Exception as error:  # of the readers, whose errors are of many kinds
        text = " ".join(str(error).split())
        result = {"error": f"{type(error).__name__}: {text[:160]}"}
        if "alloc" in text.lower():
            result = {"problem": f"it needs more than {memory >> 20} MB of memory"}
    json.dump(result, sys.stdout)


if __name__ == "__main__":
    main()
