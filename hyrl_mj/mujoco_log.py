"""MuJoCo's warnings are counted and said once, not written to MUJOCO_LOG.TXT in the working directory."""

import logging
import re
from collections import Counter

import mujoco

# How often MuJoCo has warned in this process, by the text of its warnings with # in place of numbers.
counts: Counter[str] = Counter()
_new: list[str] = []
_NUMBER = re.compile(r"-?\d[\d.e+-]*")


def install() -> None:
    """Receives MuJoCo's warnings from now on, unless the user has a handler (`set_mju_user_warning`)."""
    if mujoco.get_mju_user_warning() is None:
        mujoco.set_mju_user_warning(_count)


def say() -> None:
    """Logs each new kind of warning, once in a process, with the logger "hyrl_mj"."""
    while _new:
        text = _new.pop()
        logging.getLogger("hyrl_mj").warning(
            "MuJoCo warns: %s This is said once, and further warnings of this kind are counted.",
            text,
        )


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
    kind = _NUMBER.sub("#", line)
    if not counts[kind]:
        _new.append(line)
    counts[kind] += 1
