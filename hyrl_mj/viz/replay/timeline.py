"""Which moment of an arc each frame of a video shows."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

HOLD = 1.0  # [s] that the last frame stays
AROUND = 0.25  # [s] before and after a jump that are played slowly


def frame_times(
    end: float, fps: float, jumps: Iterable[float] = (), slow_motion: float = 1.0
) -> np.ndarray:
    """Returns the time of the arc at each frame, to its end and a moment longer.

    Args:
        end: the arc's last time [s].
        fps: frames a second.
        jumps: times [s] around which the arc is played slowly.
        slow_motion: how many times slower; 1 for real time.

    Returns:
        (k,) times [s]: 0 first, `end` last.
    """
    edges = np.array([[t - AROUND, t + AROUND] for t in jumps]).reshape(-1, 2).clip(0, end)
    at = np.unique([0.0, end, *edges.ravel()])
    middles = (at[1:] + at[:-1]) / 2
    slow = ((edges[:, :1] < middles) & (middles < edges[:, 1:])).any(axis=0)
    played = np.append(0.0, np.cumsum(np.diff(at) * np.where(slow, slow_motion, 1.0)))
    moving = int(np.ceil(played[-1] * fps - 1e-6)) + 1
    return np.interp(np.arange(moving + round(HOLD * fps)) / fps, played, at)
