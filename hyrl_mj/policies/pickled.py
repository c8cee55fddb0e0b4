"""Reads the plain content of a pickle without unpickling it: nothing is imported, called or hashed.

A pickle is a program for a stack machine. This one records each call as a `Call` instead of making it, and
knows only the instructions that occur where numbers and tensors are pickled.

torch.load(weights_only=True) does not replace it: in torch 2.13 a file of a kilobyte makes it allocate any
number of bytes, hash nested tuples without end, or crash the process. In a process with limits it would take
two seconds and 640 MB for each agent. And it knows no arrays of NumPy, which tell in SB3's metadata how an
agent was trained. Python's own unpickler, also with a find_class() of ours, allocates and hashes as well.
"""

from __future__ import annotations

import pickletools
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hyrl_mj.errors import BadArtifact

# Limit on the pickled text around the numbers [bytes]: a network of ten layers takes a few kilobytes.
LARGEST = 2**19
LONGEST = 200  # characters of the name of a function
_MARK = object()
# The functions that make dictionaries, whose entries are the items of the call.
DICTS = ("dict", "collections.OrderedDict")


@dataclass
class Call:
    """A call that unpickling would make.

    Attributes:
        function: "module.name" of the function or class, "" if it is the result of another call.
        arguments: what it would be called with.
        state: what the result would be given afterwards, None if nothing.
        items: the entries that the result would be given, pairs of key and value.
    """

    function: str
    arguments: Any
    state: Any = None
    items: list[tuple[Any, Any]] = field(default_factory=list)


def read(content: bytes) -> Any:
    """Returns the content of a pickle: numbers, strings, bytes, tuples, lists, and `Call`s.

    Names of functions are strings, and dictionaries are calls of "dict".

    Raises:
        ValueError, IndexError, KeyError, AttributeError: it is damaged, or holds an instruction that numbers
            do not need.
    """
    stack: list[Any] = []
    memo: dict[int, Any] = {}
    for opcode, argument, _ in pickletools.genops(content):
        _step(opcode.name, argument, stack, memo)
    if len(stack) != 1:
        raise ValueError("the pickle is damaged")
    return stack.pop()


def _step(name: str, argument: Any, stack: list[Any], memo: dict[int, Any]) -> None:
    """Carries out one instruction."""
    match name:
        case "PROTO" | "FRAME" | "STOP":
            pass
        case "NONE" | "NEWTRUE" | "NEWFALSE" | "EMPTY_TUPLE":
            values = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False, "EMPTY_TUPLE": ()}
            stack.append(values[name])
        case "BININT" | "BININT1" | "BININT2" | "LONG1" | "LONG4" | "BINFLOAT":
            stack.append(argument)
        case "BINUNICODE" | "SHORT_BINUNICODE" | "BINUNICODE8" | "BINSTRING" | "SHORT_BINSTRING":
            stack.append(argument)
        case "BINBYTES" | "SHORT_BINBYTES" | "BINBYTES8" | "BYTEARRAY8":
            stack.append(argument)
        case "BINPUT" | "LONG_BINPUT":
            memo[argument] = stack[-1]
        case "MEMOIZE":
            memo[len(memo)] = stack[-1]
        case "BINGET" | "LONG_BINGET":
            stack.append(memo[argument])
        case "MARK":
            stack.append(_MARK)
        case "EMPTY_LIST":
            stack.append([])
        case "EMPTY_DICT":
            stack.append(Call("dict", ()))
        case "TUPLE":
            stack.append(tuple(_to_mark(stack)))
        case "TUPLE1" | "TUPLE2" | "TUPLE3":
            n = int(name[-1])
            stack[-n:] = [tuple(stack[-n:])]
        case "GLOBAL":
            stack.append(argument.replace(" ", ".", 1))
        case "STACK_GLOBAL":
            module, attribute = stack.pop(-2), stack.pop()
            plain = isinstance(module, str) and isinstance(attribute, str)
            # A name that is made of itself again and again doubles each time.
            plain = plain and len(module) + len(attribute) <= LONGEST
            stack.append(f"{module}.{attribute}" if plain else "")
        case "REDUCE" | "NEWOBJ":
            arguments, function = stack.pop(), stack.pop()
            stack.append(Call(function if isinstance(function, str) else "", arguments))
        case "BINPERSID":
            stack.append(Call("persistent", stack.pop()))
        case "BUILD":
            state = stack.pop()
            stack[-1].state = state
        case "APPEND":
            value = stack.pop()
            stack[-1].append(value)
        case "APPENDS":
            added = _to_mark(stack)
            stack[-1].extend(added)
        case "SETITEM":
            pair = stack.pop(-2), stack.pop()
            stack[-1].items.append(pair)
        case "SETITEMS":
            flat = _to_mark(stack)
            stack[-1].items.extend(zip(flat[::2], flat[1::2], strict=True))
        case _:
            raise ValueError(f"the pickle has the instruction {name}, which numbers do not need")


def _to_mark(stack: list[Any]) -> list[Any]:
    """Takes everything above the last mark from the stack, and returns it."""
    at = len(stack) - 1
    while stack[at] is not _MARK:
        at -= 1
    values = stack[at + 1 :]
    del stack[at:]
    return values


def arrays(content: bytes) -> dict[str, np.ndarray]:
    """Returns the arrays of numbers in a pickled dictionary, or one that was pickled alone, as "".

    What is none, or of another kind, is left out.
    """
    if len(content) > LARGEST:
        return {}
    try:
        found = read(content)
        named = (
            entries(found) if isinstance(found, Call) and found.function in DICTS else {"": found}
        )
        values = {name: _array(value) for name, value in named.items()}
    except Exception:  # a damaged pickle may raise any error
        return {}
    return {name: value for name, value in values.items() if value is not None}


def entries(found: Any) -> dict[str, Any]:
    """Returns the entries of a dictionary, or the attributes of an object; none of anything else."""
    if isinstance(found, Call) and found.function not in DICTS:
        found = found.state
    if not isinstance(found, Call) or found.function not in DICTS:
        return {}
    # Only texts are names: others can be nested so that they have no end.
    return {name: value for name, value in found.items if isinstance(name, str)}


def statistics(content: bytes) -> dict[str, np.ndarray]:
    """Returns the arrays of a pickled `VecNormalize` by which it normalises observations.

    These are mean, var, clip and epsilon; of a Dict mean.KEY and var.KEY for each key.

    Raises:
        BadArtifact: it is none, or did not normalise observations.
    """
    if len(content) > LARGEST:
        raise BadArtifact(
            f"it has {len(content):,} bytes, and statistics take less than {LARGEST:,}: give those of vectors"
        )
    found, kind = {}, ""
    with suppress(Exception):  # a damaged pickle may raise any error
        read_in = read(content)
        found, kind = entries(read_in), read_in.function
    if found and not kind.startswith(("stable_baselines3.", *DICTS)):
        raise BadArtifact(
            f"it is a {kind:.80}, which may normalise otherwise than SB3's VecNormalize: give a function "
            "that does as it did, or, if it does the same, an npz file with mean, var and clip"
        )
    if found.get("norm_obs") is False:
        raise BadArtifact(
            "its VecNormalize did not normalise observations: give none in place of the file"
        )
    sums = found.get("obs_rms")
    whole = {"": sums} if "mean" in entries(sums) else entries(sums)
    named = {
        f"{name}.{key}" if key else name: _array(entries(one).get(name))
        for key, one in whole.items()
        for name in ("mean", "var")
    }
    numbers = {name: found.get(key) for name, key in (("clip", "clip_obs"), ("epsilon", "epsilon"))}
    values = {
        n: np.array(x) if isinstance(x, int | float) else _array(x) for n, x in numbers.items()
    }
    if not named or any(value is None for value in (*named.values(), *values.values())):
        raise BadArtifact("it is no VecNormalize that SB3 has saved: give what its save() wrote")
    return {name: value for name, value in {**named, **values}.items() if value is not None}


def _array(found: Any) -> np.ndarray | None:
    if not isinstance(found, Call):
        return None
    module, _, function = found.function.rpartition(".")
    if not module.startswith("numpy"):
        return None
    if function == "_frombuffer":  # NumPy's pickles of protocol 5
        data, kind, shape, order = found.arguments
    elif function == "scalar":
        (kind, data), shape, order = found.arguments, (), "C"
    elif function == "_reconstruct":
        _, shape, kind, fortran, data = found.state
        order = "F" if fortran else "C"
    else:
        return None
    text, swapped = kind.arguments[0], kind.state[1]
    if not isinstance(text, str) or swapped not in ("<", ">", "|", "="):
        return None
    if not isinstance(data, bytes | bytearray):
        return None
    if not (isinstance(shape, tuple) and all(isinstance(side, int) for side in shape)):
        return None
    numbers = np.frombuffer(data, dtype=np.dtype(text).newbyteorder(swapped))
    return numbers.reshape(shape, order=order) if numbers.dtype.kind in "biuf" else None
