"""Wrappers with a memory."""

import gymnasium as gym
import numpy as np

from traps.storages import Queue


class Waits(gym.Wrapper):
    """Passes actions on some steps later."""

    def __init__(self, env, delay, kind):
        super().__init__(env)
        self.delay, self.kind = delay, kind

    def reset(self, **options):
        shape = self.env.action_space.shape
        self.queue = Queue.of(self.kind, [np.zeros(shape)] * self.delay)
        return self.env.reset(**options)

    def step(self, action):
        action = self.queue.pushed(action)
        discrete = isinstance(self.env.action_space, gym.spaces.Discrete)
        return self.env.step(int(action) if discrete else action)


class Looks(gym.ObservationWrapper):
    """Shows observations some steps later; the first ones are that of the reset."""

    def __init__(self, env, delay, kind):
        super().__init__(env)
        self.delay, self.kind, self.queue = delay, kind, None

    def reset(self, **options):
        self.queue = None
        return super().reset(**options)

    def observation(self, observation):
        if self.queue is None:
            self.queue = Queue.of(self.kind, [observation] * self.delay)
        return self.queue.pushed(observation)


class Blends(gym.ObservationWrapper):
    """Shows a running mean of the observations."""

    def __init__(self, env, share):
        super().__init__(env)
        self.share, self.mean = share, None

    def reset(self, **options):
        self.mean = None
        return super().reset(**options)

    def observation(self, observation):
        old = observation if self.mean is None else self.mean
        self.mean = self.share * observation + (1 - self.share) * old
        return self.mean


class Eases(gym.ActionWrapper):
    """Passes on what follows the actions slowly."""

    def __init__(self, env, share):
        super().__init__(env)
        self.share, self.eased = share, None

    def reset(self, **options):
        self.eased = np.zeros(self.env.action_space.shape)
        return self.env.reset(**options)

    def action(self, action):
        self.eased = self.share * np.asarray(action) + (1 - self.share) * self.eased
        return self.eased


class Appends(gym.Wrapper):
    """Appends the last action to the observation."""

    def __init__(self, env):
        super().__init__(env)
        low = np.append(env.observation_space.low, env.action_space.low)
        high = np.append(env.observation_space.high, env.action_space.high)
        self.observation_space = gym.spaces.Box(low, high, dtype=env.observation_space.dtype)

    def reset(self, **options):
        observation, info = self.env.reset(**options)
        return np.append(observation, np.zeros(self.env.action_space.shape)), info

    def step(self, action):
        observation, *rest = self.env.step(action)
        return np.append(observation, action), *rest


class Stops(gym.Wrapper):
    """Truncates after some steps, by a count of its own."""

    def __init__(self, env, steps):
        super().__init__(env)
        self.steps, self.count = steps, 0

    def reset(self, **options):
        self.count = 0
        return self.env.reset(**options)

    def step(self, action):
        self.count += 1
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, reward, terminated, truncated or self.count >= self.steps, info
