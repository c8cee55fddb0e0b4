"""The summary that ends a run: its tables and sentences say what the planted run did."""

import shutil

import pytest
from planted import played_before, without_pictures

import hyrl_mj
from hyrl_mj.pipeline import ExamineOptions, examine_run
from hyrl_mj.viz.tables import (
    arrivals,
    episode_table,
    margin_table,
    print_robustness,
    print_summary,
    replay_sentence,
    replay_table,
    score_table,
)

pytestmark = pytest.mark.slow  # as in test_pipeline


@pytest.fixture(scope="module")
def run(planted_circle):
    return planted_circle[0]


@pytest.fixture(scope="module")
def examined(run, tmp_path_factory):
    """A copy with noisy episodes, too."""
    path = tmp_path_factory.mktemp("examined") / "run"
    copy = hyrl_mj.load_run(shutil.copytree(run.path, path))
    with pytest.MonkeyPatch.context() as patch:
        played_before(patch, copy)
        without_pictures(patch)
        examine_run(copy, ExamineOptions(noise=("uniform",), episodes=40), str)
    return hyrl_mj.load_run(copy.path)


# ---- tables


def test_a_replay_is_a_row_with_the_ending_of_each_controller(run):
    arcs = run.arcs()
    table = replay_table(run, arcs)
    starts = list(dict.fromkeys(start for start, _ in arcs))
    assert len(table.rows) == len(starts)
    assert len(table.headings) == 2 + len(run.extended_sets.modes)
    for start, (first, *endings) in zip(starts, table.rows, strict=True):
        assert f"({arcs[start, 'policy'].z[0, 0]:.3f})" in first
        assert ("on M*" in first) == (start == "critical")
        for who, ending in zip(("policy", "hyrl_q0", "hyrl_q1"), endings, strict=True):
            arc = arcs[start, who]
            assert ending.success == arc.arrives(run.task)
            assert ending.details.startswith(f"{arc.t[-1]:.2f} s, {arc.j[-1]} jump")


def test_arrivals_are_counted_without_the_start_on_the_critical_set(run):
    arcs = run.arcs()
    paper = {start for start, _ in arcs} - {"critical"}
    won, total = arrivals(run, arcs, policy=False)
    assert total == len(run.extended_sets.modes) * len(paper)
    ours = [a for (s, who), a in arcs.items() if s in paper and who != "policy"]
    assert won == sum(arc.arrives(run.task) for arc in ours)
    assert replay_sentence(run, arcs).endswith(f"from {won} of {total} of the scene's starts")
    with pytest.MonkeyPatch.context() as patch:  # runs of the scene that last longer than episodes
        patch.setattr(run.task, "max_steps", 20)
        assert replay_sentence(run, arcs).endswith("within 4 s; an episode lasts 1 s")
    assert arrivals(run, arcs, policy=True)[1] == len(paper)


def test_scores_are_a_row_for_each_bound_and_controller(run):
    table = score_table(run.task, run.robustness.game)
    assert [row[0] for row in table.rows] == ["0"] * 3 + ["0.05"] * 3 + ["0.1"] * 3
    assert [row[3] for row in table.rows] == ["RL policy", "HyRL", "limit"] * 3
    assert all(len(row) == len(table.headings) for row in table.rows)
    limits = [dict(zip(table.headings, row, strict=True)) for row in table.rows if "limit" in row]
    assert all(row["not broken, own q0"] == "all" for row in limits)
    assert all(row["proved, own q0"] == "-" for row in limits)
    assert "excursion [rad]" in table.headings, "a run on the circle goes on for ever"


def test_episodes_are_counted_by_noise_controller_and_region(examined):
    table = episode_table(examined.task, examined.robustness.episodes)
    assert {row[0] for row in table.rows} == {"uniform 0.1 rad"}
    assert {row[1] for row in table.rows} == {"RL policy", "HyRL"}
    counted = {"RL policy": 0, "HyRL": 0}
    for _, who, _, episodes, reached, interval, outcomes in table.rows:
        ends = [int(part.split()[-1].replace(",", "")) for part in outcomes.split(", ")]
        assert sum(ends) == int(episodes)
        counted[who] += sum(ends)
        low, high = (float(end.strip("<>%")) for end in interval.split(" - "))
        share = 100 if reached == "all tried" else float(reached.strip("<>%"))
        assert low <= share <= high
    assert counted == {"RL policy": 40, "HyRL": 40}


# ---- on the terminal


def test_the_summary_prints_every_table_and_where_everything_lies(examined, capsys):
    print_summary(examined)
    out = capsys.readouterr().out
    task, robustness = examined.task, examined.robustness
    tables = (
        replay_table(examined, examined.arcs()),
        score_table(task, robustness.game),
        margin_table(task, robustness.game),
        episode_table(task, robustness.episodes),
    )
    for table in tables:
        assert table.title in out
        assert all(str(row[0]) in out for row in table.rows)
    assert examined.critical_set.sentence(task) in out
    assert replay_sentence(examined, examined.arcs()) in out
    for q in (0, 1):
        assert f"mode {task.scene.mode_name(q)}: extended set " in out
    assert f"run directory {examined.path}" in out
    assert str(examined.verdict) in out.splitlines()[0]
    assert all(f"- {reason}" in out for reason in examined.verdict.reasons)
    assert "no video" in out
    assert "no report" in out, "it is older than the examination"


def test_without_episodes_there_is_no_table_of_them(run, capsys):
    print_robustness(run)
    out = capsys.readouterr().out
    assert "worst case over all noise" in out
    assert "noisy episodes" not in out


def test_cells_are_never_cut_off(examined, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "40")
    print_summary(examined)
    out = capsys.readouterr().out
    assert "…" not in out
    assert max(map(len, out.splitlines())) > 80
