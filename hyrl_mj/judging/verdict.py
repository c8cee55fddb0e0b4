"""The verdict on a run: one word, a sentence, and the reasons."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum

from hyrl_mj.errors import listed
from hyrl_mj.judging.evidence import Sample, VerdictSettings, by_kind, success_rates
from hyrl_mj.judging.game import NEARLY, NO_NOISE, ReplayCount, Robustness, Score, percent
from hyrl_mj.judging.results import Arrivals, Retraining
from hyrl_mj.judging.sentences import (
    NAMES,
    POLICIES,
    comparison_sentence,
    mode_sentence,
    replays_sentence,
    share_sentence,
)
from hyrl_mj.simulation import covers_sensor, usual_kinds
from hyrl_mj.tasks import Task


class Word(StrEnum):
    """The first word of a verdict; `Verdict` says what each asks for."""

    PROVED = "PROVED"
    WON = "WON"
    HELD = "HELD"
    UNDECIDED = "UNDECIDED"
    WEAK = "WEAK"
    FAILED = "FAILED"


@dataclass(frozen=True)
class Verdict:
    """What the hybrid controller of a run is worth.

    `word` is the first of these whose condition holds. To win is to arrive within the task's `max_steps`;
    nearly all are 99%.

    - PROVED: HyRL is proved to win nearly all winnable starts, whatever the noise within the run's bound,
      and at least 90% of the open starts are winnable.
    - WON: the worst-case game decides, of no winnable start a noise signal is known that beats HyRL, from
      the attack, if there was one, either, and at least 90% of the open starts are winnable.
    - HELD: the game cannot be played or is an estimate, and HyRL wins nearly all, at the lower end of the
      95% interval, of at least 1,000 episodes without noise and under each kind of noise, and of at least
      300 starts that were attacked.
    - UNDECIDED: as HELD, but there are too few episodes or attacked starts, or too few of them are won, for
      HELD to be said; and not too many are lost for it to be said after more of them.
    - FAILED: no start is winnable, or HyRL wins less than the policy without noise, or stage 6 gave up: for
      some mode no attempt gave a policy that wins nearly all of its set. Tasks with a reward for each mode,
      as `field`, may draw episodes that no policy wins: there stage 6 does not give up.
    - WEAK: HyRL wins more than the policy under noise; where the game does not decide, so much more from the
      same starts that the 95% interval of the difference is above 0. Or the policy does not arrive from
      nearly all of its starts without noise, or the examination was under less noise than the run's bound,
      or too few of the open starts are winnable.
    - FAILED: none of these. HyRL loses, and is no better than the policy.

    PROVED and WON are said only after starts that are proved, or not known to be lost, were replayed in
    MuJoCo: a single one that is lost withdraws both words, and is named.

    In the game, HyRL picks its start mode. In episodes, the kind of noise that stops a controller most often
    counts; the attack is one of these kinds. It is counted from starts that are won without noise.

    Attributes:
        word: the word.
        sentence: what decided.
        reasons: the results behind it, a sentence each.
    """

    word: Word
    sentence: str
    reasons: tuple[str, ...]

    def __repr__(self) -> str:
        return f"Verdict({self})"

    def __str__(self) -> str:
        return f"{self.word}: {self.sentence}"

    @property
    def tone(self) -> str:
        """How a page shows the word: "good", "undecided" or "bad"."""
        good = self.word in (Word.PROVED, Word.WON, Word.HELD)
        return "good" if good else "undecided" if self.word == Word.UNDECIDED else "bad"

    @staticmethod
    def judge(
        task: Task,
        bound: float,
        robustness: Robustness,
        retraining: Retraining,
        arrivals: Arrivals,
        settings: VerdictSettings = VerdictSettings(),
    ) -> Verdict:
        """Returns the verdict on a run.

        Args:
            task: the robot and its problem.
            bound: the run's noise bound.
            robustness: the result of the examination.
            retraining: the result of stage 6.
            arrivals: from how many starts the policy of stage 1, or the agent, arrives without noise.
            settings: what the words ask for.
        """
        case = _Case(task, bound, robustness, retraining, arrivals, settings)
        reasons, withdrawn = tuple(case.reasons()), [*case.withdrawn()]
        failures = [*case.failures()]
        for word, grounds in (
            (Word.PROVED, case.proved() if case.stands else ()),
            (Word.WON if robustness.deciding else Word.HELD, case.won() if case.stands else ()),
            (Word.UNDECIDED, case.doubts()),
            (Word.FAILED, [*withdrawn, *failures] if failures else ()),
            (Word.WEAK, [*withdrawn, *case.weaknesses()]),
        ):
            if sentence := "; ".join(grounds):
                return Verdict(word, sentence, reasons)
        return Verdict(
            Word.FAILED, f"HyRL is no better than the policy under {case.noise}", reasons
        )


@dataclass(frozen=True)
class _Case:
    """What a verdict is decided by; the attributes are those of `Verdict.judge`."""

    task: Task
    bound: float
    robustness: Robustness
    retraining: Retraining
    arrivals: Arrivals
    settings: VerdictSettings

    @property
    def noise(self) -> str:
        """The noise of the examination, in words."""
        robustness = self.robustness
        return f"noise of up to {self.task.noise_text(robustness.eps, robustness.everywhere)}"

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
        return (
            self.robustness.eps >= self.bound
            and success_rates(self.robustness, "hyrl")[1] is not None
        )

    @property
    def score(self) -> Score | None:
        """What the game, if it decides, says of HyRL under the noise."""
        game = self.robustness.deciding
        return game.scores["hyrl"][-1] if game else None

    @property
    def winnable(self) -> float:
        """The share of the starts that can be won under the noise."""
        return self.score.winnable if self.score else 1.0

    @property
    def open(self) -> float:
        """The share of the starts that are open to one who sees the state."""
        return self.score.open if self.score else 1.0

    @property
    def replays(self) -> ReplayCount | None:
        """The replays of HyRL in MuJoCo, None if there were none."""
        game = self.robustness.deciding
        return game.replays_of("hyrl") if game else None

    @property
    def stands(self) -> bool:
        """Whether what the game says of HyRL, if it decides, was replayed in MuJoCo and nothing was lost."""
        replayed = self.replays is not None and not self.replays.failures
        return replayed or not self.robustness.deciding

    def withdrawn(self) -> Iterator[str]:
        """Yields why the run is neither PROVED nor WON, although the game says so."""
        if self.stands:
            return
        if self.replays:
            yield replays_sentence(self.task, self.replays)
        elif [*self.proved(), *self.won()]:
            yield (
                "what the worst-case game says of HyRL was not replayed in MuJoCo, which "
                "hyrl-mj robustness RUN does"
            )

    def proved(self) -> Iterator[str]:
        """Yields why the run is PROVED, if the game is to be believed."""
        score = self.score
        if not score or not self.examined or not self.winnable:
            return
        if self.fair and score.proved is not None and score.proved >= NEARLY:
            own, some = score.proved * score.winnable, (score.proved_any or 0.0) * score.winnable
            sentence = (
                f"whatever the {self.noise}, HyRL is proved to win {percent(own)} of all starts "
                f"({percent(some)} from every start mode), which is {percent(score.proved)} of the winnable "
                "ones"
            )
            if score.not_broken < 1:
                sentence += (
                    f"; of what is not proved, {percent(1 - score.not_broken)} of the winnable ones are "
                    "known to be lost"
                )
            yield sentence

    def won(self) -> Iterator[str]:
        """Yields why the run is WON or HELD, if the game is to be believed."""
        _, won = success_rates(self.robustness, "hyrl")
        if not self.examined or not self.winnable or won is None:
            return
        if self.robustness.deciding and won == 1 and self.fair:
            yield (
                f"HyRL lost none of {self.whole}, {percent(self.winnable)} of all, that were tried under "
                f"the worst {self.noise}"
            )
        elif not self.robustness.deciding and all(sample.held for sample in self.samples):
            counts = by_kind(self.robustness, "hyrl")
            counts.pop(NO_NOISE, None)
            arrived, total = (sum(column) for column in zip(*counts.values(), (0, 0), strict=True))
            yield f"HyRL arrives in {arrived:,} of {total:,} episodes, with {self.noise}"
            yield from self._attacked("hyrl")

    def doubts(self) -> Iterator[str]:
        """Yields why the run is UNDECIDED, if it is: what is missing for HELD, and what to run."""
        if self.robustness.deciding or not self.examined:
            return
        samples = self.samples
        if any(sample.refuted for sample in samples) or all(sample.held for sample in samples):
            return
        words, episodes, starts = [], 0, 0
        for sample in samples:
            if not sample.held:
                words.append(str(sample))
                if sample.kind == "attack":
                    starts = max(starts, sample.enough)
                else:
                    episodes = max(episodes, sample.enough)
        command = "hyrl-mj robustness RUN"
        command += f" --episodes {episodes}" * (episodes > 0)
        command += f" --attack-starts {starts}" * (starts > 0)
        yield (
            f"HyRL may win nearly all under {self.noise}, but this is too little to say so: "
            f"{', '.join(words)}; {command} decides"
        )

    @property
    def samples(self) -> list[Sample]:
        """What HELD rests on: episodes without noise and of each kind of noise, and attacked starts."""
        counts, s, found = by_kind(self.robustness, "hyrl"), self.settings, self.robustness
        samples = [
            Sample(kind, *counts.get(kind, (0, 0)), s.episodes)
            for kind in dict.fromkeys(
                (*usual_kinds(self.task, found.eps, found.everywhere), *counts)
            )
        ]
        attacks = [c for c in self.robustness.attacks if c.controller == "hyrl"]
        won, total = next(((c.attacked - c.lost, c.attacked) for c in attacks), (0, 0))
        return [*samples, Sample("attack", won, total, s.attacked)]

    @property
    def fair(self) -> bool:
        """Whether most of the starts that are open to one who sees the state are winnable."""
        return self.winnable >= self.settings.winnable * self.open

    def failures(self) -> Iterator[str]:
        """Yields what makes a run a failure, whatever else it does."""
        if not self.winnable:
            yield f"no start is winnable under {self.noise}"
        policy, hyrl = (success_rates(self.robustness, who)[0] for who in NAMES)
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
        if not self.arrivals.nearly_all:
            yield f"the policy {self.arrivals}"
        policy, hyrl = (success_rates(self.robustness, who)[1] for who in NAMES)
        if policy is not None and hyrl is not None and policy < hyrl < 1 and self.better:
            whole = self.lost_of
            if self.robustness.attacks:
                whole = f"{whole} or of those attacked"
            yield (
                f"HyRL loses {percent(1 - hyrl)} of {whole} under {self.noise}, but fewer than the policy "
                f"({percent(1 - policy)})"
            )
        if not self.fair:
            yield (
                f"any controller with this split can guarantee at most {percent(self.winnable)} of the "
                f"starts under {self.noise}, where with perfect measurements {percent(self.open)} can be won"
            )
        if not self.examined:
            yield (
                f"HyRL was not examined under the run's noise bound {self.bound:g}, which "
                "hyrl-mj robustness RUN does"
            )

    @property
    def better(self) -> bool:
        """Whether HyRL wins more than the policy under noise, as far as comparisons tell.

        Where the game decides, or nothing is compared, shares alone tell.
        """
        comparisons = self.robustness.comparisons
        if self.robustness.deciding or not comparisons:
            return True
        return any(c.interval[0] > 0 for c in comparisons)

    def reasons(self) -> Iterator[str]:
        """Yields the results behind the verdict."""
        if covers_sensor(self.task, self.robustness.eps):
            where = listed(self.task.chart.names)
            yield f"what the sensors do to {where} is within that bound: {self.task.sensor}"
        yield from self._shares() if self.robustness.deciding else self._counts()
        yield from (comparison_sentence(self.task, c) for c in self.robustness.comparisons)
        yield f"stage 1: the policy {self.arrivals}"
        for result in self.retraining.modes:
            yield f"stage 6: {mode_sentence(self.task, result)}"

    def _shares(self) -> Iterator[str]:
        """Yields what is won in the worst-case game."""
        if self.winnable < 1:
            yield (
                f"under {self.noise} any controller with this split can guarantee at most "
                f"{percent(self.winnable)} of the starts; with perfect measurements {percent(self.open)} "
                "can be won"
            )
        assert self.robustness.deciding
        policy, hyrl = (self.robustness.deciding.scores[who] for who in NAMES)
        for ours, theirs in zip(hyrl, policy, strict=True):
            if ours.eps in (0, self.robustness.eps):
                when = f"under the worst {self.noise}" if ours.eps else "without noise"
                yield (
                    f"{when} HyRL {share_sentence(ours)} of {self.whole}, the policy {share_sentence(theirs)}"
                )
        if sensed := self.robustness.deciding.sensed:
            each = [
                f"{NAMES[who]} from {percent(sensed[who].proved)}"
                for who in ("hyrl", "policy")
                if who in sensed
            ]
            yield (
                "the sensor can do less than all noise within that bound: under the sensor itself are proved "
                f"{' and '.join(each)} of all starts"
            )
        for count in self.robustness.deciding.replays:
            yield replays_sentence(self.task, count)
        yield from self._attacked("hyrl", "policy")

    def _counts(self) -> Iterator[str]:
        """Yields the numbers of episodes that arrive, by kind of noise."""
        policy = by_kind(self.robustness, "policy")
        for kind, (arrived, episodes) in by_kind(self.robustness, "hyrl").items():
            when = "without noise" if kind == NO_NOISE else f"under {kind} {self.noise}"
            theirs, _ = policy[kind]
            yield f"{when} HyRL arrives in {arrived:,} of {episodes:,} episodes, the policy in {theirs:,}"
        yield from self._attacked("hyrl", "policy")
        game = self.robustness.game
        if game and game.other_starts:
            yield game.other_starts
        elif game:
            policy_lost, lost = (1 - game.scores[who][-1].not_broken for who in NAMES)
            yield (
                f"the worst-case game on nodes, here an estimate, finds noise that beats HyRL from "
                f"{percent(lost)} of the starts that were tried, and the policy from "
                f"{percent(policy_lost)}"
            )

    def _attacked(self, *controllers: str) -> Iterator[str]:
        """Yields in one sentence from how many starts the attack, if any, breaks these controllers."""
        found = {c.controller: c for c in self.robustness.attacks}
        breaks = [f"{NAMES[who]} from {found[who].broken}" for who in controllers if who in found]
        if breaks:
            yield f"the attack breaks {', '.join(breaks)}"
