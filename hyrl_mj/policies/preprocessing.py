"""What stands between the observation of a task and an agent: `VecNormalize` and `VecFrameStack`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hyrl_mj.errors import LARGEST_NUMBER, BadArtifact, BadInput
from hyrl_mj.files import archives, artifacts
from hyrl_mj.policies import pickled
from hyrl_mj.policies.mlp import MlpPolicy, ObservationPolicy, Policy, SampledPolicy

if TYPE_CHECKING:
    from hyrl_mj.tasks import Task

NONE = "none"  # in place of a file of statistics: the agent saw plain observations
RECIPE = "give what env.save() of VecNormalize wrote, or an npz file with mean, var and clip"


@dataclass(frozen=True)
class Normalization:
    """The statistics of `VecNormalize`: an agent sees clip((o - mean) / sqrt(var + epsilon), -clip, clip).

    Attributes:
        mean, var: (k,) of observations, or (n_stack k,) of stacked ones.
        clip: the largest magnitude of a normalised observation.
        epsilon: keeps the divisor from zero.
        by_key: whether the file had them for each key of a Dict; they are in the order of the task then.
    """

    mean: np.ndarray
    var: np.ndarray
    clip: float
    epsilon: float = 1e-8
    by_key: bool = False

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Returns normalised observations."""
        scaled = (observation - self.mean) / np.sqrt(self.var + self.epsilon)
        return np.clip(scaled, -self.clip, self.clip)

    @cached_property
    def sha256(self) -> str:
        """The hash of all statistics."""
        numbers = (self.mean, self.var, np.array([self.clip, self.epsilon]))
        return sha256(b"".join(np.asarray(n, dtype="<f8").tobytes() for n in numbers)).hexdigest()

    def save(self, path: Path) -> None:
        """Writes the npz file."""
        with artifacts.replacing(path) as temporary:
            np.savez(temporary, **{name: getattr(self, name) for name in _FIELDS})

    @staticmethod
    def load(path: Path, parts: Mapping[str, int] = {}, n_stack: int = 1) -> Normalization:
        """Reads what SB3's `VecNormalize.save` writes, of which nothing is unpickled, or an npz file.

        That has the arrays mean, var, clip, and epsilon unless it is SB3's. For a Dict with `parts` these may
        be arrays "mean.KEY" and "var.KEY" for each key, and one clip.

        Raises:
            BadArtifact: an array is missing, or has numbers that cannot be.
        """
        with artifacts.reading(path, RECIPE):
            content = artifacts.read_limited(path)
            if content.startswith(b"\x80"):  # a pickle
                arrays = pickled.statistics(content)
            else:
                arrays = archives.read_npz(content, 2**20)
            if by_key := any(name.startswith(("mean.", "var.")) for name in arrays):
                arrays = _joined(arrays, parts, n_stack)
            arrays = {"epsilon": np.array(Normalization.epsilon), **arrays}
            if missing := [name for name in _FIELDS if name not in arrays]:
                raise BadArtifact(f"it has no array {' and no '.join(missing)}: {RECIPE}")
            found = {name: np.asarray(arrays[name]) for name in _FIELDS}
            if other := [n for n, array in found.items() if array.dtype.kind not in "biuf"]:
                raise BadArtifact(f"its {other[0]} holds no numbers: {RECIPE}")
            mean, var, clip, epsilon = (array.astype(float) for array in found.values())
            if mean.ndim != 1 or var.shape != mean.shape or clip.size != 1 or epsilon.size != 1:
                raise BadArtifact(
                    f"its mean and var are two rows of numbers, clip is one number: {RECIPE}"
                )
            finite = all((np.abs(a) <= LARGEST_NUMBER).all() for a in (mean, var, epsilon))
            if not (
                finite
                and (var >= 0).all()
                and clip.item() > 0
                and (var + epsilon > 1 / LARGEST_NUMBER).all()
            ):
                raise BadArtifact(
                    "its numbers cannot be statistics: mean, var >= 0 and epsilon > 0 are numbers up to "
                    f"{LARGEST_NUMBER:g}, and clip > 0"
                )
            return Normalization(mean, var, clip.item(), epsilon.item(), by_key)


def _joined(
    arrays: Mapping[str, np.ndarray], parts: Mapping[str, int], n_stack: int
) -> dict[str, np.ndarray]:
    """Returns arrays for each key of a Dict as those of its `parts` one after the other."""
    needed = [f"{name}.{key}" for key in parts for name in ("mean", "var")]
    given = [name for name in arrays if name.startswith(("mean.", "var."))]
    if sorted(needed) != sorted(given):
        raise BadArtifact(
            f"its arrays {', '.join(given)} are not those of the Dict, {', '.join(needed) or 'if any'}: "
            "give all of them, or a function where only some keys were normalised"
        )
    factors = {np.size(arrays[f"mean.{key}"]) / size for key, size in parts.items()}
    if len(factors) > 1 or not factors <= {1, n_stack}:
        raise BadArtifact(
            f"its arrays have other sizes than the vectors of the Dict, {dict(parts)}"
        )
    rest = {name: array for name, array in arrays.items() if name not in given}
    return rest | {
        name: np.concatenate([np.ravel(arrays[f"{name}.{key}"]) for key in parts])
        for name in ("mean", "var")
    }


_FIELDS = ("mean", "var", "clip", "epsilon")


@dataclass(frozen=True)
class Preprocessing:
    """How an agent sees a task.

    Attributes:
        normalization: the statistics of `VecNormalize`; None without.
        n_stack: number of observations that it sees at once (`VecFrameStack`).
    """

    normalization: Normalization | None = None
    n_stack: int = 1

    @staticmethod
    def from_files(vecnormalize: str | Path | None, n_stack: int, task: Task) -> Preprocessing:
        """Returns the preprocessing of a file of statistics and a number of observations.

        Raises:
            BadInput: they cannot be used, or do not fit the task.
        """
        whole = isinstance(n_stack, int) and not isinstance(n_stack, bool)
        if not whole or not 1 <= n_stack <= 1000:
            raise BadInput(
                f"n_stack {n_stack!r} cannot be used: give the number of observations that the agent sees at "
                "once, from 1 to 1000"
            )
        if vecnormalize is None or str(vecnormalize) == NONE:
            return Preprocessing(None, n_stack)
        k = len(task.observation_low)
        statistics = Normalization.load(Path(vecnormalize), task.observation_parts, n_stack)
        if len(statistics.mean) not in (k, n_stack * k):
            raise BadArtifact(
                f"{vecnormalize} is about observations of {len(statistics.mean)} numbers, those of "
                f"{task.name} have {k}: give the statistics of the agent's own training"
            )
        return Preprocessing(statistics, n_stack)

    def reordered(self, order: np.ndarray) -> Preprocessing:
        """Returns it with statistics in another order, if they are of so many numbers."""
        normalize = self.normalization
        if normalize is None or len(normalize.mean) != len(order):
            return self
        mean, var = normalize.mean[order], normalize.var[order]
        return replace(self, normalization=replace(normalize, mean=mean, var=var))

    def __bool__(self) -> bool:
        return self.normalization is not None or self.n_stack > 1

    def __call__(self, frames: np.ndarray, kind: str = "float32") -> np.ndarray:
        """Returns what an agent sees (n, n_stack k) of its last observations (n, n_stack, k), oldest first.

        These are rounded to the `kind` of floats in which its environment gives them.

        Observations before the start are NaN; the agent sees zeros there, as after a reset of
        `VecFrameStack`.
        """
        n, stack, k = frames.shape
        frames = frames.astype(kind)
        normalize = self.normalization
        if normalize is not None and len(normalize.mean) == k:
            frames = normalize(frames)
        seen = np.nan_to_num(frames, nan=0.0).reshape(n, stack * k)
        if normalize is not None and len(normalize.mean) != k:
            seen = normalize(seen)
        return seen


@dataclass(frozen=True)
class PreprocessedPolicy(ObservationPolicy):
    """An agent that sees more or something else than the observation of the task.

    `act` is its steady answer: to a measurement that has not changed for as long as it remembers. In closed
    loops it acts with its memory, the past observations (n, n_stack - 1, k), which are NaN before the start.

    Attributes:
        policy: the agent.
        preprocessing: what it sees.
        remembers: whether it acts with its memory in closed loops.
    """

    policy: ObservationPolicy
    preprocessing: Preprocessing
    remembers: bool = True

    @property
    def task(self) -> Task:  # type: ignore[override]
        return self.policy.task

    def inputs(self, observation: np.ndarray) -> np.ndarray:
        frames = np.repeat(observation[:, None], self.preprocessing.n_stack, axis=1)
        return self.policy.inputs(self._seen(frames))

    def _seen(self, frames: np.ndarray) -> np.ndarray:
        """Returns what the agent sees (n, n_stack k) of observations (n, n_stack, k), oldest first."""
        is_double = self.task.observation_dtype == "float64"
        return self.preprocessing(frames, "float64" if is_double else "float32")

    def start(self, n: int) -> np.ndarray:
        frames = self.preprocessing.n_stack - 1 if self.remembers else 0
        return np.full((n, frames, len(self.task.observation_low)), np.nan)

    def act_after(self, memory: np.ndarray, measured: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        observation = self.task.observation(self.task.check_measurement(measured))
        frames = np.concatenate([memory, observation[:, None]], axis=1)
        return self.policy.inputs(self._seen(frames)), frames[:, 1:]


def as_function(policy: Policy) -> Policy:
    """Returns a policy as a function of the measurement.

    Of one that draws its inputs this is its mean or mode, of one that sees several observations its steady
    answer. Python code with a memory stays as it is: where it starts, its `act` is its answer, and runs go on
    with its memory.
    """
    if isinstance(policy, SampledPolicy):
        return policy.policy
    if isinstance(policy, PreprocessedPolicy):
        inner = as_function(policy.policy)
        assert isinstance(inner, ObservationPolicy)
        return replace(policy, policy=inner, remembers=False)
    return policy


def network(policy: object) -> MlpPolicy | None:
    """Returns the network of a policy, None if it has none."""
    while isinstance(policy, SampledPolicy | PreprocessedPolicy):
        policy = policy.policy
    return policy if isinstance(policy, MlpPolicy) else None
