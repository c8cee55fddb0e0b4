"""Writes what code does as plain NumPy, line by line."""

from __future__ import annotations

import json
from collections.abc import Iterable
from typing import Any

import numpy as np

from hyrl_mj.export.tracing import BATCH, Operation, Program

# Larger arrays are not written into the code.
FEW = 16
INFIX = {
    "add": "+", "subtract": "-", "multiply": "*", "divide": "/", "power": "**", "matmul": "@",
    "greater": ">", "greater_equal": ">=", "less": "<", "less_equal": "<=",
}  # fmt: skip


def write_function(
    name: str, sentence: str, program: Program, arrays: dict[str, np.ndarray]
) -> list[str]:
    """The lines of a Python function that does what a program does.

    Args:
        name: of the function.
        sentence: its docstring.
        program: with one input and one output.
        arrays: gets what is too large for a line, under names that begin with that of the function.
    """
    (argument,), (result,) = program.inputs, program.outputs
    names = {id(argument): argument.operands[0]}

    def write(x: Any) -> str:
        if isinstance(x, Operation):
            return names[id(x)]
        if isinstance(x, np.ndarray) and (x.size > FEW or not np.isfinite(x).all()):
            key = f"{name}_{sum(k.startswith(name) for k in arrays)}"
            arrays[key] = x
            return f"ARRAYS[{key!r}]"
        return literal(x)

    body = []
    for number, operation in enumerate(program.operations()):
        body.append(f"v{number} = {_expression(operation, write)}")
        names[id(operation)] = f"v{number}"
    if any("((n," in line or ", (n," in line for line in body):
        body.insert(0, f"n = len({argument.operands[0]})")
    lines = [f'"""{sentence}"""', *body, f"return {names[id(result)]}"]
    return [f"def {name}({argument.operands[0]}):", *(f"    {line}" for line in lines)]


def _expression(operation: Operation, write: Any) -> str:
    name, options = operation.name, operation.options
    operands = [write(o) for o in operation.operands]
    if name in INFIX:
        return f"{operands[0]} {INFIX[name]} {operands[1]}"
    if name == "getitem":
        return f"{operands[0]}[{_listed(map(_index, options['item']))}]"
    if name == "astype":
        return f"{operands[0]}.astype(np.{_name(options['dtype'])})"
    if name == "full":
        return f"np.full({_shape(options['shape'])}, {operands[0]}, dtype=np.{_name(options['dtype'])})"
    if name == "reshape":
        return f"np.reshape({operands[0]}, {_shape(options['shape'])})"
    if name == "concatenate":
        operands = [f"[{_listed(operands)}]"]
    return f"np.{name}({_listed([*operands, *(f'{k}={literal(v)}' for k, v in options.items())])})"


def _listed(parts: Iterable[str]) -> str:
    return ", ".join(parts)


def _shape(shape: tuple[int, ...]) -> str:
    return _tuple("n" if size == BATCH else str(size) for size in shape)


def _tuple(parts: Iterable[str]) -> str:
    parts = list(parts)
    return f"({_listed(parts)}{',' * (len(parts) == 1)})"


def _index(item: Any) -> str:
    if isinstance(item, slice):
        parts = ["" if i is None else str(int(i)) for i in (item.start, item.stop, item.step)]
        return ":".join(parts if parts[2] else parts[:2])
    return str(item.tolist()) if isinstance(item, np.ndarray) else str(item)


def literal(x: Any) -> str:
    """Python source of numbers, arrays, tuples, text and None that gives them back to the last bit."""
    if isinstance(x, np.ndarray):
        as_it_is = np.array(x.tolist()).dtype == x.dtype
        dtype = "" if as_it_is else f", dtype=np.{_name(x.dtype)}"
        return f"np.array({literal(x.tolist())}{dtype})"
    if isinstance(x, np.generic):
        return f"np.{_name(x.dtype)}({literal(x.item())})"
    if isinstance(x, list):
        return f"[{_listed(map(literal, x))}]"
    if isinstance(x, tuple):
        return _tuple(map(literal, x))
    if isinstance(x, str):
        return json.dumps(x, ensure_ascii=False)
    if isinstance(x, float):
        return repr(float(x)) if np.isfinite(x) else f"float({str(float(x))!r})"
    return repr(int(x) if isinstance(x, int) and not isinstance(x, bool) else x)


def _name(dtype: str | np.dtype) -> str:
    """What NumPy calls a type, in versions 1 and 2."""
    name = np.dtype(dtype).name
    return "bool_" if name == "bool" else name
