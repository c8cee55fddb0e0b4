"""MuJoCo's warnings are counted and said once, not written to MUJOCO_LOG.TXT in the working directory."""

import logging
import re
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager

import mujoco

# How often MuJoCo has warned in this process, by kind: the text of its warning with # in place of numbers.
counts: Counter[str] = Counter()
# The last text of each kind that has not been said yet, and the kinds that have.
_new: dict[str, str] = {}
_said: set[str] = set()
# Not empty while warnings are kept.
_kept: list[bool] = []


def install() -> None:
    """Receives MuJoCo's warnings from now on, unless the user has a handler (`set_mju_user_warning`).

    That of dm_control is not the user's: importing dm_control sets it.
    """
    dm_control = sys.modules.get("dm_control.mujoco.wrapper.core")
    if mujoco.get_mju_user_warning() in (None, getattr(dm_control, "_warning_callback", None)):
        mujoco.set_mju_user_warning(_count)


def say() -> None:
    """Logs each new kind of warning, once in a process, with the logger "hyrl_mj"."""
    while _new and not _kept:
        kind, text = _new.popitem()
        if kind not in _said:
            _said.add(kind)
            logging.getLogger("hyrl_mj").warning(
                "MuJoCo warns: %s (said once; further warnings of this kind are only counted)", text
            )


@contextmanager
def kept() -> Iterator[dict[str, str]]:
    """Yields the warnings of the block, text by kind, which are not said."""
    _kept.append(True)
    try:
        yield _new
    finally:
        _kept.pop()
        _new.clear()


def since(before: Counter[str]) -> str:
    """Returns a text with the number of warnings after `before`, a copy of `counts`; "" if there are none."""
    more = counts - before
    if not more:
        return ""
    [(kind, _)] = more.most_common(1)
    return f"MuJoCo warned {more.total():,} times, most often: {kind}"


def _count(text: str) -> None:
    """Counts a warning; called by MuJoCo, also from its own threads."""
    line = " ".join(text.split())
    kind = re.sub(r"-?\d[\d.e+-]*", "#", line)
    counts[kind] += 1
    if _kept or kind not in _said:
        _new[kind] = line
