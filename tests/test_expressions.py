"""Success and failure as expressions: what they mean, and that nothing else is read, let alone run."""

import contextlib
import math

import numpy as np
import pytest
from hypothesis import given, strategies as st

from hyrl_mj.errors import BadInput
from hyrl_mj.gym_import.expressions import DEPTH, LENGTH, Expression, entry

TERMINATED = np.array([False, True, False, True])
TRUNCATED = np.array([False, False, True, True])
REWARD = np.array([-1.0, 0.0, 0.5, 2.0])
SUCCESS = np.array([0.0, 1.0, math.nan, 1.0])  # missing at the third copy
VALUES = {
    "terminated": TERMINATED,
    "truncated": TRUNCATED,
    "reward": REWARD,
    ("info", ("success",)): SUCCESS,
    ("info", ("a", "b", -1)): REWARD * 2,
    ("distance", "fingertip", "target"): np.array([0.3, 0.2, 0.1, 0.0]),
    ("distance", "arm/finger tip", "goal-tip.x"): np.array([0.0, 0.1, 0.2, 0.3]),
}


@pytest.mark.parametrize(
    ("text", "holds"),
    [
        ("terminated", [0, 1, 0, 1]),
        (" not terminated ", [1, 0, 1, 0]),
        ("terminated and not truncated", [0, 1, 0, 0]),
        ("terminated or truncated and reward > 1", [0, 1, 0, 1]),
        ("(terminated or truncated) and reward > 1", [0, 0, 0, 1]),
        ("0 < reward < 1", [0, 0, 1, 0]),
        ("0 < 1 < reward", [0, 0, 0, 1]),
        ("1 < 2 and terminated", [0, 1, 0, 1]),
        ("reward >= -1", [1, 1, 1, 1]),
        ("reward == 0.5", [0, 0, 1, 0]),
        ("reward != 0", [1, 0, 1, 1]),
        ("abs(reward - 0.5) * 2 <= +1", [0, 1, 1, 0]),
        ("1 / reward > 0", [0, 0, 1, 1]),  # a quotient by 0 is none, not infinity
        ("1 / reward != 0", [1, 0, 1, 1]),
        ('info["success"]', [0, 1, 0, 1]),
        ("not info['success']", [1, 0, 1, 0]),
        ('info["success"] != 1', [1, 0, 0, 0]),  # no comparison holds with what is missing
        ('info["success"] == 1 or info["success"] < 1', [1, 1, 0, 1]),
        ('info["a"]["b"][-1] >= 1', [0, 0, 1, 1]),
        ("distance(fingertip, target) <= 0.1", [0, 0, 1, 1]),
        ("distance('arm/finger tip', 'goal-tip.x') <= 0.1", [1, 1, 0, 0]),
        ("(terminated\n or truncated)", [0, 1, 1, 1]),
    ],
)
def test_an_expression_holds_where_it_says(text, holds):
    found = Expression.parse(text).holds(VALUES)
    assert found.dtype == bool
    assert found.tolist() == [bool(x) for x in holds]


def test_an_expression_tells_what_it_needs_each_once_and_in_order():
    text = 'info["b"] or info["a"][0] > 1 or info["b"] or distance("y", x) < distance(x, y) < distance(y, x)'
    expression = Expression.parse(text, "failure")
    assert expression.text == text
    assert expression.what == "failure"
    of_info = ("info", ("b",)), ("info", ("a", 0))
    assert expression.asked == (*of_info, ("distance", "y", "x"), ("distance", "x", "y"))
    assert expression == Expression.parse(text, "failure")


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("", "is empty"),
        ("reward", "neither true nor false"),
        ("1 + 2", "neither true nor false"),
        ("terminated and reward", "neither true nor false"),
        ("info['a'] + 1", "neither true nor false"),
        ("distance(a, b)", "neither true nor false"),
        ("True", "the same at every step"),
        ("terminated or True", "the same at every step"),
        ("1 < 2", "asks nothing"),
        ("rewrad > 1", "did you mean reward"),
        ("speed > 1", "'speed' is not known: use terminated"),
        ("info", "name one of them"),
        ("info[0]", "with quotes"),
        ("info[key]", "with quotes"),
        ("info['a':'b']", "with quotes"),
        ("info['a'][True]", "with quotes"),
        ("reward['a'] > 1", "with quotes"),
        ("terminated == 1", "no number"),
        ("abs(terminated) > 0", "no number"),
        ("info['a'] == 'b'", "nothing else can be compared"),
        ("info['a'] == None", "nothing else can be compared"),
        ("reward > 1j", "nothing else can be compared"),
        ("reward > 1e400", "no finite number"),
        ("reward > " + "9" * 400, "no finite number"),
        ("reward > nan", "no finite number"),
        ("reward > -inf", "no finite number"),
        ("reward > 1 / 0", "no finite number"),
        ("reward = 1", "is no expression"),
        ("reward => 1", "is no expression"),
        ("reward > 1; terminated", "is no expression"),
        ("import os", "is no expression"),
        ("reward > '\\d'", "is no expression"),
        ("reward > 1\0", "cannot be used"),
        ("\ud800 > 1", "Python cannot read it"),
        ("reward & 1", "for truths, and, or"),
        ("reward ** 2 > 1", "for truths, and, or"),
        ("~terminated", "not instead of ~"),
        ("reward is 1", "use <, <="),
        ("reward in (1, 2)", "is not allowed"),
        ("print(1)", "only distance"),
        ("abs(1, 2) > 1", "only distance"),
        ("__import__('os').system('true')", "only distance"),
        ("info.get('a')", "only distance"),
        ("reward.real > 1", "is not allowed"),
        ("lambda: 1", "is not allowed"),
        ("[x for x in info]", "is not allowed"),
        ("(x := 1) > 0", "is not allowed"),
        ("f'{reward}' > 1", "is not allowed"),
        ("terminated if truncated else terminated", "is not allowed"),
        ("distance(a) < 1", "two names"),
        ("distance(a, b, c) < 1", "two names"),
        ("distance(a, b=1) < 1", "two names"),
        ("distance('', b) < 1", "no name of the model: quote"),
        ("distance(a/b, c) < 1", "no name of the model: quote"),
        ("distance(site-01, b) < 1", "quote names"),
        ("distance(body 1, b) < 1", "quote names"),
        ("x" * 5000, f"at most {LENGTH}"),
        ("(" * 1000 + "terminated" + ")" * 1000, f"at most {LENGTH}"),
        ("(" * 400 + "terminated" + ")" * 400, "cannot be used"),
        ("not " * (DEPTH + 1) + "terminated", "nested deeper"),
        ("-" * 900 + "1 < reward", "nested deeper"),
        ("reward" + "[0]" * 300, "with quotes"),
    ],
)
def test_anything_else_is_one_sentence(text, why):
    with pytest.raises(BadInput, match=why) as error:
        Expression.parse(text, "failure")
    sentence = str(error.value)
    assert sentence.startswith("failure ")
    assert len(sentence) <= 300
    assert "\n" not in sentence


@pytest.mark.slow
@given(st.text(max_size=60) | st.text("abdeinorstw()[]\"'<>=.,+-*/~ 01", max_size=40))
def test_any_text_is_an_expression_or_refused(text):
    with contextlib.suppress(BadInput):
        Expression.parse(text)


NUMBERS = st.sampled_from(["reward", "0.5", "-1", "info['x']", "distance(a, b)"])
COMPARED = st.builds(
    "{} {} {}".format, NUMBERS, st.sampled_from(["<", "<=", ">", ">=", "==", "!="]), NUMBERS
)
TRUTHS = st.recursive(
    COMPARED | st.sampled_from(["terminated", "truncated"]),
    lambda inner: st.builds("({} {} {})".format, inner, st.sampled_from(["and", "or"]), inner)
    | st.builds("(not {})".format, inner),
    max_leaves=8,
)  # fmt: skip


@given(TRUTHS, st.tuples(*[st.sampled_from([-1.0, 0.0, 0.5])] * 3), st.booleans(), st.booleans())
def test_expressions_mean_what_python_means(text, numbers, terminated, truncated):
    reward, entry_x, far = numbers
    names = {
        "terminated": terminated, "truncated": truncated, "reward": reward, "info": {"x": entry_x},
        "distance": lambda a, b: far, "a": 0, "b": 0,
    }  # fmt: skip
    values = {
        "terminated": np.array([terminated]), "truncated": np.array([truncated]),
        "reward": np.array([reward]), ("info", ("x",)): np.array([entry_x]),
        ("distance", "a", "b"): np.array([far]),
    }  # fmt: skip
    if any(name in text for name in ("terminated", "truncated", "reward", "info", "distance")):
        assert bool(Expression.parse(text).holds(values)[0]) is bool(
            eval(text, names)
        )  # generated above


def test_an_entry_that_is_no_truth_is_refused_when_it_shows():
    expression = Expression.parse('reward > 0 or info["success"]')
    with pytest.raises(
        BadInput, match=r"""info\["success"\] is 0.37, neither true nor false: compare"""
    ):
        expression.holds({"reward": np.ones(2), ("info", ("success",)): np.array([1.0, 0.37])})


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("flag",), 1.0),
        (("count",), 3.0),
        (("array",), 0.5),
        (("list", 1), 2.0),
        (("list", -1), 2.0),
        (("inner", "x", 0), 7.0),
        (("absent",), math.nan),
        (("list", 5), math.nan),
        (("inner", "absent", 0), math.nan),
        (("nothing",), math.nan),
    ],
)
def test_entries_are_numbers_or_missing(path, value):
    info = {
        "flag": np.True_, "count": 3, "array": np.array([0.5]), "list": [1, 2],
        "inner": {"x": np.array([7, 8])}, "nothing": None,
    }  # fmt: skip
    assert np.array_equal(entry(info, path), value, equal_nan=True)


@pytest.mark.parametrize(
    "path", [("text",), ("list",), ("complex",), ("number", "x"), ("list", "x"), ("text", 0)]
)
def test_entries_of_other_kinds_are_refused(path):
    with pytest.raises(BadInput, match="is of type"):
        entry({"text": "goal", "list": [1, 2], "complex": np.array(1j), "number": 1.0}, path)
