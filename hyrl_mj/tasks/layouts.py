"""Layouts of posts: where round posts stand or move, and where the goal is, for many fields at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# Columns of a measurement before those of the posts: x, y, heading, and x and y of the goal. Columns of each
# post: x, y, their velocities, and its radius.
POSE, OF_POST = 5, 5


@dataclass(frozen=True)
class Layouts:
    """F fields with K posts each, which follow tracks.

    Attributes:
        tracks: (F, S, K, 2) positions of the posts at equally spaced times from 0 on [m]; the tracks are
            straight in between, and end in standstill.
        radii: (F, K) [m].
        goals: (F, 2) [m].
        interval: time between two positions of a track [s].
    """

    tracks: np.ndarray
    radii: np.ndarray
    goals: np.ndarray
    interval: float = 1.0

    @property
    def posts(self) -> int:
        """K, the number of posts of a field."""
        return self.radii.shape[1]

    def __len__(self) -> int:
        return len(self.radii)

    def positions(self, number: np.ndarray, time: np.ndarray) -> np.ndarray:
        """Returns the positions (n, K, 2) [m] of the posts of fields (n,) at times (n,) [s]."""
        first, share, slope = self._segment(number, time)
        return np.asarray(first + share[:, None, None] * slope)

    def velocities(self, number: np.ndarray, time: np.ndarray) -> np.ndarray:
        """Returns the velocities (n, K, 2) [m/s] of the posts of fields (n,) from times (n,) [s] on."""
        return self._segment(number, time)[2] / self.interval

    def _segment(
        self, number: np.ndarray, time: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns where segments of the tracks begin, what share of them is over, and where they lead."""
        last = self.tracks.shape[1] - 1
        # A clock that counts samples is off by its rounding errors.
        at = np.maximum(time / self.interval, 0.0)
        k = np.minimum((at + 1e-6).astype(int), last)
        first = self.tracks[number, k]
        return first, at - k, self.tracks[number, np.minimum(k + 1, last)] - first


def posts_of(measured: np.ndarray) -> np.ndarray:
    """Returns the posts (n, K, 5) of measurements (n, 5 + 5 K): x, y, their velocities, radius."""
    posts = (measured.shape[1] - POSE) // OF_POST
    return measured[:, POSE : POSE + OF_POST * posts].reshape(len(measured), posts, OF_POST)


def only_post(measured: np.ndarray, post: np.ndarray) -> np.ndarray:
    """Returns measurements (n, 10) without all posts but one each (n,)."""
    posts = posts_of(measured)
    own = np.arange(posts.shape[1]) == post[:, None]
    return np.hstack([measured[:, :POSE], np.where(own[:, :, None], posts, 0.0).sum(axis=1)])
