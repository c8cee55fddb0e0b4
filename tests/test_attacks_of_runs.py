"""The attack on a run: what is written, read, printed, played and judged."""

import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from planted import decisions, halves
from test_report import Page, plant
from test_verdict import ALL, EPS, HOLDS, enough, episodes

import hyrl_mj
from hyrl_mj import BadArtifact, BadInput, load_run, pipeline
from hyrl_mj.cli import commands as of_commands
from hyrl_mj.judging import examination
from hyrl_mj.judging.game import AttackCount, Robustness, wilson
from hyrl_mj.judging.verdict import Verdict, Word
from hyrl_mj.pipeline import ExamineOptions, examine_run, run_stage
from hyrl_mj.pipeline.steps import subject_of
from hyrl_mj.runs.arcs import noisy_arcs
from hyrl_mj.runs.directory import Run
from hyrl_mj.tasks import SPARING
from hyrl_mj.viz.commands import commands
from hyrl_mj.viz.report import render
from hyrl_mj.viz.shows import replay_shows
from hyrl_mj.viz.tables import (
    attack_table,
    comparison_table,
    print_robustness,
    robustness_sentence,
    robustness_tables,
)

FEW = {"episodes": 20, "noise": ("none", "uniform")}


@pytest.fixture(scope="module", autouse=True)
def without_game():
    """The vehicle as a robot whose worst case cannot be computed."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Run, "why_no_game", "it is not wanted here")
        yield


@pytest.fixture(scope="module")
def examined(tmp_path_factory):
    path, task = tmp_path_factory.mktemp("attacked") / "vehicle", hyrl_mj.get_task("vehicle")
    run = plant(path, task, decisions(task), halves(task, 60))
    examine_run(run, ExamineOptions(**FEW), say=str)
    run_stage(load_run(path), "simulate", say=str)
    return path


@pytest.fixture
def copied(examined, tmp_path):
    return shutil.copytree(examined, tmp_path / "vehicle")


def attacked(policy, hyrl, starts=200):
    """The counts of an attack."""
    return tuple(
        AttackCount(
            who, EPS, False, starts, 0, lost, (0.0, 1.0), 3, None, 9, {"none": starts}, (0.0, 0.05), "crashed"
        )
        for who, lost in (("policy", policy), ("hyrl", hyrl))
    )  # fmt: skip


# ---- the examination


def test_a_run_without_a_game_is_attacked_by_default(examined):
    policy, hyrl = load_run(examined).robustness.attacks
    assert (policy.controller, hyrl.controller) == ("policy", "hyrl")
    assert policy.rounds <= SPARING.attack_rounds
    assert (policy.starts, policy.seconds) == (SPARING.attack_starts, None)
    assert hyrl.starts == 100
    assert policy.interval == wilson(policy.lost, policy.attacked)
    assert policy.unaided + policy.lost > 0


def test_both_controllers_are_compared_from_the_same_starts(examined):
    robustness = load_run(examined).robustness
    by_kind = {compared.noise: compared for compared in robustness.comparisons}
    assert [*by_kind] == ["uniform", "attack"]
    assert by_kind["uniform"].starts == 20
    attack, counts = by_kind["attack"], {c.controller: c for c in robustness.attacks}
    assert attack.unaided == {name: count.unaided for name, count in counts.items()}
    assert max(attack.unaided.values()) <= attack.starts - attack.compared
    for name, count in counts.items():
        assert attack.lost[name] <= count.lost
        assert attack.time[name][0] >= 1
    table = comparison_table(load_run(examined).task, robustness.comparisons)
    assert [row[0] for row in table.rows] == [*by_kind]


def test_a_run_with_a_game_is_attacked_only_on_request(examined, monkeypatch):
    monkeypatch.setattr(Run, "why_no_game", None)
    run = load_run(examined)
    assert ExamineOptions().budget(SPARING, run.exact) is None
    assert ExamineOptions(attack_seconds=2.0).budget(SPARING, run.exact).seconds == 2.0
    assert ExamineOptions(attack_rounds=5).budget(SPARING, run.exact).rounds == 5
    assert (
        ExamineOptions(attack_starts=9).budget(SPARING, run.exact).rounds == SPARING.attack_rounds
    )


def test_a_run_whose_game_turns_out_to_decide_nothing_is_attacked(examined, monkeypatch):
    """As where starts are drawn otherwise than the game counts them, which the maps tell."""
    run, game = load_run(examined), SimpleNamespace(decides=False)
    monkeypatch.setattr(examination, "worst_case", lambda *_: (game, None))
    subject = subject_of(run, run.controllers, run.split)
    subject = replace(subject, playable=True, exact=True, effort=replace(SPARING, attack_starts=9))
    options = ExamineOptions(episodes=1, noise=("none",))
    for attacked in (True, False):
        assert bool(examination.examine(subject, options, attacked).robustness.attacks) == attacked


@pytest.mark.slow
def test_the_rounds_of_a_time_repeat_it(copied):
    timed = examine_run(load_run(copied), ExamineOptions(**FEW, attack_seconds=0.2), say=str)
    files = {path: path.read_bytes() for path in sorted((copied / "arcs").glob("attack_*"))}
    assert len(files) == 2
    rounds = timed.attacks[0].rounds
    again = examine_run(load_run(copied), ExamineOptions(**FEW, attack_rounds=rounds), say=str)
    assert [c.lost for c in again.attacks] == [c.lost for c in timed.attacks]
    assert {path: path.read_bytes() for path in files} == files
    assert (
        f"--attack-rounds {rounds} --attack-starts 100 --seed 0"
        in commands(load_run(copied), again)[-1]
    )


def test_an_examination_near_the_critical_set_counts_for_no_other(copied):
    run = load_run(copied)
    assert run.is_examined_as_usual
    options = ExamineOptions(**FEW, near_critical=True, attack_rounds=1, attack_starts=9)
    again = examine_run(run, options, say=str)
    assert not load_run(copied).is_examined_as_usual
    assert "--near-critical" in commands(load_run(copied), again)[-1]
    notes = [str(table.note) for table in robustness_tables(run.task, again)]
    assert any("All of the starts lie near the critical set." in note for note in notes)


def test_near_the_critical_set_is_about_episodes_and_the_attack(examined, monkeypatch):
    run, asked = load_run(examined), []
    monkeypatch.setattr(Run, "exact", True)
    monkeypatch.setattr(pipeline, "examine_run", lambda _, options: asked.append(options))
    monkeypatch.setattr(of_commands, "print_robustness", lambda _: None)
    with pytest.raises(BadInput, match="--near-critical is about the episodes: say how many"):
        of_commands.robustness(run, ExamineOptions(near_critical=True))
    of_commands.robustness(run, ExamineOptions(near_critical=True, attack_rounds=1))
    assert [options.near_critical for options in asked] == [True]


@pytest.mark.parametrize("options", [{"attack_rounds": -1}, {"attack_starts": 0}])
def test_an_impossible_budget_is_refused_before_any_work(copied, options):
    before = {path: path.read_bytes() for path in copied.rglob("*") if path.is_file()}
    with pytest.raises(BadInput, match=r"attack_.* cannot be used"):
        examine_run(load_run(copied), ExamineOptions(**options), say=str)
    assert {path: path.read_bytes() for path in copied.rglob("*") if path.is_file()} == before


# ---- the record


@pytest.mark.parametrize(
    "attacks", [attacked(1, 1)[:1], attacked(201, 0), attacked(-1, 0), attacked(0, 0, starts=0)]
)
def test_a_record_of_half_an_attack_is_refused(tmp_path, attacks):
    both = episodes({"uniform": 1000}, {"uniform": 1000})
    path = tmp_path / "robustness.json"
    Robustness(EPS, False, None, both.episodes, 0, attacks).save(path)
    with pytest.raises(BadArtifact, match="its attacks are not those of policy and hyrl"):
        Robustness.load(path, of=("policy", "hyrl"))


# ---- what is shown


def test_the_table_and_the_sentence_tell_what_is_lost(vehicle, examined, capsys):
    run = load_run(examined)
    table = attack_table(vehicle, attacked(91, 2))
    assert table.rows[0][:5] == ["RL policy", "200", "0", "91", "45.50%"]
    assert table.rows[1][-1] == "crashed from (0.000, 0.050)"
    lost = [count.lost for count in run.robustness.attacks]
    won = [count.attacked for count in run.robustness.attacks]
    said = f"the attack breaks RL policy from {lost[0]} of {won[0]} starts, HyRL from {lost[1]} of {won[1]}"
    assert said in robustness_sentence(run.robustness)
    print_robustness(run)
    assert "attack, a search for noise of up to 0.1 m on y" in capsys.readouterr().out


def test_the_starts_that_the_attack_broke_are_told(examined):
    run = load_run(examined)
    for count in run.robustness.attacks:
        lost = run.lost(count.controller)
        assert lost.shape == (count.lost, 2)
        assert run.task.may_start(lost).all()
        if count.lost:  # the strongest signal is one of theirs
            assert (lost == count.start).all(axis=1).any()


def test_the_replay_plays_the_strongest_signals_from_one_start(examined):
    (show,) = replay_shows(load_run(examined))
    (policy,), (hyrl,) = show.policy, show.hybrid
    assert (policy.noise, hyrl.noise) == ("attack", "attack")
    np.testing.assert_array_equal(policy.z[0], hyrl.z[0])
    assert (policy.controller, hyrl.controller) == ("policy", "hyrl")
    assert policy.outcome != "reached"
    assert len(replay_shows(load_run(examined), noise="uniform")) == 2, "one for each mode"


def test_the_replay_of_a_run_whose_game_decides_is_as_ever(examined, monkeypatch):
    monkeypatch.setattr(Robustness, "deciding", object())
    shows = replay_shows(load_run(examined))
    assert [show.policy[0].noise for show in shows] == ["alternating"] * 2


def test_the_page_has_the_numbers_and_the_table(examined):
    page = Page(render(load_run(examined)))
    rows = page.table("attack, a search")
    assert [row["controller"] for row in rows] == ["RL policy", "HyRL"]
    assert rows[0]["lost"] == f"{load_run(examined).robustness.attacks[0].lost}"
    assert any("the attack breaks it" in number for number in page.numbers)


def test_a_start_of_ones_own_is_attacked_in_each_mode(examined):
    run = load_run(examined)
    arcs = noisy_arcs(run, np.array([[0.1, 0.01]]), "attack", q0s=(0, 1))
    assert set(arcs) == {"policy", "hyrl_q0", "hyrl_q1"}
    assert {arc.noise for (arc,) in arcs.values()} == {"attack"}
    assert [arcs[f"hyrl_q{q}"][0].q[0] for q in (0, 1)] == [0, 1]
    assert arcs["policy"][0].outcome != "reached"


# ---- the verdict


def test_what_the_attack_breaks_is_among_the_reasons(circle):
    verdict = Verdict.judge(circle, EPS, enough({}, lost=0), HOLDS, ALL)
    assert verdict.word == Word.HELD
    said = "the attack breaks HyRL from 0 of 400 starts"
    assert said in verdict.sentence
    assert f"{said}, the policy from 200 of 400 starts" in verdict.reasons
