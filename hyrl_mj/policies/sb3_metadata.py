"""What the metadata of an SB3 agent tell about its training, and its weights do not.

SB3 keeps the last observation of the training, and the last original one, which is the same before
`VecNormalize`. Without `VecNormalize` PPO and A2C keep no original one; the others keep the observation one
sample earlier in its place. Under it PPO and A2C keep the very first.
"""

from __future__ import annotations

import base64
import re
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np

from hyrl_mj.errors import BadArtifact, BadInput
from hyrl_mj.policies import pickled
from hyrl_mj.tasks import Task

# The error of an observation in float32, with room to spare.
ROUNDING = 1e-3
HOW = (
    "give its statistics with --vecnormalize FILE, as env.save() of VecNormalize wrote them, or "
    "--vecnormalize none if it saw plain observations, also for norm_obs=False"
)


def check_inputs(about: Mapping[str, Any], task: Task) -> None:
    """Raises `BadArtifact` if an agent was trained for other inputs than those of a task."""
    space = about.get("action_space")
    if not isinstance(space, dict):
        return
    levels, n = task.input_levels, _numbers(space, "n")
    if levels is not None and ".Discrete'" not in str(space.get(":type:", ".Discrete'")):
        raise BadArtifact(
            f"its actions are not numbers of {len(levels)} levels, as {task.name} takes them, but "
            f"{space[':type:']!s:.80}: train it on those, or give a function that chooses among them"
        )
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
    if not isinstance(text, str) or "..." in text:
        return None
    found = re.findall(r"[-+]?(?:inf|nan|\d+\.?\d*(?:[eE][-+]?\d+)?|\.\d+)", text)
    return np.array(found, dtype=float) if found else None


def _box(low: np.ndarray, high: np.ndarray) -> str:
    """Returns "[-1, 1]", or "[-1, 1] x [0, 2]"."""
    text = [f"[{a:g}, {b:g}]" for a, b in zip(low[:6], high[:6], strict=False)]
    return " x ".join(text + ["..."] * (max(len(low), len(high)) > 6))


def check_observations(about: Mapping[str, Any], task: Task, on_policy: bool, n_stack: int) -> None:
    """Raises `BadArtifact` unless the metadata show that an agent was trained on plain observations.

    `on_policy` tells PPO and A2C from the others; `n_stack` is the number of observations that it sees.
    """
    if about.get("num_timesteps") == 0:
        return  # it has not been trained
    last, original = (
        _observations(_decoded(about.get(f"_last_{name}")), task)
        for name in ("obs", "original_obs")
    )
    possible, normalized = _Possible(task), None
    if on_policy and "_last_original_obs" in about and about["_last_original_obs"] is None:
        normalized = False  # under VecNormalize SB3 keeps it from the first observation on
    elif last is not None and original is not None:
        normalized = _normalized(last, original, possible, on_policy, n_stack)
        if normalized:
            raise BadArtifact(
                "it was trained on normalised observations (VecNormalize): its last one is "
                f"{_row(_joined(last))}, where {task.name} gave {_row(_joined(original))}; {HOW}"
            )
    space = about.get("observation_space")
    limits = [_numbers(space, end) if isinstance(space, dict) else None for end in ("low", "high")]
    dtype = space.get("dtype") if isinstance(space, dict) else None
    if sign := _wrapped(limits, dtype, last, possible):
        raise BadArtifact(f"{sign}; {HOW}")
    if normalized is None:
        raise BadArtifact(
            "nothing in it tells whether it was trained on normalised observations (VecNormalize), as "
            f"would change its inputs: {HOW}"
        )


def check_original(about: Mapping[str, Any], task: Task) -> None:
    """Raises `BadArtifact` if what `VecNormalize` normalised were no observations of a task."""
    original = _observations(_decoded(about.get("_last_original_obs")), task)
    if sign := _wrapped((None, None), None, original, _Possible(task)):
        raise BadArtifact(
            f"{sign}, before the given statistics come in; give a function in Python that changes "
            "observations as its training did, and asks the model"
        )


def check_model(model: Any, task: Task) -> None:
    """Raises `BadInput` unless a model of SB3, if it is one, was trained on plain observations."""
    normalizer = getattr(model, "get_vec_normalize_env", lambda: None)()
    last, original = (getattr(model, f"_last_{name}", None) for name in ("obs", "original_obs"))
    normalized: bool | None = normalizer is not None and normalizer.norm_obs
    if normalizer is None and original is not None:
        # Its environment may be another one than that of its training. What the last one there observed is
        # kept, unless it was loaded with an environment, or was given one.
        on_policy, found = hasattr(model, "rollout_buffer"), _observations(original, task)
        plain, normalized = _observations(last, task), None
        if plain is not None and found is not None:
            normalized = _normalized(plain, found, _Possible(task), on_policy, 1)
            if normalized is None and getattr(model, "get_env", lambda: None)() is not None:
                normalized = False  # it has been trained in that, and goes on there
    if normalized:
        raise BadInput(
            "the model was trained under VecNormalize, and would be asked about plain observations: give its "
            "zip with vecnormalize=, or an object that normalises as its training did and asks the model"
        )
    if normalized is None:
        how = "without an environment, or with" if last is None else "with"
        how += " the VecNormalize of its training"
        raise BadInput(
            "nothing in the model tells whether it was trained on observations that VecNormalize normalised, "
            f"or whether that normalised rewards alone, if anything: load it {how}, as load(path, env=env), "
            'or give its zip with vecnormalize="none" if it saw plain ones'
        )
    space = getattr(model, "observation_space", None)
    ends = [getattr(space, end, None) for end in ("low", "high")]
    limits = [None if end is None else np.ravel(end) for end in ends]
    signs = limits, getattr(space, "dtype", None), _observations(last, task), _Possible(task)
    if getattr(model, "num_timesteps", 0) and (sign := _wrapped(*signs)):
        raise BadInput(
            f"the model would be asked about plain observations, and {sign}; give an object that does as its "
            "wrapper did and asks the model"
        )


# Observations (n, size) by the part of a Dict; those of a vector as "".
_Parts = dict[str, np.ndarray]


def _wrapped(
    limits: Sequence[np.ndarray | None], dtype: Any, last: _Parts | None, possible: _Possible
) -> str:
    """Returns by what an agent shows that it saw observations that the task does not give, "" if by nothing.

    So it is with `NormalizeObservation` and other wrappers inside of the environment of the training.
    `limits`, (k,) each, and `dtype` are those of the space of its observations, if they are known.
    """
    task, joined = possible.task, None if last is None else _joined(last)
    given = None if joined is None else possible.include(joined)
    if given:
        return ""
    which, types = "", {str(part.dtype) for part in (last or {}).values()} or {str(dtype)}
    ours = possible.limits
    if joined is not None and given is False:
        which = f"its last one is {_row(joined)}, which {task.name} never gives"
    elif task.observation_dtype == "float64" and "float32" in types:
        which = f"they are float32, those of {task.name} float64"
    elif all(end is not None and len(end) == ours.shape[1] for end in limits):
        low, high = np.array(limits)
        if not np.allclose([low, high], ours, rtol=1e-4, atol=1e-4):
            which = f"they lie in {_box(low, high)}, those of {task.name} in {_box(*ours)}"
    how = (
        "it was trained on normalised observations (VecNormalize), or on others under a wrapper such as "
        "NormalizeObservation"
    )
    return f"{how}: {which}" if which else ""


def _normalized(
    last: _Parts, original: _Parts, possible: _Possible, on_policy: bool, n_stack: int
) -> bool | None:
    """Returns whether the last observations are normalised, the original ones being not.

    None if that cannot be told.
    """
    shapes = [{name: part.shape for name, part in parts.items()} for parts in (last, original)]
    if shapes[0] != shapes[1]:
        return None
    open_columns: list[bool] = []
    for name, after in last.items():
        before = original[name]
        if after.dtype != before.dtype:
            return True  # VecNormalize gives float32 whatever it gets
        plain = after.dtype == np.float64 and n_stack == 1  # stacks have the type of the space
        # What is constant, a goal say, stays as it is; normalised it would be 0.
        constant = ((after == before) & (after != 0)).all(axis=0).any()
        open_columns += [not (plain or constant)] * after.shape[1]
    if not any(open_columns):
        return False
    return possible.normalized(_joined(last), _joined(original), on_policy, np.array(open_columns))


def _decoded(found: Any) -> Any:
    """Returns the array, or the arrays of a Dict, in an entry of the metadata; None if there are none."""
    text: Any = found.get(":serialized:") if isinstance(found, dict) else None
    try:
        arrays = pickled.arrays(base64.b64decode(text, validate=True))
    except (TypeError, ValueError):
        return None
    return arrays.get("", arrays)


def _observations(found: Any, task: Task) -> _Parts | None:
    """Returns the observations of this task in an array, or in those of a Dict; None if there are none.

    Of stacked observations these are the latest.
    """
    sizes = task.observation_parts
    if isinstance(found, np.ndarray):
        found, sizes = {"": found}, {"": len(task.observation_low)}
    latest = {}
    for name, size in sizes.items():
        part = found.get(name) if isinstance(found, dict) else None
        if part is None or part.ndim != 2 or not part.size or part.shape[1] % size:
            return None
        latest[name] = part[:, -size:]
    if len({len(part) for part in latest.values()}) != 1:
        return None
    return latest if all(np.isfinite(part).all() for part in latest.values()) else None


def _joined(parts: _Parts) -> np.ndarray:
    return np.hstack([part.astype(float) for part in parts.values()])


def _row(observations: np.ndarray) -> str:
    return "(" + ", ".join(f"{value:.3g}" for value in observations[0]) + ")"


class _Possible:
    """The observations that a task gives, found by random inputs."""

    def __init__(self, task: Task):
        self.task, self._rng = task, np.random.default_rng(0)
        self.limits = np.array([task.observation_low, task.observation_high], dtype=float)

    @cached_property
    def starts(self) -> np.ndarray:
        """Observations (n, k) where episodes start."""
        # Copies of the robot, until `by_step` there.
        self._plant = self.task.placed(self.task.starts(256, self._rng), self._rng)
        self._measured = np.asarray(self._plant.measurement)
        return self.task.observation(self._measured)

    @cached_property
    def by_noise(self) -> np.ndarray:
        """The largest difference (k,) between two observations that noise makes."""
        starts, shares = self.starts, np.array(self.task.noisy, dtype=float)
        # A training may have had noise on the measurements of 0.1, in the units of the chart.
        noise = self._rng.uniform(-0.1, 0.1, self._measured.shape) * shares
        noisy = self.task.observation(self._measured + noise)
        return np.asarray(2 * np.abs(noisy - starts).max(axis=0))

    @cached_property
    def by_step(self) -> np.ndarray:
        """The largest change (k,) of an observation within a sample."""
        task, low, high = self.task, *self.task.input_limits
        before = self.starts
        longest = np.zeros(before.shape[1])
        for _ in range(20):
            self._plant.step(np.where(self._rng.random((len(before), len(low))) < 0.5, low, high))
            after = task.observation(self._plant.measurement)
            going = ~self._plant.unstable
            longest = np.maximum(longest, np.abs(after - before)[going].max(axis=0, initial=0.0))
            before = after
        return longest

    @property
    def slack(self) -> np.ndarray:
        """How far observations (k,) may lie beyond those that were found."""
        low, high = self.limits
        return np.asarray(self.by_noise + self.by_step + 1e-3 * (high - low))

    def include(self, last: np.ndarray) -> bool | None:
        """Returns whether a task gives such observations (n, k); None if that cannot be told."""
        low, high = self.limits
        outside = (
            (last < low) | (last > high)
        ).any()  # else the slack, which takes long, is not needed
        if outside and ((last < low - self.slack) | (last > high + self.slack)).any():
            return False
        try:
            self.task.measured(np.zeros((1, len(low))))
        except BadInput:  # it does not tell what was measured
            return None
        tolerance = ROUNDING + 5 * self._off(self.starts.astype(np.float32)).max()
        if np.median(self._off(0.7 * self.starts + 0.1)) <= tolerance:
            return None  # any numbers may be an observation
        return bool(self._off(last).max() <= tolerance)

    def normalized(
        self, last: np.ndarray, original: np.ndarray, on_policy: bool, columns: np.ndarray
    ) -> bool | None:
        """Returns whether `columns` (k,) of the last observations (n, k) are normalised, unlike the original.

        None if that cannot be told.
        """
        given = self.include(last)
        if given is not None:
            return not given
        if on_policy:
            return None
        moved, quiet = np.abs(last - original), 1.5 * self.by_step + ROUNDING
        calm = (moved <= quiet).all(axis=1)[:, None]
        change = np.where(calm, quiet, quiet + 1.5 * self.by_noise)
        near = (moved <= change)[:, columns]
        first, final = self.starts.min(axis=0) - self.slack, self.starts.max(axis=0) + self.slack
        started = ((last >= first) & (last <= final))[:, columns]  # where an episode began
        goes_on, began = near.all(axis=1), started.all(axis=1)
        if not (goes_on | began).all():
            return True
        widths = np.where(goes_on[:, None], 2 * change[:, columns], (final - first)[columns])
        # Normalised numbers have about the density of the standard normal distribution, at most 0.4. That all
        # of them lie by chance where plain ones may has to be less likely than one in a thousand.
        chance = np.minimum(0.4 * widths, 1.0).prod(axis=1)
        return False if chance.min() < 1e-3 else None

    def _off(self, observation: np.ndarray) -> np.ndarray:
        """Returns how far (n,) observations are from any that a measurement gives."""
        measured = self.task.measured(observation)
        return np.asarray(np.abs(self.task.observation(measured) - observation).max(axis=1))
