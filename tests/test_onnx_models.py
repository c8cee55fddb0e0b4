"""ONNX models from strangers: what repeats, draws, reads files or takes too much is refused by name."""

import os

import numpy as np
import onnx
import pytest
from memory import Peak
from onnx import TensorProto, helper, numpy_helper
from sentences import refused

import hyrl_mj
from hyrl_mj import load_agent
from hyrl_mj.system import limits

FLOAT, INT, BOOL = TensorProto.FLOAT, TensorProto.INT64, TensorProto.BOOL
LINEAR = helper.make_node("Gemm", ["o", "w", "b"], ["g"], transB=1)


def tensor(name, value):
    return numpy_helper.from_array(np.asarray(value), name)


W, B = tensor("w", np.array([[0.5, -1]], np.float32)), tensor("b", np.zeros(1, np.float32))


def saved(folder, nodes, constants=(), *, outputs=("y",), functions=(), domains=()):
    """An ONNX file: after a linear layer "g" (n, 1) of the observation "o" come other nodes."""
    given = helper.make_tensor_value_info("o", FLOAT, ["n", 2])
    out = [helper.make_tensor_value_info(name, FLOAT, ["n", 1]) for name in outputs]
    graph = helper.make_graph([LINEAR, *nodes], "policy", [given], out, [W, B, *constants])
    opsets = [helper.make_opsetid("", 18), *[helper.make_opsetid(d, 1) for d in domains]]
    model = helper.make_model(graph, ir_version=9, opset_imports=opsets, functions=list(functions))
    path = folder / "a.onnx"
    path.write_bytes(model.SerializeToString())
    return path


def node(operator, inputs, outputs="y", **attributes):
    return helper.make_node(operator, inputs.split(), outputs.split(), **attributes)


def value(name, kind, shape):
    return helper.make_tensor_value_info(name, kind, shape)


BODY = helper.make_graph(
    [node("Identity", "c", "c2"), node("Add", "v v", "v2")],
    "body",
    [value("i", INT, []), value("c", BOOL, []), value("v", FLOAT, ["n", 1])],
    [value("c2", BOOL, []), value("v2", FLOAT, ["n", 1])],
)
COUNT = (tensor("N", np.int64(2**60)), tensor("C", np.bool_(True)))
HALF = helper.make_graph([node("Identity", "g", "z")], "h", [], [value("z", FLOAT, ["n", 1])])


def function(name, *nodes, domain="mine"):
    opsets = [helper.make_opsetid("", 18), helper.make_opsetid("mine", 1)]
    return helper.make_function(domain, name, ["a"], ["r"], list(nodes), opsets)


@pytest.mark.fast(1)
@pytest.mark.parametrize(
    ("nodes", "constants", "operator"),
    [
        ([node("Loop", "N C g", body=BODY)], COUNT, "Loop"),
        ([node("If", "C", then_branch=HALF, else_branch=HALF)], COUNT, "If"),
        ([node("RandomNormalLike", "g", "r"), node("Add", "g r")], (), "RandomNormalLike"),
        ([node("RandomUniform", "", "r", shape=[1]), node("Add", "g r")], (), "RandomUniform"),
        ([node("Sigmoid", "g", "s"), node("Bernoulli", "s")], (), "Bernoulli"),
        ([node("Dropout", "g R C")], (tensor("R", np.float32(0.5)), COUNT[1]), "Dropout"),
        (
            [node("SequenceConstruct", "g g", "s"), node("SequenceAt", "s Z")],
            (),
            "SequenceConstruct",
        ),
        ([node("Gelu", "g", domain="com.microsoft")], (), "com.microsoft.Gelu"),
        ([node("Add", "g g", domain="com.evil")], (), "com.evil.Add"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_an_operator_that_a_policy_does_not_need_is_named(
    nodes, constants, operator, circle, tmp_path
):
    path = saved(tmp_path, nodes, constants, domains=["com.microsoft", "com.evil"])
    refused(path, circle, f"its operator {operator} .*in Python, give a function of your own")


@pytest.mark.slow
def test_operators_inside_local_functions_are_seen(circle, tmp_path):
    draws = function("F", node("RandomNormalLike", "a", "x"), node("Add", "a x", "r"))
    outer = function("G", node("F", "a", "r", domain="mine"))
    call = node("G", "g", domain="mine")
    path = saved(tmp_path, [call], functions=[draws, outer], domains=["mine"])
    refused(path, circle, "operator RandomNormalLike")
    shadow = function("Relu", node("RandomNormalLike", "a", "r"), domain="")
    refused(saved(tmp_path, [node("Relu", "g")], functions=[shadow]), circle, "name of an operator")
    fine = function("G", node("Relu", "a", "r"))
    path = saved(tmp_path, [call], functions=[fine], domains=["mine"])
    np.testing.assert_allclose(load_agent(path, circle).inputs(np.array([[1.0, 0.25]])), [[0.25]])


@pytest.mark.long
@pytest.mark.slow
def test_functions_that_call_each_other_without_end_are_refused(circle, tmp_path):
    calls = [node(f"F{i}", "a", "m", domain="mine") for i in range(40)]
    again = [node(f"F{i}", "m", "r", domain="mine") for i in range(40)]
    functions = [function("F0", node("Relu", "a", "r"))]
    functions += [function(f"F{i + 1}", calls[i], again[i]) for i in range(39)]
    path = saved(tmp_path, [node("F39", "g", domain="mine")], functions=functions, domains=["mine"])
    refused(path, circle, "200 MB|longer than")
    path = saved(
        tmp_path, [node("F1", "g", domain="mine")], domains=["mine"],
        functions=[function("F1", node("F1", "a", "r", domain="mine"))],
    )  # fmt: skip
    refused(path, circle, "cannot be read")


@pytest.mark.slow
def test_a_model_is_read_as_it_was_examined(circle, tmp_path):
    """onnxruntime takes a file with these letters for one of its own, with any operators."""
    path = saved(tmp_path, [node("Tanh", "g")])
    unknown_field = b"\x7a\x06xxORTM"
    path.write_bytes(unknown_field + path.read_bytes())
    assert np.isfinite(
        load_agent(path, circle).act(np.zeros((1, circle.measurement_columns)))
    ).all()


@pytest.mark.slow
def test_a_model_without_outputs_is_refused(circle, tmp_path):
    refused(saved(tmp_path, [], outputs=()), circle, "it gives no output")


@pytest.mark.slow
@pytest.mark.parametrize("size", [2**27, 2**34, 2**60])
def test_a_model_that_needs_much_memory_is_refused(size, circle, tmp_path):
    sums = [
        node("ConstantOfShape", "S", "z"),
        node("ReduceSum", "z", "s", keepdims=0),
        node("Add", "g s"),
    ]
    path = saved(tmp_path, sums, [tensor("S", np.array([size]))])
    refused(path, circle, "200 MB of memory|cannot be read")


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="Windows has no limit on the processor's time")
def test_a_model_that_takes_long_is_refused(circle, tmp_path, monkeypatch):
    tried = limits.tried
    monkeypatch.setattr(
        limits, "tried", lambda *words, **most: tried(*words, **most | {"seconds": 1})
    )
    wide, square = (np.full((n, 2000), 1e-3, np.float32) for n in (1, 2000))
    chain = [node("MatMul", "g wide", "m0")]
    chain += [node("MatMul", f"m{i} square", f"m{i + 1}") for i in range(300)]
    chain += [node("ReduceMean", "m300 A")]
    constants = [tensor("wide", wide), tensor("square", square), tensor("A", np.array([1]))]
    refused(saved(tmp_path, chain, constants), circle, "it takes longer than 1 s")


@pytest.mark.slow
def test_sizes_that_depend_on_the_observation_are_refused(circle, tmp_path):
    count = [node("ReduceSum", "g", "s", keepdims=0), node("Cast", "s", "c", to=INT)]
    constants = [tensor("Z", np.int64(0)), tensor("E", np.int64(1))]
    values = [node("Range", "Z c E", "k"), node("Cast", "k", "f", to=FLOAT)]
    values += [node("ReduceSum", "f", "t", keepdims=0), node("Add", "g t")]
    path = saved(tmp_path, [*count, *values], constants)
    refused(path, circle, "the size of what its operator Range gives depends on the observation")


def test_operators_that_stand_in_another_order_are_refused(circle, tmp_path):
    nodes = [node("Expand", "g s", "e"), node("ReduceSum", "e"), node("Cast", "g", "s", to=INT)]
    refused(saved(tmp_path, nodes), circle, "Expand stands before what it takes is computed")


@pytest.mark.slow
def test_sizes_that_depend_on_the_number_of_observations_are_taken(circle, tmp_path):
    nodes = [node("Shape", "g", "s"), node("ConstantOfShape", "s", "z"), node("Add", "g z")]
    policy = load_agent(saved(tmp_path, nodes), circle)
    observation = np.random.default_rng(0).normal(size=(2500, 2))  # more than are run at once
    expected = np.clip(observation @ [[0.5], [-1]], -1, 1)
    np.testing.assert_allclose(policy.inputs(observation), expected, atol=1e-6)


@pytest.mark.slow
def test_only_numbers_of_rows_that_were_tried_are_run(circle, tmp_path):
    """A model that would take 8 GiB for batches of two rows, and for no others, never sees one."""
    nodes = [
        node("Shape", "o", "s"),
        node("Gather", "s Z", "n"),
        node("Equal", "n T", "e"),
        node("Where", "e M E", "k"),
        node("ConstantOfShape", "k", "z"),
        node("ReduceSum", "z", "t", keepdims=0),
        node("Add", "g t"),
    ]
    constants = [tensor("Z", np.array([0])), tensor("T", np.array([2])), tensor("E", np.array([1]))]
    path = saved(tmp_path, nodes, [*constants, tensor("M", np.array([2**31]))])
    policy, observation = load_agent(path, circle), np.array([[1.0, 0.25], [0.5, 0.1], [0.2, 0.3]])
    expected = np.clip(observation @ [[0.5], [-1]], -1, 1)
    with Peak() as memory:
        for n in (1, 2, 3):
            np.testing.assert_allclose(policy.inputs(observation[:n]), expected[:n], atol=1e-6)
    assert memory.megabytes < 1024


@pytest.mark.slow
def test_an_answer_that_depends_on_other_observations_is_refused(circle, tmp_path):
    nodes = [node("ReduceMean", "g A", "m", keepdims=1), node("Sub", "g m")]
    path = saved(tmp_path, nodes, [tensor("A", np.array([0]))])
    refused(path, circle, "depends on the other observations of the batch")


@pytest.mark.slow
def test_numbers_in_other_files_are_refused(circle, tmp_path):
    (tmp_path / "secret").write_bytes(np.ones(2, np.float32).tobytes())
    outside = tensor("w", np.ones((1, 2), np.float32))
    outside.ClearField("raw_data")
    outside.data_location = TensorProto.EXTERNAL
    entry = outside.external_data.add()
    entry.key, entry.value = "location", "secret"
    hidden = helper.make_node("Constant", [], ["e"], value=outside)
    message = "its numbers are in another file"
    path = saved(tmp_path, [hidden, node("Add", "g e")])
    refused(path, circle, message)
    model = onnx.load_model(path, load_external_data=False)
    del model.graph.node[1:]
    model.graph.node.append(node("Identity", "g"))
    model.graph.initializer[0].CopyFrom(outside)
    path.write_bytes(model.SerializeToString())
    refused(path, circle, message)


@pytest.mark.slow
def test_a_large_file_of_nothing_is_refused(circle, tmp_path):
    path = tmp_path / "a.onnx"
    path.write_bytes(bytes(2**25 + 1))
    refused(path, circle, "it is larger than 32 MiB")
    nodes = b"\x0a\x00" * 2**22  # nodes of two bytes, each an object of a hundred
    path.write_bytes(b"\x08\x09\x3a" + bytes([0x80, 0x80, 0x80, 0x04]) + nodes)
    refused(path, circle, "200 MB|operator")


@pytest.mark.slow
def test_the_models_of_exporters_are_taken(circle, vehicle, tmp_path):
    torch = pytest.importorskip("torch")
    for task, outputs in ((circle, 1), (vehicle, 5)):
        k = len(task.observation_low)
        layers = [torch.nn.Linear(k, 64), torch.nn.Tanh(), torch.nn.Linear(64, outputs)]
        module = torch.nn.Sequential(*layers)
        path = tmp_path / "t.onnx"
        torch.onnx.export(
            module, (torch.zeros(2, k),), path, dynamo=False,
            input_names=["o"], output_names=["y"], dynamic_axes={"o": {0: "n"}, "y": {0: "n"}},
        )  # fmt: skip
        observation = np.random.default_rng(0).normal(size=(50, k))
        ours = load_agent(path, task).inputs(observation)
        theirs = hyrl_mj.from_callable(module, task).inputs(observation)
        np.testing.assert_allclose(ours, theirs, atol=1e-5)
