"""Stage 6 (paper, Step 6): one policy for each extended set, trained on that set only."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np

from hyrl_mj.judging import Kind, ModeResult
from hyrl_mj.learning import Training, symmetry
from hyrl_mj.learning.distillation import distil, fits
from hyrl_mj.learning.training import Score, train
from hyrl_mj.policies import ALGORITHMS, MlpPolicy, Policy
from hyrl_mj.stages.grounds import ModeGround
from hyrl_mj.stages.partition import Partition, PartPolicy, part_policies
from hyrl_mj.stages.tables import HeldInputs, TablePolicy, table_for

# The policy of a mode: a trained network, pi_i, or a table.
ModePolicy = MlpPolicy | PartPolicy | TablePolicy
# Returns the policy that the first attempt continues from, by the ground of the mode, settings and a seed.
WarmStart = Callable[["ModeGround", Training, int], MlpPolicy | None]
# Returns the ground of a mode.
Grounds = Callable[[int], ModeGround]


def start_policy(
    policy: Policy, partition: Partition, ground: ModeGround, settings: Training, seed: int
) -> MlpPolicy | None:
    """Returns the policy that the training of a mode continues from; None if it starts from new weights.

    PPO and A2C continue from pi_i (paper, Step 4), distilled into their network: with the weights of the
    stage-1 policy they would keep its decision. Other algorithms continue from its weights, if these fit.

    Args:
        policy: the stage-1 policy, or the agent.
        partition: M_i, from stage 3.
        ground: the ground of the mode.
        settings: settings of the training.
        seed: seed of the weights and the points of the distillation.
    """
    task = ground.task
    if not ALGORITHMS[settings.algorithm].is_actor_critic:
        return policy if isinstance(policy, MlpPolicy) and fits(task, settings, policy) else None
    pi = part_policies(task, policy, partition, ground.extended.eps)[ground.mode]
    return distil(task, pi, ground.starts, settings, seed)


def retrain(
    ground: ModeGround,
    settings: Training,
    seed: int,
    *,
    warm_start: WarmStart | None = None,
    others: Iterable[tuple[ModePolicy, ModeResult]] = (),
    untrained: Iterable[ModePolicy] = (),
    held: HeldInputs | None = None,
    log_dir: Path | None = None,
) -> tuple[ModePolicy, ModeResult]:
    """Trains the policy of one mode (paper, Step 6).

    Noise leads a policy that passes an obstacle closer than the noise bound into the obstacle, and no
    switching prevents that. The reward is therefore that of the worst state within the noise bound of the
    measurement, and training continues where the worst-case game is lost.

    Args:
        ground: where the mode has to win, and the judge of its policies; see `mode_ground`.
        settings: settings of the training.
        seed: seed of all random numbers; each mode and attempt derives its own from it.
        warm_start: returns the policy that the first attempt continues from, if `settings.warm_start` is
            set; see `start_policy`.
        others: policies of other modes, and how their trainings ended; a mirror image of one is used if it is
            good enough for this mode.
        untrained: policies of which the first one is used as it is that is good enough, such as pi_i of the
            mode (paper, Step 4), or the stage-1 policy itself.
        held: what a table of inputs is made from; the better of it and pi_i then takes the place of the
            trainings.
        log_dir: folder of logs and checkpoints.

    Returns:
        The first untrained policy, or the first mirror image, that is good enough; otherwise the best of the
        untrained ones, the table, the policy that the first attempt continued from, and all attempts, of
        which there are none with a table, or if nearly all is won. And how the training ended.
    """
    task, mode = ground.task, ground.mode
    tried: list[tuple[Score, ModePolicy]] = []

    def suffices(policy: ModePolicy) -> bool:
        tried.append((ground(policy), policy))
        return ground.suffices(policy)

    for given in untrained:
        if suffices(given):
            return given, _result(ground, given, 0)
    if image := mirror_image(ground, others):
        return image
    trainings = 0
    if held is not None:
        suffices(table_for(held, mode))
    enough = held is not None or max([score for score, _ in tried], default=()) >= ground.nearly
    for attempt in range(0 if enough else settings.attempts):
        draw = int(np.random.SeedSequence([seed, 1 + mode, attempt]).generate_state(1)[0])
        warm = None
        if warm_start is not None and settings.warm_start and not attempt:
            warm = warm_start(ground, settings, draw)
        if warm is not None and suffices(warm):
            break
        label = f"mode {mode}, attempt {attempt + 1}" if attempt else f"mode {mode}"
        trained = train(
            task, settings, draw, ground=ground, start_from=warm, log_dir=log_dir, label=label
        )
        trainings += 1
        if suffices(trained):
            break
    best = max(tried, key=lambda result: result[0])[1]
    return best, _result(ground, best, trainings)


def mirror_image(
    ground: ModeGround, others: Iterable[tuple[ModePolicy, ModeResult]]
) -> tuple[ModePolicy, ModeResult] | None:
    """Returns the first mirror image of policies of other modes that is good enough for a mode, if any."""
    for other, result in others if ground.task.mirror is not None else ():
        if isinstance(other, MlpPolicy):
            image = symmetry.mirrored(other)
            if (won := ground.won_by_image(image, result.won)) is not None:
                return image, ModeResult(ground.mode, won, 0)
    return None


def with_later_images(
    done: Sequence[tuple[ModePolicy, ModeResult]], grounds: Grounds, settings: Training
) -> list[tuple[ModePolicy, ModeResult]]:
    """Returns the policies of all modes, some of which are mirror images of later ones.

    A mode takes such an image that is good enough, if it has made all of its trainings and is not.
    """
    found = list(done)
    for i, (policy, result) in enumerate(done):
        later = done[i + 1 :]
        if later and result.attempts == settings.attempts:
            ground = grounds(result.mode)
            if not ground.suffices(policy):
                found[i] = mirror_image(ground, later) or found[i]
    return found


def _result(ground: ModeGround, policy: ModePolicy, trainings: int) -> ModeResult:
    """Returns how the mode of a policy ended."""
    kind: Kind = "trained"
    if isinstance(policy, PartPolicy):
        kind = "agent" if policy.whole else "pi_i"
    elif isinstance(policy, TablePolicy):
        kind = "table"
    return ModeResult(ground.mode, ground.won(policy), trainings, kind)
