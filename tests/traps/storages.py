"""Where an environment may remember something: in plain sight, hidden, or in what all instances share."""

from collections import deque
from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np


class Attributes:
    """In attributes of the environment."""

    def keep(self, name, value):
        setattr(self, name, value)

    def kept(self, name):
        return getattr(self, name)


class Dictionary:
    """In a dictionary."""

    def keep(self, name, value):
        self.__dict__.setdefault("notes", {})[name] = value

    def kept(self, name):
        return self.notes[name]


class Listed:
    """In a list that is made anew each time."""

    def keep(self, name, value):
        others = [pair for pair in self.__dict__.get("pairs", []) if pair[0] != name]
        self.pairs = [*others, (name, value)]

    def kept(self, name):
        return dict(self.pairs)[name]


class Nested:
    """In an object of an object."""

    def keep(self, name, value):
        if "pocket" not in self.__dict__:
            self.pocket = SimpleNamespace(inner=SimpleNamespace())
        setattr(self.pocket.inner, name, value)

    def kept(self, name):
        return getattr(self.pocket.inner, name)


class Slotted:
    """In an object without a dictionary."""

    class Box:
        __slots__ = ("held",)

    def keep(self, name, value):
        if "box" not in self.__dict__:
            self.box = Slotted.Box()
            self.box.held = {}
        self.box.held[name] = value

    def kept(self, name):
        return self.box.held[name]


class Closed:
    """In variables of a function."""

    def _made(self):
        if "remind" not in self.__dict__:
            held = {}

            def remind(name, *value):
                if value:
                    (held[name],) = value
                return held[name]

            self.remind = remind

    def keep(self, name, value):
        self._made()
        self.remind(name, value)

    def kept(self, name):
        return self.remind(name)


class Generated:
    """In a generator."""

    def keep(self, name, value):
        if "memory" not in self.__dict__:
            self.memory = _memory()
            next(self.memory)
        self.memory.send((name, value))

    def kept(self, name):
        return self.memory.send((name,))


def _memory():
    held, answer = {}, None
    while True:
        name, *value = yield answer
        if value:
            (held[name],) = value
        answer = held.get(name)


OF_ALL = {}  # what all environments of this process share


class Common:
    """In a variable of the module, which all instances share."""

    def keep(self, name, value):
        OF_ALL[name] = value

    def kept(self, name):
        return OF_ALL[name]


class Classwide:
    """In the class, which all instances share."""

    held = {}

    def keep(self, name, value):
        Classwide.held[name] = value

    def kept(self, name):
        return Classwide.held[name]


class Defaulted:
    """In a default argument, which all instances share."""

    def _held(self, name, value=(), held={}):  # noqa: B006
        if value:
            (held[name],) = value
        return held[name]

    def keep(self, name, value):
        self._held(name, (value,))

    def kept(self, name):
        return self._held(name)


@contextmanager
def new_process():
    """What all instances share is as in a new process in the block, and as it was after it."""
    shared = [OF_ALL, Defaulted._held.__defaults__[1], Classwide.held]
    before = [dict(held) for held in shared]
    for held in shared:
        held.clear()
    try:
        yield
    finally:
        for held, old in zip(shared, before, strict=True):
            held.clear()
            held.update(old)


VISIBLE = (Attributes, Dictionary, Listed, Nested)
HIDDEN = (Slotted, Closed, Generated, Common, Classwide, Defaulted)


class Queue:
    """Values that wait, in a deque, a list, or a ring of an array."""

    @staticmethod
    def of(kind, values):
        queue = Queue()
        queue.at = 0
        queue.values = {"deque": deque, "list": list, "ring": np.array}[kind](values)
        return queue

    def pushed(self, value):
        """Returns the oldest value, and keeps this one in its place."""
        if isinstance(self.values, np.ndarray):
            oldest = self.values[self.at].copy()
            self.values[self.at] = value
            self.at = (self.at + 1) % len(self.values)
            return oldest
        self.values.append(np.array(value))
        return self.values.popleft() if isinstance(self.values, deque) else self.values.pop(0)
