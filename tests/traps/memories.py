"""Memories of an episode: classes that change a `World`.

Numbers that are drawn are attributes of the class, see `planted`.
"""

import math

import numpy as np

from traps.storages import Queue


def planted(mixin, storage=None, **values):
    """Returns a mixin with its numbers, and with where it remembers something."""
    return type(mixin.__name__, (mixin,) if storage is None else (mixin, storage), values)


class Looking:
    """Looks at what others do, or changes what is seen."""


class Region:
    """Something happens near a place, which all that is planted in one environment shares."""

    where, reach = (0.9, 0.7), 0.35

    def near(self):
        if self.plan.turns:
            return math.cos(self.place()[0] - self.where[0]) > 1 - self.reach
        return math.hypot(*(self.place() - self.where)) < self.reach


class Key(Region):
    """Arriving counts with a key only, which lies somewhere."""

    def begin(self):
        super().begin()
        self.keep("key", False)

    def remember(self):
        super().remember()
        if self.near():
            self.keep("key", True)

    def arrived(self):
        return super().arrived() and self.kept("key")


class Broken(Region):
    """A place breaks its drive."""

    strength = 0.4

    def begin(self):
        super().begin()
        self.keep("drive_strength", 1.0)

    def remember(self):
        super().remember()
        if self.near():
            self.keep("drive_strength", self.strength)

    def drive(self, share):
        super().drive(share * self.kept("drive_strength"))


class Waypoint(Region):
    """The goal is a place on the way first."""

    def begin(self):
        super().begin()
        self.keep("passed", 0)

    def remember(self):
        super().remember()
        if self.near():
            self.keep("passed", self.kept("passed") + 1)

    def goal(self):
        return super().goal() if self.kept("passed") else np.array(self.where)

    def arrived(self):
        return self.kept("passed") > 0 and super().arrived()


class Unlatched(Region):
    """A place changes the model, until the next reset."""

    unlatches = "dof_damping"

    def draw(self):
        # What a reset draws afterwards stays.
        if self.unlatches == "dof_damping":
            self.model.dof_damping[self.rates] = self.plan.damping
        elif self.unlatches == "wind":
            self.model.opt.gravity[0] = 0.0
        else:
            self.model.geom("rock").contype = 1
            self.model.geom("rock").conaffinity = 1
        super().draw()

    def remember(self):
        super().remember()
        if not self.near():
            return
        if self.unlatches == "dof_damping":
            self.model.dof_damping[self.rates] = 3 * self.plan.damping
        elif self.unlatches == "wind":
            self.model.opt.gravity[0] = -1.0
        else:
            self.model.geom("rock").contype = 0
            self.model.geom("rock").conaffinity = 0


class Sticky:
    """Once it has arrived it has always arrived, even in the next episode if `forgets` is not set."""

    forgets = True

    def begin(self):
        super().begin()
        if self.forgets or "was_there" not in self.__dict__:
            self.was_there = False

    def arrived(self):
        self.was_there = self.was_there or super().arrived()
        return self.was_there


class LateAction:
    """Actions are passed on some steps later."""

    action_delay, action_queue = 2, "deque"

    def begin(self):
        super().begin()
        self.waiting = Queue.of(
            self.action_queue, [np.zeros(self.plan.dimension)] * self.action_delay
        )

    def drive(self, share):
        super().drive(self.waiting.pushed(share))


class LateEyes:
    """The environment itself shows observations some steps later."""

    eye_delay, eye_queue = 2, "deque"

    def begin(self):
        super().begin()
        self.seen_before = Queue.of(self.eye_queue, [self.flat_parts()] * self.eye_delay)
        self.late_view = self.flat_parts()

    def remember(self):
        super().remember()
        self.late_view = self.seen_before.pushed(self.flat_parts())

    def flat_parts(self):
        parts = super().parts()
        return np.concatenate([parts[name] for name in self.widths])

    def parts(self):
        if "late_view" not in self.__dict__:
            return super().parts()
        ends = np.cumsum([*self.widths.values()])[:-1]
        return dict(zip(self.widths, np.split(self.late_view, ends), strict=True))


class Cached:
    """What is observed is computed in a step; at other times it is what was computed before.

    `caches` is "step", computed in each, "slow", in every third, or "counter", when a number has changed.
    """

    caches = "step"

    def begin(self):
        super().begin()
        self.samples, self.cached_at, self.cache = 0, -1, None
        self.cache = super().parts()

    def remember(self):
        super().remember()
        self.samples += 1
        if self.caches == "step" or (self.caches == "slow" and self.samples % 3 == 0):
            self.cache = super().parts()

    def parts(self):
        if self.__dict__.get("cache") is None:
            return super().parts()
        if self.caches == "counter" and self.cached_at != self.samples:
            self.cache, self.cached_at = super().parts(), self.samples
        return self.cache


class Difference(Looking):
    """A velocity is the difference to where the sensor saw it before.

    `differs` is "step", computed in the step, "observation", computed when it is asked for, or "filter".
    """

    differs = "step"

    def begin(self):
        super().begin()
        self.last_seen, self.speed = self.sense(), np.zeros(self.plan.dimension)

    def remember(self):
        super().remember()
        if self.differs == "observation":
            return
        speed = (self.sense() - self.last_seen) / self.plan.dt
        self.speed = speed if self.differs == "step" else 0.7 * self.speed + 0.3 * speed
        self.last_seen = self.sense()

    def parts(self):
        if "last_seen" in self.__dict__ and self.differs == "observation":
            self.speed = (self.sense() - self.last_seen) / self.plan.dt
            self.last_seen = self.sense()
        return {**super().parts(), "velocity": self.__dict__.get("speed", 0 * self.sense())}


class Seldom(Region):
    """The drive changes every so many steps; or a wind grows with each step in a region."""

    period = 97

    def begin(self):
        super().begin()
        self.keep("count", 0)
        self.keep("turns", 0)

    def remember(self):
        super().remember()
        self.keep("count", self.kept("count") + 1)
        if self.near() if self.period is None else self.kept("count") % self.period == 0:
            self.keep("turns", self.kept("turns") + 1)

    def drive(self, share):
        turns = self.kept("turns")
        super().drive(
            share * (1 / (1 + turns) if self.period is None else (0.5 if turns % 2 else 1))
        )


class Smooth:
    """The drive follows the actions slowly."""

    share_of_new = 0.3

    def begin(self):
        super().begin()
        self.keep("smoothed", np.zeros(self.plan.dimension))

    def drive(self, share):
        new = self.share_of_new
        self.keep("smoothed", (1 - new) * self.kept("smoothed") + new * share)
        super().drive(self.kept("smoothed"))


class Recalled(Looking):
    """The observation holds what was done last, or seen last."""

    recalls = "action"

    def begin(self):
        super().begin()
        d = self.plan.dimension
        self.done, self.recalled = (
            np.zeros(d),
            self.sense() if self.recalls == "seen" else np.zeros(d),
        )
        self.now_seen = self.sense()

    def drive(self, share):
        self.done = np.array(share)
        super().drive(share)

    def remember(self):
        super().remember()
        self.recalled = self.done if self.recalls == "action" else self.now_seen
        self.now_seen = self.sense()

    def sizes(self):
        return {**super().sizes(), "recalled": self.plan.dimension}

    def parts(self):
        zeros = np.zeros(self.plan.dimension)
        return {**super().parts(), "recalled": self.__dict__.get("recalled", zeros)}


class Tracked(Looking):
    """Its drive is weaker where its sensor sees that it has moved far since the sample before."""

    def begin(self):
        super().begin()
        self.gain, self.tracked = 1.0, self.sense()

    def remember(self):
        super().remember()
        moved = np.abs(self.sense() - self.tracked).max()
        self.gain, self.tracked = 1 / (1 + 5 * moved), self.sense()

    def drive(self, share):
        super().drive(share * self.gain)


class Progress:
    """Its reward is how much nearer it has come."""

    def begin(self):
        super().begin()
        self.distance_before = math.hypot(*(self.place() - self.goal()))

    def reward(self, arrived):
        distance = math.hypot(*(self.place() - self.goal()))
        nearer, self.distance_before = self.distance_before - distance, distance
        return 0.2 - distance + 4 * nearer
