"""Writes what code does as plain NumPy, line by line."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from hyrl_mj.export.traced_array import Operation, Program
from hyrl_mj.export.vocabulary import BATCH

_listed = ", ".join
# Larger arrays are not written into the code.
FEW = 16
# Operations that are not written as the call of a function of their name.
WRITTEN = {
    "add": "{} + {}", "subtract": "{} - {}", "multiply": "{} * {}", "divide": "{} / {}",
    "power": "({}) ** {}", "matmul": "{} @ {}", "greater": "{} > {}", "greater_equal": "{} >= {}",
    "less": "{} < {}", "less_equal": "{} <= {}", "getitem": "{}[{item}]",
    "astype": "{}.astype({dtype})", "reshape": "np.reshape({}, {shape})",
    "full": "np.full({shape}, {}, dtype={dtype})",
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

    body, operations = [], program.operations()
    if any(BATCH in operation.options.get("shape", ()) for operation in operations):
        body.append(f"n = len({argument.operands[0]})")
    for number, operation in enumerate(operations):
        body.append(f"v{number} = {_expression(operation, write)}")
        names[id(operation)] = f"v{number}"
    lines = [f'"""{sentence}"""', *body, f"return {names[id(result)]}"]
    return [f"def {name}({argument.operands[0]}):", *(f"    {line}" for line in lines)]


def _expression(operation: Operation, write: Any) -> str:
    name = operation.name
    operands = [write(o) for o in operation.operands]
    options = {k: OPTIONS.get(k, literal)(v) for k, v in operation.options.items()}
    if name in WRITTEN:
        return WRITTEN[name].format(*operands, **options)
    if name == "concatenate":
        operands = [f"[{_listed(operands)}]"]
    return f"np.{name}({_listed([*operands, *(f'{k}={v}' for k, v in options.items())])})"


def _tuple(parts: Iterable[str]) -> str:
    parts = list(parts)
    return f"({_listed(parts)}{',' * (len(parts) == 1)})"


def _index(entry: Any) -> str:
    if isinstance(entry, slice):
        parts = ["" if i is None else str(i) for i in (entry.start, entry.stop, entry.step)]
        return ":".join(parts if parts[2] else parts[:2])
    return str(entry.tolist() if isinstance(entry, np.ndarray) else entry)


def literal(x: Any) -> str:
    """Python source of numbers, arrays, tuples, text and None that gives them back to the last bit."""
    if isinstance(x, np.ndarray):
        as_it_is = np.array(x.tolist()).dtype == x.dtype
        dtype = "" if as_it_is else f", dtype={_dtype(x.dtype)}"
        return f"np.array({literal(x.tolist())}{dtype})"
    if isinstance(x, np.generic):
        return f"{_dtype(x.dtype)}({literal(x.item())})"
    if isinstance(x, list):
        return f"[{_listed(map(literal, x))}]"
    if isinstance(x, tuple):
        return _tuple(map(literal, x))
    if isinstance(x, str):
        return json.dumps(x, ensure_ascii=False)
    if isinstance(x, float):
        return repr(float(x)) if np.isfinite(x) else f"float({str(float(x))!r})"
    return repr(int(x) if isinstance(x, int) and not isinstance(x, bool) else x)


def _dtype(dtype: str | np.dtype) -> str:
    """What NumPy calls a type, in versions 1 and 2."""
    name = np.dtype(dtype).name
    return f"np.{'bool_' if name == 'bool' else name}"


OPTIONS: dict[str, Callable[[Any], str]] = {
    "item": lambda item: _listed(map(_index, item)),
    "shape": lambda shape: _tuple("n" if size == BATCH else str(size) for size in shape),
    "dtype": _dtype,
}
