"""The verdict: its word follows from scores, episodes and what the stages know, one condition at a time."""

from copy import copy
from dataclasses import replace

import numpy as np
import pytest
from planted import one_way_policy
from scored import SPACING, replays, score

from hyrl_mj import BadArtifact
from hyrl_mj.files import artifacts
from hyrl_mj.judging import Arrivals, ModeResult, Retraining, VerdictSettings, results
from hyrl_mj.judging.game import (
    LIMIT,
    AttackCount,
    Curve,
    Ends,
    EpisodeCount,
    GameResult,
    Profile,
    Robustness,
    compare,
    wilson,
)
from hyrl_mj.judging.sentences import comparison_sentence
from hyrl_mj.judging.verdict import Verdict, Word
from hyrl_mj.policies import PolicyController
from hyrl_mj.simulation import simulate
from hyrl_mj.viz.tables import attack_table, comparison_table, print_verdict

PROVED, WON, HELD, UNDECIDED, WEAK, FAILED = Word

EPS = 0.1
NONE_LOST = (replays(),)
ALL, NO_ONE = Arrivals(1_000, 0, 1_000), Arrivals(0, 0, 1_000)
HOLDS = Retraining((ModeResult(0, 1.0, 1), ModeResult(1, 1.0, 0)))


def game(policy, hyrl, winnable=1.0, bounds=(0.0, EPS), proved=None, replayed=NONE_LOST):
    """The result of a game: the shares that are won at each bound, what is proved of HyRL, and replays."""
    scores = {
        who: tuple(
            score(eps, winnable, won, won, proved=proved if who == "hyrl" else None)
            for eps, won in zip(bounds, shares, strict=True)
        )
        for who, shares in (("policy", policy), ("hyrl", hyrl), (LIMIT, (1.0,) * len(bounds)))
    }
    result = GameResult(
        False, SPACING, scores, {}, {}, {}, {}, Curve((), (), {}), Profile((), {}), replayed
    )  # fmt: skip
    return Robustness(bounds[-1], False, result, (), seed=0)


def episodes(policy, hyrl, eps=EPS):
    """Episodes in two regions, from the number of those out of 1,000 that arrive, by kind of noise."""

    def counts(who, kind, won):
        near = won * 400 // 1_000
        parts = ("near M*", 400, near), ("elsewhere", 600, won - near)
        for region, total, arrived in parts:
            outcomes = {"reached": arrived, "crashed": total - arrived}
            yield EpisodeCount(
                kind, eps, False, who, region, total, outcomes, arrived / total, (0.0, 1.0)
            )

    both = (("policy", policy), ("hyrl", hyrl))
    every = [
        c for who, kinds in both for kind, won in kinds.items() for c in counts(who, kind, won)
    ]
    return Robustness(eps, False, None, tuple(every), seed=0)


def attack_count(who, attacked, lost):
    """An attack of so many starts that are won without noise, and of three that are not."""
    interval = wilson(lost, attacked)
    return AttackCount(
        who, EPS, False, attacked + 3, 3, lost, interval, 3, None, 9, {"none": 9}, (0.0,), "crashed"
    )  # fmt: skip


def compared(noise, n, policy, hyrl):
    """A comparison of n starts, of which the policy and HyRL lose some under noise; none of them both."""

    def ends(lost):
        return Ends(lost, np.ones(n), np.ones(n))

    every, won = np.arange(n), ends(np.zeros(n, dtype=bool))
    lost = {"policy": ends(every < policy), "hyrl": ends(every >= n - hyrl)}
    return compare(noise, dict.fromkeys(lost, won), lost)


def enough(hyrl, attacked=400, lost=0, policy=500):
    """What HELD rests on, from the number of HyRL's episodes out of 1,000 that arrive, by kind of noise."""
    kinds = dict.fromkeys(("none", "uniform", "alternating", "adversarial"), 1_000) | hyrl
    theirs = {kind: 1_000 if kind == "none" else policy for kind in kinds}
    broken = attacked - policy * attacked // 1_000
    counts = [attack_count(who, attacked, n) for who, n in (("policy", broken), ("hyrl", lost))]
    return replace(episodes(theirs, kinds), attacks=tuple(counts))


def word(circle, robustness, retraining=HOLDS, arrivals=ALL, bound=EPS):
    return Verdict.judge(circle, bound, robustness, retraining, arrivals).word


# ---- where the game can be played


@pytest.mark.parametrize(
    ("policy", "hyrl", "expected"),
    [
        ((1.0, 0.9), (1.0, 1.0), WON),
        ((1.0, 1.0), (1.0, 1.0), WON),
        ((1.0, 0.9), (1.0, 0.9999), WEAK),
        ((0.9, 0.8), (0.9, 0.95), WEAK),
        ((1.0, 0.9), (0.9999, 0.99), FAILED),  # worse without noise
        ((1.0, 0.9), (1.0, 0.9), FAILED),  # no better
        ((1.0, 0.9), (1.0, 0.5), FAILED),
        ((0.0, 0.0), (0.0, 0.0), FAILED),
    ],
)
def test_the_word_of_a_game(circle, policy, hyrl, expected):
    assert word(circle, game(policy, hyrl)) == expected


@pytest.mark.parametrize(
    ("hyrl", "proved", "expected"),
    [
        (1.0, 1.0, PROVED),
        (1.0, 0.99, PROVED),
        (0.995, 0.992, PROVED),
        (1.0, 0.98, WON),
        (0.995, 0.98, WEAK),
    ],
)
def test_what_is_proved_of_nearly_all_winnable_starts_has_the_first_word(
    circle, hyrl, proved, expected
):
    assert word(circle, game((1.0, 0.9), (1.0, hyrl), proved=proved)) == expected
    less = game((1.0, 0.9), (1.0, hyrl), bounds=(0.0, 0.05), proved=proved)
    assert word(circle, less) == WEAK, "the run's bound is 0.1"


def test_a_game_that_is_an_estimate_stands_beside_the_episodes_that_decide(circle):
    estimate = game((1.0, 0.4), (1.0, 0.998)).game
    rough = replace(estimate, lattice=replace(SPACING, cells=False))
    assert rough.estimate
    assert not estimate.estimate
    counted = enough({})
    found = Verdict.judge(circle, EPS, replace(counted, game=rough), HOLDS, ALL)
    assert found.word == HELD
    (told,) = [reason for reason in found.reasons if "estimate" in reason]
    assert "beats HyRL from 0.20%" in told
    assert "the policy from 60.00%" in told


def test_what_only_the_attack_finds_counts_beside_the_game(circle):
    won = game((1.0, 0.9), (1.0, 1.0))
    assert word(circle, won) == WON
    counts = tuple(attack_count(who, 200, lost) for who, lost in (("policy", 150), ("hyrl", 3)))
    attacked = replace(won, attacks=counts)
    found = Verdict.judge(circle, EPS, attacked, HOLDS, ALL)
    assert found.word == WEAK
    assert "HyRL loses 1.50%" in found.sentence
    assert any("the attack breaks HyRL from 3 of 200 starts" in r for r in found.reasons)


def test_a_proof_is_told_with_what_is_known_to_be_lost(circle):
    found = Verdict.judge(circle, EPS, game((1.0, 0.9), (1.0, 0.999), proved=0.995), HOLDS, ALL)
    assert str(found) == (
        f"PROVED: whatever the {NOISE}, HyRL is proved to win 99.50% of all starts (99.50% from every start "
        "mode), which is 99.50% of the winnable ones; of what is not proved, 0.10% of the winnable ones are "
        "known to be lost"
    )
    part = game((1.0, 0.9), (1.0, 1.0), proved=1.0, winnable=0.95)
    assert Verdict.judge(circle, EPS, part, HOLDS, ALL).sentence == (
        f"whatever the {NOISE}, HyRL is proved to win 95.00% of all starts (95.00% from every start mode), "
        "which is 100% of the winnable ones"
    )


def test_a_split_that_makes_most_starts_unwinnable_has_no_first_word(circle):
    for proved, expected in ((1.0, PROVED), (None, WON)):
        assert word(circle, game((1.0, 0.9), (1.0, 1.0), winnable=0.9, proved=proved)) == expected
        little = game((1.0, 0.9), (1.0, 1.0), winnable=0.89, proved=proved)
        found = Verdict.judge(circle, EPS, little, HOLDS, ALL)
        assert found.word == WEAK
        assert found.sentence == (
            f"any controller with this split can guarantee at most 89.00% of the starts under {NOISE}, where "
            "with perfect measurements 100% can be won"
        )


@pytest.mark.parametrize(
    ("policy", "hyrl", "expected"), [(1.0, 1.0, WON), (1.0, 0.9, FAILED), (0.8, 0.9, WEAK)]
)
def test_without_noise_all_that_counts_is_that_everything_is_won(circle, policy, hyrl, expected):
    assert word(circle, game((policy,), (hyrl,), bounds=(0.0,)), bound=0.0) == expected


@pytest.mark.parametrize("proved", [1.0, None])
def test_one_lost_replay_withdraws_the_word_and_is_named(circle, proved):
    of = "won" if proved is None else "proved"
    lost = game((1.0, 0.9), (1.0, 1.0), proved=proved, replayed=(replays(lost=1, of=of),))
    verdict = Verdict.judge(circle, EPS, lost, HOLDS, ALL)
    said = "a proved start" if proved else "a start that no known noise beats"
    sentence = (
        f"withdrawn: {said} was lost in a replay: from theta = 3 rad in mode 1 (counter-clockwise) without "
        "noise HyRL ends crashed, and 1 of 1,000 such replays in MuJoCo are lost"
    )
    assert (verdict.word, verdict.sentence.split("; ")[0]) == (FAILED, sentence), (
        "less than the policy"
    )
    assert "HyRL loses 0.25% of the winnable starts or of those replayed" in verdict.sentence
    assert sentence in verdict.reasons
    poor = game((0.9, 0.9), (1.0, 1.0), proved=proved, replayed=(replays(lost=1, of=of),))
    verdict = Verdict.judge(circle, EPS, poor, HOLDS, ALL)
    assert (verdict.word, verdict.sentence) == (WEAK, sentence)


def test_no_word_is_said_without_a_replay(circle):
    for proved in (1.0, None):
        none = game((1.0, 0.9), (1.0, 1.0), proved=proved, replayed=())
        verdict = Verdict.judge(circle, EPS, none, HOLDS, ALL)
        assert verdict.word == WEAK
        assert "was not replayed in MuJoCo, which hyrl-mj robustness RUN does" in verdict.sentence
    of_another = game((1.0, 0.9), (1.0, 1.0), replayed=(replays("policy"),))
    assert word(circle, of_another) == WEAK
    nothing = game((1.0, 0.9), (1.0, 0.95), replayed=())
    assert "replayed" not in str(Verdict.judge(circle, EPS, nothing, HOLDS, ALL))


def test_everything_of_nothing_is_not_won(circle):
    verdict = Verdict.judge(circle, EPS, game((1.0, 1.0), (1.0, 1.0), winnable=0.0), HOLDS, ALL)
    assert verdict.word == FAILED
    assert "no start is winnable under noise of up to 0.1 rad on theta" in verdict.sentence


def test_stage_6_has_given_up_where_a_mode_does_not_hold_its_set(circle):
    lost = Retraining((ModeResult(0, 0.6, 3), ModeResult(1, 1.0, 1)))
    verdict = Verdict.judge(circle, EPS, game((1.0, 0.5), (1.0, 0.9)), lost, ALL)
    assert verdict.word == FAILED
    assert verdict.sentence == "stage 6 gave up on mode 0 (clockwise)"
    assert any("60.00% of its set, after 3 trainings" in reason for reason in verdict.reasons)
    assert word(circle, game((1.0, 0.5), (1.0, 0.9))) == WEAK
    assert word(circle, game((1.0, 0.5), (1.0, 1.0)), lost) == WON, "the game has the last word"


def test_a_policy_that_does_not_arrive_is_said_with_its_number(circle):
    poor = Arrivals(430, 0, 1_000)
    verdict = Verdict.judge(circle, EPS, game((0.4, 0.4), (0.4, 0.4)), HOLDS, poor)
    assert verdict.word == WEAK
    assert "arrives from 430 of 1,000 starts without noise" in verdict.sentence


def test_less_noise_than_the_run_s_is_not_enough_and_more_is(circle):
    assert word(circle, game((1.0, 0.9), (1.0, 1.0), bounds=(0.0, 0.05))) == WEAK
    verdict = Verdict.judge(
        circle, EPS, game((1.0, 0.9), (1.0, 1.0), bounds=(0.0, 0.2)), HOLDS, ALL
    )
    assert verdict.word == WON
    assert "0.2 rad" in verdict.sentence


# ---- where it cannot


@pytest.mark.parametrize(
    ("robustness", "expected"),
    [
        (enough({}), HELD),
        (enough({"uniform": 997}), HELD),
        (enough({"uniform": 996}), UNDECIDED),  # its interval begins at 98.98%
        (enough({"uniform": 985}), UNDECIDED),  # and ends at 99.09%
        (enough({"uniform": 983}), WEAK),
        (enough({"none": 900}), FAILED),  # less than the policy
        (enough({"uniform": 500}, policy=500), FAILED),
        (enough({"adversarial": 80}, policy=100), FAILED),  # the kind that stops most counts
        (enough({}, attacked=300), UNDECIDED),  # its interval begins at 98.74%
        (enough({}, attacked=381), HELD),
        (enough({}, attacked=1_000, lost=3), HELD),
        (enough({}, attacked=200, lost=2), UNDECIDED),
        (enough({}, attacked=200, lost=9), WEAK),
        (replace(enough({}), attacks=()), UNDECIDED),
        (episodes({"none": 1000}, {"none": 1000}), WEAK),  # not examined under noise
        (
            episodes({"none": 1000, "uniform": 500}, {"none": 1000, "uniform": 1000}),
            UNDECIDED,  # one kind of noise alone
        ),
    ],
)
def test_the_word_of_episodes(circle, robustness, expected):
    assert word(circle, robustness) == expected


def test_fewer_episodes_than_are_asked_for_are_too_few(circle):
    settings = VerdictSettings(episodes=1_001)
    assert Verdict.judge(circle, EPS, enough({}), HOLDS, ALL, settings).word == UNDECIDED


def test_what_is_missing_is_said_with_what_to_run(circle):
    verdict = Verdict.judge(circle, EPS, enough({"uniform": 996}, attacked=200), HOLDS, ALL)
    assert str(verdict) == (
        f"UNDECIDED: HyRL may win nearly all under {NOISE}, but this is too little to say so: 996 of 1,000 "
        "episodes under uniform noise, 200 of 200 attacked starts; hyrl-mj robustness RUN --episodes 4000 "
        "--attack-starts 400 decides"
    )


def test_better_is_what_the_same_starts_show(circle, vehicle):
    some = enough({"uniform": 900}, policy=880)
    assert word(circle, some) == WEAK
    near = replace(some, comparisons=(compared("uniform", 1_000, 120, 100),))
    assert near.comparisons[0].interval[0] < 0 < near.comparisons[0].interval[1]
    assert word(circle, near) == FAILED
    far = replace(some, comparisons=(compared("uniform", 1_000, 160, 100),))
    assert far.comparisons[0].interval[0] > 0
    verdict = Verdict.judge(circle, EPS, far, HOLDS, ALL)
    assert verdict.word == WEAK
    assert (
        "uniform noise: of 1,000 starts that both win without noise the policy loses 160 and HyRL 100 "
        "(difference 6.0 points, 95% interval 2.8 to 9.1)"
    ) in verdict.reasons
    assert "late are 0 and 0" in comparison_sentence(vehicle, far.comparisons[0])
    # An episode that goes on after the arrival, as all of the circle do, does not tell when that was.
    goes_on = copy(vehicle)
    goes_on.abilities = replace(vehicle.abilities, arrival_ends=False)
    for task in (circle, goes_on):
        assert "late" not in comparison_sentence(task, far.comparisons[0])
        assert "-" in comparison_table(task, far.comparisons).rows[0]


def test_of_no_start_no_figure_is_given(vehicle):
    none = compared("uniform", 0, 0, 0)
    assert comparison_sentence(vehicle, none) == (
        "uniform noise: there is no start that both win without noise, so nothing is compared"
    )
    assert comparison_table(vehicle, (none,)).rows[0][4:] == ["-", "-, -", "-; -", "-; -"]
    one = comparison_table(vehicle, (compared("uniform", 9, 9, 0),)).rows[0]
    assert one[-3:] == ["-, 0", "-; 1.00 1.00", "-; 1.00 1.00"]  # of runs that arrive
    row = attack_table(vehicle, (attack_count("policy", 0, 0),)).rows[0]
    assert row[3:6] == ["0", "-", "-"]


# ---- what is said, and kept


def test_a_verdict_reads_as_a_sentence_with_reasons(circle, capsys):
    class Planted:
        verdict = Verdict.judge(circle, EPS, game((1.0, 0.9), (1.0, 1.0), 0.9), HOLDS, ALL)

    print_verdict(Planted)
    first, *rest = capsys.readouterr().out.splitlines()
    assert first == (
        f"WON: HyRL lost none of the winnable starts, 90.00% of all, that were tried under the worst {NOISE}"
    )
    assert rest == [
        f"- under {NOISE} any controller with this split can guarantee at most 90.00% of the starts; with "
        "perfect measurements 100% can be won",
        "- without noise HyRL is not known to lose any of the winnable starts, the policy is not known to "
        "lose any",
        f"- under the worst {NOISE} HyRL is not known to lose any of the winnable starts, the policy is "
        "known to lose 10.00%",
        "- HyRL lost none of 1,000 proved starts when they were replayed in MuJoCo",
        "- stage 1: the policy arrives from 1,000 of 1,000 starts without noise",
        "- stage 6: the policy of mode 0 (clockwise) wins every state tested in its set, after 1 training",
        "- stage 6: the policy of mode 1 (counter-clockwise) wins every state tested in its set, without a "
        "training of its own",
    ]


NOISE = "noise of up to 0.1 rad on theta"


@pytest.mark.parametrize("result", [Arrivals(3, 1, 10), HOLDS])
def test_results_of_stages_survive_being_written(result, tmp_path):
    path = tmp_path / "result.json"
    result.save(path)
    assert type(result).load(path) == result
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(BadArtifact, match=r"result\.json"):
        type(result).load(path)


def test_a_share_that_is_a_word_is_refused(tmp_path):
    content = {"modes": [{"mode": 0, "won": "all", "attempts": 1}]}
    artifacts.write_json(tmp_path / "retraining.json", content, "retraining")
    with pytest.raises(BadArtifact, match=r"modes\.0\.won"):
        Retraining.load(tmp_path / "retraining.json")


def test_arrivals_are_those_of_simulations(vehicle, monkeypatch):
    monkeypatch.setattr(results, "EPISODES", 100)
    policy = one_way_policy(vehicle, 1.0)  # it goes on beside the set-point
    found = Arrivals.measure(vehicle, policy)
    arcs = simulate(
        vehicle, PolicyController(policy), vehicle.starts(100, np.random.default_rng(0))
    )
    assert found.arrived == sum(arc.outcome == "reached" for arc in arcs)
    assert found.missed == found.arrived > 50
    assert f"in {found.missed:,} of them off the set-point" in str(found)
