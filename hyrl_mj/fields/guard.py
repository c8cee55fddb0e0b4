"""What is done to a policy's inputs: robots go on, and keep their distance from all posts.

A policy knows of one post alone, and has been trained on its own task, not proved.
"""

from __future__ import annotations

import numpy as np

from hyrl_mj.fields.focus import Seen

# The clearance beyond the margin may shrink by this share of itself in a second [1/s].
RATE = 3.0
# A robot retreats only from a post that is ahead of it or behind it: the cosine of the angle between its axis
# and the post's direction is at least this. Elsewhere that would not take it away.
STEEP = 0.5
# With its face to its way a robot drives ahead with at least this speed [m/s].
LEAST = 0.3


def margin(body: float, noise: float) -> float:
    """Returns the distance of the measured position from a post's surface that tells of no crash [m]."""
    return body + float(np.sqrt(2.0)) * noise


def speed_bounds(
    seen: Seen, body: float, noise: float, low: float, high: float
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the least and the greatest forward speed (n,) that keep the distance from all posts [m/s].

    This is a control barrier function of the distance (Ames et al., "Control barrier functions: theory and
    applications", ECC 2019): the clearance c of each post may shrink by at most `RATE` (c - margin) a second.
    The least speed is greater than the greatest where no speed does that.

    Args:
        seen: what was measured.
        body: radius of the robot [m].
        noise: largest error of a measured coordinate [m]; the heading's is half as much [rad].
        low, high: limits of the forward speed [m/s].
    """
    away, far = seen.away, np.maximum(seen.room + seen.radius, 1e-9)
    heading = np.stack([np.cos(seen.heading), np.sin(seen.heading)], axis=1)
    # The distance shrinks by `towards` for each meter ahead, and by `coming` a second.
    towards = (away * heading[:, None]).sum(axis=2) / far
    coming = -(away * seen.speed).sum(axis=2) / far
    allowed = RATE * np.maximum(seen.room - margin(body, noise), 0.0) - coming
    # The direction of the post is not known better than this [rad].
    astray = np.sqrt(2.0) * noise / far + noise / 2
    across = np.sqrt(np.maximum(1 - towards**2, 0.0)) * astray
    ahead, behind = towards + across > 0, across - towards > 0
    most = np.where(ahead, allowed / np.maximum(towards + across, 1e-3), np.inf)
    least = np.where(behind, -allowed / np.maximum(across - towards, 1e-3), -np.inf)
    most = np.where((allowed < 0) & (towards < STEEP), np.where(ahead, 0.0, np.inf), most)
    least = np.where((allowed < 0) & (towards > -STEEP), np.where(behind, 0.0, -np.inf), least)
    return np.clip(least.max(axis=1), low, high), np.clip(most.min(axis=1), low, high)


def guarded(
    u: np.ndarray,
    turn: np.ndarray,
    sense: np.ndarray,
    rate: float,
    bounds: tuple[np.ndarray, np.ndarray],
) -> np.ndarray:
    """Returns inputs (n, 2) with which robots keep their distance, and do not stand still for ever.

    A policy may have headings at which it stands, and noise can hold a robot at the edge of such. So a robot
    with its back to its way turns round in the sense of its mode, and one with its face to it drives ahead.
    It drives backward only from a post that comes.

    Args:
        u: (n, 2) inputs of a policy [m/s], [rad/s].
        turn: (n,) angle from the heading to the way [rad].
        sense: (n,) sense of turning, 1 or -1.
        rate: greatest rate of turn [rad/s].
        bounds: what `speed_bounds` returned, (n,) each.
    """
    least, most = bounds
    creep = LEAST * np.cos(turn)
    back = creep < 0
    speed = np.where(back, 0.0, np.maximum(u[:, 0], creep))
    rates = np.where(back, sense * rate, u[:, 1])
    bounded = np.minimum(np.maximum(speed, least), most)
    return np.stack([np.where(least > most, (least + most) / 2, bounded), rates], axis=1)
