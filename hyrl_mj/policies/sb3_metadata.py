"""What the metadata of an SB3 agent tell about its training, and its weights do not.

SB3 keeps the last observation of the training, and the last original one, which is the same before
`VecNormalize`. Without `VecNormalize` PPO and A2C keep no original one; the others keep the observation one
sample earlier in its place.
"""

from __future__ import annotations

import base64
import binascii
import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from hyrl_mj.errors import BadArtifact, BadInput
from hyrl_mj.policies import pickled
from hyrl_mj.tasks import Task

# Episodes and samples of random inputs from which the possible observations of a task are judged.
EPISODES, SAMPLES = 256, 20
# The noise on the measurements that a training may have had, in the units of the chart.
NOISE = 0.1
# The error of an observation in float32, with room to spare.
ROUNDING = 1e-3
SHOWN = 6  # numbers of a range in messages
NUMBER = re.compile(r"[-+]?(?:inf|nan|\d+\.?\d*(?:[eE][-+]?\d+)?|\.\d+)")


def check_inputs(about: Mapping[str, Any], task: Task) -> None:
    """Raises `BadArtifact` if an agent was trained for other inputs than those of a task."""
    space = about.get("action_space")
    if not isinstance(space, dict):
        return
    levels, n = task.input_levels, _numbers(space, "n")
    if n is not None and levels is not None and n.tolist() != [len(levels)]:
        raise BadArtifact(
            f"it chooses among {n[0]:g} levels, {task.name} has {len(levels)}: train it for these"
        )
    low, high = _numbers(space, "low"), _numbers(space, "high")
    if low is None or high is None or levels is not None:
        return
    ours = task.input_limits
    if len(low) == len(high) == len(ours[0]) and np.allclose(
        [low, high], ours, rtol=1e-5, atol=1e-6
    ):
        return
    theirs, needed = (_box(*limits) for limits in ((low, high), ours))
    raise BadArtifact(
        f"its inputs lie in {theirs}, those of {task.name} in {needed}: train it on the task's own inputs, "
        "without RescaleAction and the like"
    )


def _numbers(space: Mapping[str, Any], part: str) -> np.ndarray | None:
    """Returns the numbers in a part of a space, which metadata hold as text; None if there are none."""
    text = space.get(part)
    found = NUMBER.findall(text) if isinstance(text, str) and "..." not in text else []
    return np.array(found, dtype=float) if found else None


def _box(low: np.ndarray, high: np.ndarray) -> str:
    """Returns "[-1, 1]", or "[-1, 1] x [0, 2]"."""
    text = [f"[{a:g}, {b:g}]" for a, b in zip(low[:SHOWN], high[:SHOWN], strict=False)]
    return " x ".join(text + ["..."] * (max(len(low), len(high)) > SHOWN))


def check_observations(about: Mapping[str, Any], task: Task, on_policy: bool) -> None:
    """Raises `BadArtifact` if an agent was trained on normalised observations, or may have been.

    `on_policy` tells PPO and A2C from the others.
    """
    last, original = (
        _observations(about, f"_last_{name}", task) for name in ("obs", "original_obs")
    )
    if last is None or original is None or last.shape != original.shape:
        return
    if np.array_equal(last, original):
        return  # under VecNormalize(norm_obs=False), or at rest
    normalized = _Seen(task).normalized(last, original, on_policy)
    how = "give its statistics with --vecnormalize FILE.npz, which docs/your-agent.md shows how to write"
    if normalized:
        raise BadArtifact(
            f"it was trained on normalised observations (VecNormalize): its last one is {_row(last)}, where "
            f"{task.name} gave {_row(original)}; {how}"
        )
    if normalized is None:
        raise BadArtifact(
            "it was trained under VecNormalize, and nothing in it tells whether that normalised its "
            f"observations: {how}, also for norm_obs=False"
        )


def _observations(about: Mapping[str, Any], key: str, task: Task) -> np.ndarray | None:
    """Returns the observations (n, k) in an entry of the metadata; None if there are none of this task.

    Of stacked observations these are the latest.
    """
    found = about.get(key)
    text = found.get(":serialized:") if isinstance(found, dict) else None
    if not isinstance(text, str):
        return None
    try:
        found = pickled.arrays(base64.b64decode(text, validate=True))
    except (binascii.Error, ValueError):
        return None
    sizes = {"": len(task.observation_low)} if "" in found else task.observation_parts
    latest = []
    for name, size in sizes.items():
        part = found.get(name)
        if part is None or part.ndim != 2 or not part.size or part.shape[1] % size:
            return None
        latest.append(part[:, -size:])
    if len({len(part) for part in latest}) != 1:
        return None
    array = np.hstack(latest)
    return array if np.isfinite(array).all() else None


def _row(observations: np.ndarray) -> str:
    return "(" + ", ".join(f"{value:.3g}" for value in observations[0]) + ")"


class _Seen:
    """What a task lets an agent see, found by random inputs."""

    def __init__(self, task: Task):
        self.task, rng = task, np.random.default_rng(0)
        plant = task.plant(EPISODES)
        plant.set_state(*task.state(task.starts(EPISODES, rng), rng))
        measured = plant.measurement
        noise = rng.uniform(-NOISE, NOISE, measured.shape) * np.array(task.noisy, dtype=float)
        observation = self.starts = task.observation(measured)
        self.change = 2 * np.abs(task.observation(measured + noise) - observation).max(axis=0)
        self.change += self._longest_step(plant, observation, rng)

    def _longest_step(self, plant: Any, before: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Returns the largest change (k,) of an observation within a sample."""
        low, high = self.task.input_limits
        longest = np.zeros(before.shape[1])
        for _ in range(SAMPLES):
            plant.step(np.where(rng.random((EPISODES, len(low))) < 0.5, low, high))
            after = self.task.observation(plant.measurement)
            going = ~plant.unstable
            longest = np.maximum(longest, np.abs(after - before)[going].max(axis=0, initial=0.0))
            before = after
        return longest

    def normalized(self, last: np.ndarray, original: np.ndarray, on_policy: bool) -> bool | None:
        """Returns whether the last observations (n, k) are normalised, the original ones being not.

        None if that cannot be told.
        """
        task = self.task
        low, high = np.array([task.observation_low, task.observation_high], dtype=float)
        slack = self.change + 1e-3 * (high - low)
        if ((last < low - slack) | (last > high + slack)).any():
            return True
        tolerance = ROUNDING + 5 * self._off(original).max()
        if np.median(self._off(0.7 * self.starts + 0.1)) > tolerance:
            return bool(self._off(last).max() > tolerance)
        if on_policy:
            return None
        jumped = np.abs(last - original) > 1.5 * self.change + ROUNDING
        first, final = self.starts.min(axis=0) - slack, self.starts.max(axis=0) + slack
        started = ((last >= first) & (last <= final)).all(axis=1)  # where an episode began
        return bool((jumped.any(axis=1) & ~started).any())

    def _off(self, observation: np.ndarray) -> np.ndarray:
        """Returns how far (n,) observations are from any that a measurement gives, if that can be told."""
        try:
            measured = self.task.measured(observation)
        except BadInput:
            return np.zeros(len(observation))
        return np.abs(self.task.observation(measured) - observation).max(axis=1)
