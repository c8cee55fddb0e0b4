"""A law that needs no learning, with which a drive compares what was learned."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hyrl_mj.policies import ObservationPolicy
from hyrl_mj.tasks import LEFT, Field


@dataclass(frozen=True)
class TangentLaw(ObservationPolicy):
    """Drives along the way past a post: with speed cos t and rate of turn 4 t, for the angle t to it.

    Attributes:
        task: with one post.
        side: on which it passes the post.
    """

    task: Field
    side: int

    def inputs(self, observation: np.ndarray) -> np.ndarray:
        """Returns inputs (n, 2) [m/s], [rad/s] for observations (n, 17)."""
        # Half the sum and half the difference of both sides' ways, each as a cosine and a sine.
        both, apart = observation[:, 10:12], observation[:, 12:14]
        way = both + apart if self.side == LEFT else both - apart
        turn = np.arctan2(way[:, 1], way[:, 0])
        inputs = np.stack([np.maximum(np.cos(turn), 0.0), 4 * turn], axis=1)
        return np.clip(inputs, *self.task.input_limits)
