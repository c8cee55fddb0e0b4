"""Writes a traced program as NumPy source, one operation a line."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import numpy as np

from hyrl_mj.tracing import BATCH, Operation, Program

# Operations that are not written as a call of the function of their name.
WRITTEN = {
    "add": "{} + {}", "subtract": "{} - {}", "multiply": "{} * {}", "divide": "{} / {}",
    "power": "({}) ** {}", "matmul": "{} @ {}", "greater": "{} > {}", "greater_equal": "{} >= {}",
    "less": "{} < {}", "less_equal": "{} <= {}", "astype": "{}.astype({dtype})",
    "reshape": "np.reshape({}, {shape})", "full": "np.full({shape}, {}, dtype={dtype})",
}  # fmt: skip


def write_function(
    name: str, sentence: str, program: Program, arrays: dict[str, np.ndarray]
) -> str:
    """Returns the source of a Python function that computes a program.

    Args:
        name: the name of the function.
        sentence: its docstring.
        program: its inputs are the arguments; with several outputs the function returns a tuple.
        arrays: receives constants of more than 16 elements, under names that begin with `name`.
    """
    arguments = [argument.operands[0] for argument in program.inputs]
    names = dict(zip(program.inputs, arguments, strict=True))

    def write(x: Any) -> str:
        if isinstance(x, Operation):
            return names[x]
        if isinstance(x, np.ndarray) and (x.size > 16 or not np.isfinite(x).all()):
            key = f"{name}_{sum(k.startswith(name) for k in arrays)}"
            arrays[key] = x
            return f"ARRAYS[{key!r}]"
        return _literal(x)

    body, operations = [], program.operations()
    if any(BATCH in operation.options.get("shape", ()) for operation in operations):
        body.append(f"n = len({arguments[0]})")
    for number, operation in enumerate(operations):
        body.append(f"v{number} = {_expression(operation, write)}")
        names[operation] = f"v{number}"
    head = [f"def {name}({', '.join(arguments)}):", f'"""{sentence}"""']
    results = ", ".join(names[result] for result in program.outputs)
    return "\n    ".join([*head, *body, f"return {results}"])


def _expression(operation: Operation, write: Callable[[Any], str]) -> str:
    name = operation.name
    operands = [write(o) for o in operation.operands]
    options = {k: re.sub(rf"\b{BATCH}\b", "n", repr(v)) for k, v in operation.options.items()}
    if name in WRITTEN:
        return WRITTEN[name].format(*operands, **options)
    if name == "concatenate":
        operands = [f"[{', '.join(operands)}]"]
    return f"np.{name}({', '.join([*operands, *(f'{k}={v}' for k, v in options.items())])})"


def _literal(x: Any) -> str:
    """Returns the source of a number or an array, which gives it back to the last bit."""
    value = np.asarray(x).tolist()
    text = repr(value) if np.isfinite(x).all() else f"float('{value}')"
    if isinstance(x, np.ndarray):
        is_default = np.array(value).dtype == x.dtype
        return f"np.array({text})" if is_default else f"np.array({text}, dtype='{x.dtype}')"
    # NumPy 1 has no np.bool.
    is_typed = isinstance(x, np.generic) and not isinstance(x, np.bool_)
    return f"np.{x.dtype}({text})" if is_typed else text
