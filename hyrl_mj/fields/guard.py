"""What is done to a policy's inputs: robots go on, and keep their distance from all posts.

A policy knows of one post alone, and has been trained on its own task, not proved.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hyrl_mj.fields.focus import Seen, only, pick
from hyrl_mj.tasks import length

# The clearance beyond the margin may shrink by this share of itself in a second [1/s].
RATE = 3.0
# A robot retreats only from a post that is ahead of it or behind it: the cosine of the angle between its axis
# and the post's direction is at least this. Elsewhere that would not take it away.
STEEP = 0.5
# With its face to its way a robot drives ahead with at least this speed [m/s].
LEAST = 0.3
# Posts that come faster than this are evaded [m/s]: more than the noise on the velocity of one that stands.
COMING = 0.1
# A robot looks so often, and each time so much farther ahead, at where posts that come will be [s].
LOOKS, LOOK = 4, 0.15
# It changes its speed for as much more room [m].
GAIN = 0.1


@dataclass(frozen=True)
class Guard:
    """Keeps robots away from posts, and lets them neither stand still nor circle a goal for ever.

    Attributes:
        body: radius of the robot [m].
        noise: largest error of a measured coordinate [m]; the heading's is half as much [rad].
        low, high: limits of the forward speed [m/s].
        rate: greatest rate of turn [rad/s].
    """

    body: float
    noise: float
    low: float
    high: float
    rate: float

    @property
    def margin(self) -> float:
        """Distance of the measured position from a post's surface that tells of no crash [m]."""
        return self.body + float(np.sqrt(2.0)) * self.noise

    def inputs(self, seen: Seen, u: np.ndarray, turn: np.ndarray, sense: np.ndarray) -> np.ndarray:
        """Returns inputs (n, 2) [m/s], [rad/s] instead of those of a policy.

        A policy may have headings at which it stands, and noise can hold a robot at the edge of such. So a
        robot with its back to its way turns round in the sense of its mode, and one with its face to it
        drives ahead, no faster than it can turn to the goal. One that a post beside it holds back turns away
        from that post. It drives backward only from a post that comes.

        Args:
            seen: what was measured.
            u: (n, 2) inputs of the policy.
            turn: (n,) angle from the heading to the way [rad].
            sense: (n,) sense of turning, 1 or -1.
        """
        creep = LEAST * np.cos(turn)
        back = creep < 0
        ahead = np.minimum(np.maximum(u[:, 0], creep), self._approach(seen))
        speed = np.where(back, 0.0, ahead)
        rates = np.where(back, sense * self.rate, u[:, 1])
        least, most, aside = self._bounds(seen)
        bounded = np.minimum(np.maximum(speed, least), most)
        bounded = np.where(least > most, (least + most) / 2, bounded)
        rates = np.where((bounded < creep) & (aside != 0), aside * self.rate, rates)
        return np.stack([self._evading(seen, bounded, rates), rates], axis=1)

    def _approach(self, seen: Seen) -> np.ndarray:
        """Returns the speeds (n,) above which robots may circle their goals for ever [m/s].

        A robot with speed v that turns at its greatest rate w drives on a circle of radius v / w. It reaches
        a goal in the direction a, at the distance d, if that is at most d / (2 sin a).
        """
        way = seen.goal - seen.place
        far, (cos, sin) = length(way), seen.axis.T
        behind = way[:, 0] * cos + way[:, 1] * sin < 0
        aside = np.where(behind, far, np.abs(way[:, 1] * cos - way[:, 0] * sin))
        return self.rate * far * far / (2 * np.maximum(aside, 1e-9))

    def _bounds(self, seen: Seen) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns the least and the greatest speed (n,) that keep the distance from all posts [m/s].

        This is a control barrier function of the distance (Ames et al., "Control barrier functions: theory
        and applications", ECC 2019): the clearance c of each post may shrink by at most `RATE` (c - margin) a
        second. The least speed is greater than the greatest where no speed does that. The third result (n,)
        is the sense in which to turn away from the post that sets the greatest speed: 1 against the clock,
        -1 with it, 0 if it is ahead.
        """
        away, far = seen.away, np.maximum(seen.room + seen.radius, 1e-9)
        # The distance shrinks by `towards` for each meter ahead, and by `seen.coming` a second.
        towards = (away * seen.axis[:, None]).sum(axis=2) / far
        allowed = RATE * np.maximum(seen.room - self.margin, 0.0) - seen.coming
        # The direction of the post is not known better than this [rad].
        astray = np.sqrt(2.0) * self.noise / far + self.noise / 2
        across = np.sqrt(np.maximum(1 - towards**2, 0.0)) * astray
        ahead, behind = towards + across > 0, across - towards > 0
        most = np.where(ahead, allowed / np.maximum(towards + across, 1e-3), np.inf)
        least = np.where(behind, -allowed / np.maximum(across - towards, 1e-3), -np.inf)
        most = np.where((allowed < 0) & (towards < STEEP), np.where(ahead, 0.0, np.inf), most)
        least = np.where((allowed < 0) & (towards > -STEEP), np.where(behind, 0.0, -np.inf), least)
        first = only(most.argmin(axis=1), most.shape[1])
        post, (cos, sin) = pick(away, first), seen.axis.T
        aside = np.where(post[:, 1] * cos > post[:, 0] * sin, -1.0, 1.0)
        aside = np.where(pick(towards, first) < STEEP, aside, 0.0)
        low, high = self.low, self.high
        return (
            np.clip(least.max(axis=1), low, high),
            np.clip(most.min(axis=1), low, high),
            aside,
        )

    def _evading(self, seen: Seen, speed: np.ndarray, rate: np.ndarray) -> np.ndarray:
        """Returns speeds (n,) that evade posts which come, instead of speeds (n,), at rates of turn (n,)."""
        room, coming = self._least_rooms(seen, speed, rate)
        threat, best = coming < self.margin, np.minimum(room + GAIN, self.margin)
        for other in (self.high, self.low):
            others = np.full(len(speed), other)
            room, _ = self._least_rooms(seen, others, rate)
            better = threat & (room > best)
            best, speed = np.where(better, room, best), np.where(better, others, speed)
        return speed

    def _least_rooms(
        self, seen: Seen, speed: np.ndarray, rate: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Returns how close robots soon are to posts, and to posts that come, (n,) [m]."""
        least = np.full(seen.radius.shape, np.inf)
        for k in range(1, LOOKS + 1):
            time = k * LOOK
            heading = seen.heading + rate * time / 2
            step = (speed * time)[:, None] * np.stack([np.cos(heading), np.sin(heading)], axis=1)
            away = seen.away + time * seen.speed - step[:, None]
            least = np.minimum(least, length(away) - seen.radius)
        coming = np.where(seen.coming > COMING, least, np.inf)
        return least.min(axis=1), coming.min(axis=1)
