"""What is done to a policy's inputs: robots go on, and keep their distance from all posts.

A policy knows of one post alone, and has been trained on its own task, not proved.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hyrl_mj.fields.seen import TINY, Seen, cross, dot, norm, pick

# The clearance beyond the margin may shrink by this share of itself in a second [1/s].
DECAY = 3.0
# A robot retreats only from a post that is ahead of it or behind it: the cosine of the angle between its axis
# and the post's direction is at least this. Elsewhere that would not take it away.
STEEP = 0.5
# With its face to its way a robot drives ahead with at least this speed [m/s], or turns so [rad/s].
LEAST = 0.3


@dataclass(frozen=True)
class Guard:
    """Keeps robots away from posts, and lets them neither stand still nor circle a goal for ever.

    Attributes:
        body: radius of the robot [m].
        eps: largest error of a measured coordinate [m]; the heading's is half as much [rad].
        low, high: limits of the forward speed [m/s].
        rate: greatest rate of turn [rad/s].
    """

    body: float
    eps: float
    low: float
    high: float
    rate: float

    @property
    def margin(self) -> float:
        """Distance of the measured position from a post's surface that tells of no crash [m]."""
        return self.body + float(np.sqrt(2.0)) * self.eps

    def inputs(self, seen: Seen, u: np.ndarray, turn: np.ndarray, sense: np.ndarray) -> np.ndarray:
        """Returns inputs (n, 2) [m/s], [rad/s] instead of those of a policy.

        A policy may have headings at which it stands, and noise can hold a robot at the edge of such. So a
        robot with its back to its way turns round in the sense of its mode, and one with its face to it
        drives ahead, no faster than it can turn to the goal, and turns to its way if it hardly goes on. One
        that a post beside it holds back turns away from that post. It drives backward only from a post that
        comes.

        Args:
            seen: what was measured.
            u: (n, 2) inputs of the policy.
            turn: (n,) angle from the heading to the way [rad].
            sense: (n,) sense of turning, 1 or -1.
        """
        creep = LEAST * np.cos(turn)
        back = creep < 0
        speed = np.minimum(np.maximum(u[:, 0], creep), self._approach(seen))
        speed = np.where(back, 0.0, speed)
        # Along the way, or with the face towards it: one that stands beside its way turns to it.
        going = speed * np.cos(turn) + u[:, 1] * np.sin(turn)
        least_rate = LEAST * np.sin(turn)
        towards = np.where(
            turn < 0, np.minimum(u[:, 1], least_rate), np.maximum(u[:, 1], least_rate)
        )
        rates = np.where(going < LEAST, towards, u[:, 1])
        rates = np.where(back, sense * self.rate, rates)
        least, most, aside = self.bounds(seen)
        bounded = np.minimum(np.maximum(speed, least), most)
        bounded = np.where(least > most, (least + most) / 2, bounded)
        held = (most < np.minimum(speed, creep)) & (aside != 0)
        rates = np.where(held, aside * self.rate, rates)
        speed, rates = self._evading(seen, bounded, rates)
        return np.concatenate([speed[:, None], rates[:, None]], axis=1)

    def _approach(self, seen: Seen) -> np.ndarray:
        """Returns the speeds (n,) above which robots may circle their goals for ever [m/s].

        A robot with speed v that turns at its greatest rate w drives on a circle of radius v / w. It reaches
        a goal in the direction a, at the distance d, if that is at most d / (2 sin a).
        """
        x, y, far = seen.goal_x, seen.goal_y, seen.goal_far
        behind = dot(seen.cos, seen.sin, x, y) < 0
        aside = np.where(behind, far, np.abs(cross(seen.cos, seen.sin, x, y)))
        fastest = self.rate * far * far / (2 * np.maximum(aside, TINY))
        # At 0.1 m/s the circle is so small that the goal is within reach of it.
        return np.maximum(fastest, 0.1)

    def bounds(self, seen: Seen) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns the least and the greatest speed (n,) that keep the distance from all posts [m/s].

        This is a control barrier function of the distance (Ames et al., "Control barrier functions: theory
        and applications", ECC 2019): the clearance c of each post may shrink by at most DECAY (c - margin)
        a second. The least speed is greater than the greatest where no speed does that. The third result (n,)
        is the sense in which to turn away from the post that sets the greatest speed: 1 against the clock,
        -1 with it, 0 if it is ahead.
        """
        # The distance shrinks by `towards` for each meter ahead, and by `coming` a second.
        towards = seen.towards
        allowed = DECAY * np.maximum(seen.room - self.margin, 0.0) - seen.coming
        # The direction of the post is not known better than this [rad].
        astray = np.sqrt(2.0) * self.eps / seen.far + self.eps / 2
        across = np.sqrt(np.maximum(1 - towards * towards, 0.0)) * astray
        ahead, behind, close = towards + across, across - towards, allowed < 0
        most = np.where(ahead > 0, allowed / np.maximum(ahead, 1e-3), np.inf)
        most = np.where(close & (towards < STEEP), np.maximum(most, 0.0), most)
        least = np.where(behind > 0, -allowed / np.maximum(behind, 1e-3), -np.inf)
        least = np.where(close & (towards > -STEEP), np.minimum(least, 0.0), least)
        first = seen.only(most.argmin(axis=1))
        left = cross(seen.cos, seen.sin, pick(seen.x, first), pick(seen.y, first)) > 0
        aside = np.where(left, -1.0, 1.0)
        aside = np.where(pick(towards, first) < STEEP, aside, 0.0)
        low, high = self.low, self.high
        return (
            np.minimum(np.maximum(least.max(axis=1), low), high),
            np.minimum(np.maximum(most.min(axis=1), low), high),
            aside,
        )

    def _evading(
        self, seen: Seen, speed: np.ndarray, rate: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Returns speeds (n,) and rates of turn (n,) that evade posts which come, instead of these."""
        # This is more than the noise on the velocity of a post that stands [m/s].
        coming = seen.coming > 0.1
        if isinstance(coming, np.ndarray) and not coming.any():  # an export does not know
            return speed, rate
        one = np.ones_like(speed)
        turns = (rate, self.rate * one, -self.rate * one)
        others = [(v * one, w) for w in turns for v in (self.high, self.low)]
        speeds, rates = zip((speed, rate), *others, strict=True)
        rooms = self._rooms(seen, np.stack(speeds, axis=1), np.stack(rates, axis=1))
        least = rooms.min(axis=2)
        threat = np.where(coming, rooms[:, 0], np.inf).min(axis=1) < self.margin
        # Speed and rate of turn change for 0.1 m of more room.
        best = np.minimum(least[:, 0] + 0.1, self.margin)
        for i, (v, w) in enumerate(others, 1):
            better = threat & (least[:, i] > best)
            best = np.where(better, least[:, i], best)
            speed, rate = np.where(better, v, speed), np.where(better, w, rate)
        return speed, rate

    def _rooms(self, seen: Seen, speed: np.ndarray, rate: np.ndarray) -> np.ndarray:
        """Returns how close robots soon are to posts (n, S, K) at speeds and rates (n, S) [m]."""
        time = 0.2 * np.arange(1, 6)  # five looks ahead [s]
        # Axes: robots, speeds, times, posts.
        heading = seen.heading[:, None, None] + rate[:, :, None] * (time / 2)
        step = speed[:, :, None] * time
        step_x, step_y = (step * np.cos(heading))[..., None], (step * np.sin(heading))[..., None]
        x = seen.x[:, None] + time[:, None] * seen.vx[:, None]
        y = seen.y[:, None] + time[:, None] * seen.vy[:, None]
        return norm(x[:, None] - step_x, y[:, None] - step_y).min(axis=2) - seen.radius[:, None]
