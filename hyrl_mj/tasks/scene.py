"""What a replay shows of a task."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Scene:
    """What replays and figures show of a task: starts, names, and how the MJCF is looked at.

    Attributes:
        starts: (k, d) chart points from which the replayed runs start.
        time: how long runs are shown [s].
        mode_names: what the runs of each mode do, in the order of the modes, as ("left", "right").
        policy_starts: (l, d) chart points from which the figure of the policy draws runs, by default
            `starts`.
        title: the task's name in figures, by default its `name` in words.
        camera: the MJCF's camera of the replay.
        tracked: the MJCF's site whose path the replay draws.
    """

    starts: Sequence[Sequence[float]]
    time: float
    mode_names: Sequence[str]
    policy_starts: Sequence[Sequence[float]] = ()
    title: str = ""
    camera: str = "overhead"
    tracked: str = "tracked"

    def __post_init__(self) -> None:
        if not len(self.policy_starts):
            object.__setattr__(self, "policy_starts", self.starts)

    def mode_name(self, mode: int) -> str:
        """Returns the number of a mode with its name: "0 (left)"."""
        named = 0 <= mode < len(self.mode_names)
        return f"{mode} ({self.mode_names[mode]})" if named else str(mode)
