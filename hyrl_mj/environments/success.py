"""When an episode of an environment is a success: by its info, its end, its reward, or a distance."""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hyrl_mj import mjcf
from hyrl_mj.environments.copies import Host, Report
from hyrl_mj.errors import BadInput
from hyrl_mj.tasks import Outcome

INFO, TERMINATED = "info", "terminated"
FORMS = '"info", "terminated", "reward >= 1" or "distance(fingertip, target) <= 0.05"'
COMPARISONS = {"<=": operator.le, ">=": operator.ge, "<": operator.lt, ">": operator.gt}
FORM = re.compile(r"\s*(reward|distance\(\s*([\w.-]+)\s*,\s*([\w.-]+)\s*\))\s*([<>]=?)\s*(\S+)\s*")


@dataclass(frozen=True)
class Success:
    """A criterion of success.

    With "info" and "terminated" a success ends the episode; a reward or a distance has to be kept until the
    end of the episode.

    Attributes:
        text: the criterion, as the user gives it.
        holds: whether it holds after a step, (k,) bool, for what k copies report.
    """

    text: str
    holds: Callable[[Report], np.ndarray]

    @property
    def ends(self) -> bool:
        """Whether a success ends the episode."""
        return self.text in (INFO, TERMINATED)

    def outcome(self, report: Report) -> np.ndarray:
        """Returns the `Outcome` (k,) of what copies report."""
        holds = self.holds(report)
        ended = np.where(report.terminated, Outcome.CRASHED, Outcome.RUNNING)
        if self.text == TERMINATED:
            return np.where(holds, Outcome.REACHED, Outcome.RUNNING)
        # Some environments count their steps themselves, as dm_control's do.
        at_end = np.where(holds, Outcome.REACHED, Outcome.STALLED)
        ended = np.where(report.truncated & ~report.terminated, at_end, ended)
        return np.where(holds & self.ends, Outcome.REACHED, ended)


def success_of(host: Host, text: str) -> Success:
    """Returns a criterion from its text.

    Raises:
        BadInput: it has another form, or names what the model does not have.
    """
    if text == INFO:
        return Success(text, lambda report: report.success > 0)
    if text == TERMINATED:
        return Success(text, lambda report: report.terminated)
    match = FORM.fullmatch(text)
    if match is None:
        raise BadInput(f"success {text!r} cannot be used: give {FORMS}")
    what, first, second, comparison, number = match.groups()
    try:
        limit = float(number)
    except ValueError:
        limit = math.nan
    if not math.isfinite(limit):
        raise BadInput(f"success {text!r} compares with {number!r}: give a number")
    compare = COMPARISONS[comparison]
    if what == "reward":
        return Success(text, lambda report: compare(report.reward, limit))
    host.between = mjcf.point_of(host.model, first), mjcf.point_of(host.model, second)
    return Success(text, lambda report: compare(report.distance, limit))
