"""The verdict on a run: one word, a sentence, and the reasons."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from hyrl_mj.game import NEARLY, PROVED_STARTS, ReplayCount, Robustness, Score, percent
from hyrl_mj.stages import Arrivals, ModeResult, Retraining
from hyrl_mj.tasks import Task

PROVED, WON, HELD, WEAK, FAILED = "PROVED", "WON", "HELD", "WEAK", "FAILED"
# The kind of noise of episodes without noise.
NO_NOISE = "none"


@dataclass(frozen=True)
class Verdict:
    """What the hybrid controller of a run is worth.

    `word` is the first of these whose condition holds. To win is to arrive within the task's `max_steps`;
    nearly all are 99%.

    - PROVED: HyRL is proved to win nearly all winnable starts, whatever the noise within the run's bound.
    - WON: the worst-case game decides, and of no winnable start a noise signal is known that beats
      HyRL, from the attack, if there was one, either.
    - HELD: the game cannot be played or is an estimate, HyRL arrives in nearly all episodes under each kind
      of noise, and the attack, if there was one, breaks it from nearly no start.
    - FAILED: no start is winnable, or HyRL wins less than the policy without noise, or stage 6 gave up: for
      some mode no attempt gave a policy that wins nearly all of its set. Tasks with a reward for each mode,
      as `field`, may draw episodes that no policy wins: there stage 6 does not give up.
    - WEAK: HyRL wins more than the policy under noise, or the policy does not arrive from nearly all of its
      starts without noise, or the examination was under less noise than the run's bound.
    - FAILED: none of these. HyRL loses, and is no better than the policy.

    PROVED and WON are said only after starts that are proved, or not known to be lost, were replayed in
    MuJoCo: a single one that is lost withdraws both words, and is named.

    In the game, HyRL picks its start mode. In episodes, the kind of noise that stops a controller most often
    counts; the attack is one of these kinds.

    Attributes:
        word: "PROVED", "WON", "HELD", "WEAK" or "FAILED".
        sentence: what decided.
        reasons: the results behind it, a sentence each.
    """

    word: str
    sentence: str
    reasons: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.word}: {self.sentence}"

    @staticmethod
    def judge(
        task: Task,
        bound: float,
        robustness: Robustness,
        retraining: Retraining,
        arrivals: Arrivals,
    ) -> Verdict:
        """Returns the verdict on a run.

        Args:
            task: the robot and its problem.
            bound: the run's noise bound.
            robustness: the result of the examination.
            retraining: the result of stage 6.
            arrivals: from how many starts the policy of stage 1, or the agent, arrives without noise.
        """
        case = _Case(task, bound, robustness, retraining, arrivals)
        reasons = tuple(case.reasons())
        for word, grounds in (
            (PROVED, case.proofs()),
            (WON if robustness.deciding else HELD, case.success()),
            (FAILED, case.failures()),
            (WEAK, case.weaknesses()),
        ):
            if sentence := "; ".join(grounds):
                return Verdict(word, sentence, reasons)
        return Verdict(FAILED, f"HyRL is no better than the policy under {case.noise}", reasons)


@dataclass(frozen=True)
class _Wins:
    """What a controller is not known to lose: shares of the winnable starts, or of the episodes.

    Attributes:
        quiet: without noise, None if that was not examined.
        noisy: under noise, None if that was not examined.
    """

    quiet: float | None
    noisy: float | None

    @staticmethod
    def count(robustness: Robustness, who: str) -> _Wins:
        """Returns what "policy" or "hyrl" wins."""
        attacked = [1 - c.lost / c.starts for c in robustness.attacks if c.controller == who]
        if robustness.deciding:
            scores = robustness.deciding.scores[who]
            replays = robustness.deciding.replays_of(who)
            replayed = replays.shares if replays else (1.0, 1.0)
            quiet = [min(score.not_broken, replayed[0]) for score in scores if score.eps == 0]
            noisy = min(scores[-1].not_broken, replayed[1], *attacked, 1.0)
            return _Wins(quiet[0] if quiet else None, noisy)
        shares = {
            kind: arrived / episodes
            for kind, (arrived, episodes) in _by_kind(robustness, who).items()
        }
        quiet_share = shares.pop(NO_NOISE, None)
        under_noise = [*shares.values(), *attacked]
        return _Wins(quiet_share, min(under_noise) if under_noise else None)


@dataclass(frozen=True)
class _Case:
    """What a verdict is decided by; the attributes are those of `Verdict.judge`."""

    task: Task
    bound: float
    robustness: Robustness
    retraining: Retraining
    arrivals: Arrivals

    @property
    def policy(self) -> _Wins:
        return _Wins.count(self.robustness, "policy")

    @property
    def hyrl(self) -> _Wins:
        return _Wins.count(self.robustness, "hyrl")

    @property
    def noise(self) -> str:
        """The noise of the examination, in words."""
        where, unit = self.task.noise_on(self.robustness.everywhere)
        return f"noise of up to {self.robustness.eps:g} {unit} on {where}"

    @property
    def whole(self) -> str:
        """What shares are shares of."""
        return "the winnable starts" if self.robustness.deciding else "the episodes"

    @property
    def lost_of(self) -> str:
        """What shares of losses are shares of."""
        replayed = self.replays is not None and self.replays.failures
        return f"{self.whole} or of those replayed" if replayed else self.whole

    @property
    def examined(self) -> bool:
        """Whether the examination was under as much noise as the run's bound."""
        return self.robustness.eps >= self.bound and self.hyrl.noisy is not None

    @property
    def winnable(self) -> float:
        """The share of the starts that can be won under the noise."""
        game = self.robustness.deciding
        return game.scores["hyrl"][-1].winnable if game else 1.0

    @property
    def replays(self) -> ReplayCount | None:
        """The replays of HyRL in MuJoCo, None if there were none."""
        game = self.robustness.deciding
        return game.replays_of("hyrl") if game else None

    @property
    def stands(self) -> bool:
        """Whether what the game says of HyRL was replayed in MuJoCo, and nothing was lost."""
        return self.replays is not None and not self.replays.failures

    def proofs(self) -> Iterator[str]:
        """Yields why the run is PROVED, if it is."""
        if self.stands:
            yield from self._proved()

    def success(self) -> Iterator[str]:
        """Yields why the run is WON or HELD, if it is."""
        if self.stands or not self.robustness.deciding:
            yield from self._won()

    def withdrawn(self) -> Iterator[str]:
        """Yields why the run is neither PROVED nor WON, although the game says so."""
        if not self.robustness.deciding or self.stands:
            return
        if self.replays:
            yield replays_sentence(self.task, self.replays)
        elif [*self._proved(), *self._won()]:
            yield (
                "what the worst-case game says of HyRL was not replayed in MuJoCo, which "
                "hyrl-mj robustness RUN does"
            )

    def _proved(self) -> Iterator[str]:
        """Yields why the run is PROVED, if the game is to be believed."""
        game = self.robustness.deciding
        if not game or not self.examined or not self.winnable:
            return
        score = game.scores["hyrl"][-1]
        if score.proved is not None and score.proved >= NEARLY:
            yield f"whatever the {self.noise}, HyRL {_share(score)} of {self.whole}"

    def _won(self) -> Iterator[str]:
        """Yields why the run is WON or HELD, if the game is to be believed."""
        won = self.hyrl.noisy
        if not self.examined or not self.winnable or won is None:
            return
        if self.robustness.deciding and won == 1:
            yield f"HyRL lost none of {self.whole} that were tried under the worst {self.noise}"
        elif not self.robustness.deciding and won >= NEARLY:
            counts = _by_kind(self.robustness, "hyrl")
            counts.pop(NO_NOISE, None)
            arrived, total = (sum(column) for column in zip(*counts.values(), (0, 0), strict=True))
            if total:
                yield f"HyRL arrives in {arrived:,} of {total:,} episodes, with {self.noise}"
            yield from self._attacked("hyrl")

    def failures(self) -> Iterator[str]:
        """Yields why the run FAILED, if it did for sure."""
        if grounds := [*self._failed()]:
            yield from [*self.withdrawn(), *grounds]

    def _failed(self) -> Iterator[str]:
        """Yields what makes a run a failure, whatever else it does."""
        if not self.winnable:
            yield f"no start is winnable under {self.noise}"
        policy, hyrl = self.policy.quiet, self.hyrl.quiet
        if policy is not None and hyrl is not None and hyrl < policy:
            yield (
                f"without noise HyRL loses {percent(1 - hyrl)} of {self.lost_of}, more than the policy "
                f"({percent(1 - policy)})"
            )
        # A mode with a reward of its own is judged by episodes that perhaps no policy wins. Where nothing was
        # trained, nothing was given up.
        modes = self.retraining.modes
        given_up = [
            result.mode
            for result in modes
            if result.won < NEARLY
            and result.policy not in POLICIES
            and self.task.for_mode(result.mode) is self.task
        ]
        if given_up:
            names = listed([self.task.mode_name(mode) for mode in given_up])
            yield f"stage 6 gave up on mode{'s' * (len(given_up) > 1)} {names}"

    def weaknesses(self) -> Iterator[str]:
        """Yields why the run is WEAK, if it is."""
        yield from self.withdrawn()
        if self.arrivals.arrived < NEARLY * self.arrivals.episodes:
            yield f"the policy {self.arrivals}"
        policy, hyrl = self.policy.noisy, self.hyrl.noisy
        if policy is not None and hyrl is not None and policy < hyrl < 1:
            whole = self.lost_of
            if self.robustness.attacks:
                whole = f"{whole} or of those attacked"
            yield (
                f"HyRL loses {percent(1 - hyrl)} of {whole} under {self.noise}, but fewer than the policy "
                f"({percent(1 - policy)})"
            )
        if not self.examined:
            yield (
                f"HyRL was not examined under the run's noise bound {self.bound:g}, which "
                "hyrl-mj robustness RUN does"
            )

    def reasons(self) -> Iterator[str]:
        """Yields the results behind the verdict."""
        yield from self._shares() if self.robustness.deciding else self._counts()
        yield f"stage 1: the policy {self.arrivals}"
        for result in self.retraining.modes:
            yield f"stage 6: {mode_sentence(self.task, result)}"

    def _shares(self) -> Iterator[str]:
        """Yields what is won in the worst-case game."""
        if self.winnable < 1:
            assert self.robustness.deciding
            open_ = self.robustness.deciding.scores["hyrl"][-1].open
            yield (
                f"under {self.noise} this split can win {percent(self.winnable)} of the starts; to one who "
                f"sees the state {percent(open_)} are open"
            )
        assert self.robustness.deciding
        policy, hyrl = (self.robustness.deciding.scores[who] for who in ("policy", "hyrl"))
        for ours, theirs in zip(hyrl, policy, strict=True):
            if ours.eps in (0, self.robustness.eps):
                when = f"under the worst {self.noise}" if ours.eps else "without noise"
                yield f"{when} HyRL {_share(ours)} of {self.whole}, the policy {_share(theirs)}"
        for count in self.robustness.deciding.replays:
            yield replays_sentence(self.task, count)
        yield from self._attacked("hyrl", "policy")

    def _counts(self) -> Iterator[str]:
        """Yields the numbers of episodes that arrive, by kind of noise."""
        policy = _by_kind(self.robustness, "policy")
        for kind, (arrived, episodes) in _by_kind(self.robustness, "hyrl").items():
            when = "without noise" if kind == NO_NOISE else f"under {kind} {self.noise}"
            theirs, _ = policy[kind]
            yield f"{when} HyRL arrives in {arrived:,} of {episodes:,} episodes, the policy in {theirs:,}"
        yield from self._attacked("hyrl", "policy")
        if game := self.robustness.game:
            policy_lost, lost = (1 - game.scores[who][-1].not_broken for who in ("policy", "hyrl"))
            yield (
                f"the worst-case game on nodes, here an estimate, finds noise that beats HyRL from "
                f"{percent(lost)} of the starts that were tried, and the policy from "
                f"{percent(policy_lost)}"
            )

    def _attacked(self, *controllers: str) -> Iterator[str]:
        """Yields in one sentence from how many starts the attack, if any, breaks these controllers."""
        names = {"hyrl": "HyRL", "policy": "the policy"}
        found = {c.controller: c for c in self.robustness.attacks}
        breaks = [f"{names[who]} from {found[who].broken}" for who in controllers if who in found]
        if breaks:
            yield f"the attack breaks {', '.join(breaks)}"


def replays_sentence(task: Task, count: ReplayCount) -> str:
    """Returns how many replays a controller lost, and the first of them."""
    who = "the policy" if count.controller == "policy" else "HyRL"
    said = "proved" if count.of == PROVED_STARTS else "winnable"
    if count.first is None:
        return (
            f"{who} lost none of {count.played:,} {said} starts when they were replayed in MuJoCo"
        )
    first = count.first
    mode = "" if first.q0 is None else f" in mode {task.mode_name(first.q0)}"
    noise = "without noise" if first.noise == NO_NOISE else f"under {first.noise} noise"
    said = "a proved start" if count.of == PROVED_STARTS else "a start that no known noise beats"
    withdrawn = "withdrawn: " if count.controller == "hyrl" else ""
    return (
        f"{withdrawn}{said} was lost in a replay: from {task.chart.format(np.array(first.start))}{mode} "
        f"{noise} {who} ends {first.outcome.replace('_', ' ')}, and {count.failures:,} of "
        f"{count.played:,} such replays in MuJoCo are lost"
    )


def _share(score: Score) -> str:
    """Returns what is proved, and what is known to be lost."""
    lost = f"known to lose {percent(1 - score.not_broken)}"
    if score.not_broken == 1:
        lost = "not known to lose any"
    return (
        f"is {lost}"
        if score.proved is None
        else f"is proved to win {percent(score.proved)} and {lost}"
    )


def _by_kind(robustness: Robustness, who: str) -> dict[str, tuple[int, int]]:
    """Returns how many of a controller's episodes arrive, and of how many, by kind of noise."""
    counts: dict[str, tuple[int, int]] = {}
    for count in robustness.episodes:
        if count.controller == who:
            arrived, episodes = counts.get(count.noise, (0, 0))
            counts[count.noise] = arrived + count.episodes - count.lost, episodes + count.episodes
    return counts


# What the policy of a mode is, unless it was trained.
POLICIES = {
    "pi_i": ", the agent as on its own side of M*,",
    "agent": ", the agent itself,",
    "table": ", a table of inputs,",
}


def mode_sentence(task: Task, result: ModeResult) -> str:
    """Returns how well the policy of a mode holds its set."""
    trainings = f"{result.attempts} training{'' if result.attempts == 1 else 's'}"
    how = f"after {trainings}" if result.attempts else "without a training of its own"
    mode = f"the policy of mode {task.mode_name(result.mode)}{POLICIES.get(result.policy, '')}"
    won = (
        "all of its set that was tried" if result.won == 1 else f"{percent(result.won)} of its set"
    )
    return f"{mode} wins {won}, {how}"


def listed(words: Sequence[str]) -> str:
    """Returns "a, b and c"."""
    return " and ".join(filter(None, [", ".join(words[:-1]), *words[-1:]]))
