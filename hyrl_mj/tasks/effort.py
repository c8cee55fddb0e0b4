"""What may be spent on a task: one value says how much each stage tries, and how a mode is judged."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Effort:
    """How much the stages try.

    Attributes:
        starts: that are drawn to see whether they lie in the box of starts, and chart points that are
            measured all over the chart (none of the latter if `everywhere` is false).
        everywhere: whether the robot is put all over the chart to see how it is measured there.
        side_by_side: episodes that a trial of the task plays side by side, at most.
        mirrored: runs that are compared with their mirror images.
        checkpoints: at which the policy that is trained is judged.
        trainings: of a mode, at most; None as the preset says.
        batches: of episodes by which a policy of a mode is judged, at most.
        attacked: whether the policies of modes are judged by an attack, after those that need no training
            (the stage-1 policy, those of stage 4, a table of inputs) have been tried.
        looks_ahead: whether noise is chosen by simulating ahead from the middle of episodes.
        transitions: of a lattice that is fitted into the memory, at most.
        nodes: from which a controller is attacked where the game is an estimate, for each start mode.
        episodes: of each kind of noise where the worst case cannot be computed.
        attack_starts, attack_rounds: starts and rounds of an attack where the worst case cannot be computed.
            Of so many starts none may be lost for 99% to be within the 95% interval of what is won (Wilson);
            so many rounds try every rule, and search for a few rounds more.
    """

    starts: int = 4_000
    everywhere: bool = True
    side_by_side: int = 256
    mirrored: int = 2_000
    checkpoints: int = 32
    trainings: int | None = None
    batches: int = 5
    attacked: bool = False
    looks_ahead: bool = True
    transitions: int = 2**23
    nodes: int = 1_000
    episodes: int = 1_000
    attack_starts: int = 400
    attack_rounds: int = 10


# Where each sample runs the Python code of an environment it takes about a hundred times as long.
SPARING = Effort(
    starts=64,
    everywhere=False,
    side_by_side=64,
    mirrored=64,
    checkpoints=8,
    trainings=1,
    batches=3,
    attacked=True,
    looks_ahead=False,
    transitions=2**22,
    nodes=48,
    episodes=200,
    attack_starts=100,
    attack_rounds=3,
)
