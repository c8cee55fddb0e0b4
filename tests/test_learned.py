"""Tests of what a run tells before it rests on a policy, or on a task, that does not do what it should."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import hyrl_mj
from hyrl_mj.errors import HyrlError
from hyrl_mj.gym_export import BatchedEnv, Domain
from hyrl_mj.judging import Arrivals, Failures
from hyrl_mj.learning import preset, training
from hyrl_mj.learning.to_go import NoWay, WayToGo
from hyrl_mj.pipeline import RunOptions, runs
from hyrl_mj.pipeline.runs import settings_of
from hyrl_mj.pipeline.steps import run_stage
from hyrl_mj.policies import MlpPolicy
from hyrl_mj.runs.directory import opened
from hyrl_mj.tasks import Outcome, hidden_goal, jumped_over, overlooked, torn
from hyrl_mj.tasks.scaffold import write_task
from hyrl_mj.viz import figures


@pytest.mark.slow
def test_a_run_stops_where_stage_1_has_not_learned_unless_told_to_go_on(
    quickly_judged, tmp_path, monkeypatch
):
    short = {"stage1.samples": 4_096, "stage1.attempts": 2}
    options = {"set": short, "out": tmp_path / "run", "say": lambda text: None}
    shown = tmp_path / "run" / "figures" / "arrivals.png"
    for _ in range(2):  # it is not trained twice
        with pytest.raises(
            HyrlError, match=r"has not learned vehicle in 2 trainings: its policy arrives from \d+ "
        ):
            hyrl_mj.run("vehicle", **options)
        assert shown.exists()
    monkeypatch.setattr(runs, "_check_learned", None)  # which is not asked
    after = []

    def stage(run, name, say):
        after.append(name)
        return run

    monkeypatch.setattr(runs, "run_stage", stage)
    hyrl_mj.run("vehicle", go_on=True, **options)
    assert after[0] == "critical-set"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("minutes", "before", "trainings"), [(60, 0, 2), (60, 800, 2), (60, 990, 1), (1e-9, 0, 1)]
)
def test_another_attempt_is_paid_for_the_way_to_the_goal_if_there_is_time(
    minutes, before, trainings, quickly_judged, tmp_path, monkeypatch
):
    """The first training gives a policy that is known, the second is what it is without training."""
    train, given = training.train, []

    def planted(task, settings, seed, **more):
        given.append((settings.shaped, settings.samples, settings.rehearse, seed))
        policy = train(task, replace(settings, samples=32), seed, **more)
        weights = {name: 0 * w for name, w in policy.weights.items()}
        return policy if len(given) > 1 else MlpPolicy(task, "ppo", policy.activation, weights)

    def measured(task, policy):
        return Arrivals(900 if any(w.any() for w in policy.weights.values()) else before, 0, 1_000)

    monkeypatch.setattr(training, "train", planted)
    monkeypatch.setattr(Arrivals, "measure", measured)
    said = []
    options = RunOptions(
        stage1_minutes=minutes, set={"stage1.envs": 8, "stage1.options.n_steps": 4}
    )
    settings = settings_of(hyrl_mj.get_task("gaps"), options)
    with opened(tmp_path / "run", settings) as run:
        found = run_stage(run, "train", said.append).arrivals
    again = trainings == 2
    assert (found.trainings, found.arrived) == (trainings, 900 if again else before)
    assert found.shaped == again, "which the trainings of the modes follow"
    first, *later = given
    assert first == (False, settings.stage1.samples, 0.4, 0)
    assert [attempt[:3] for attempt in later] == [(True, *first[1:3])] * (trainings - 1)
    told = f"arrives from {before} of 1,000 .* another training"
    if not again:
        told = "arrives from 990 of 1,000 " if before else "which may take 1e-09: more"
    assert any(re.search(told, line) for line in said)


def test_who_is_paid_for_the_way_to_the_goal_gets_more_beside_a_post_than_before_it():
    gaps = hyrl_mj.get_task("gaps")
    pay = WayToGo(gaps, gamma=0.9).pay
    before, beside, beyond = np.array([[1.3, 0.0], [1.3, 0.5], [2.1, 0.0]])  # a post, and a gap
    still = np.zeros((3, 1))
    far, near, nearer = pay.reward(gaps.at(np.array([before, beside, beyond])), still)
    assert 0 < far < near - 0.02 < nearer - 0.2
    arrived = pay.reward(gaps.at(np.array([gaps.set_point])), still[:1])
    assert arrived == pytest.approx(1 / (1 - 0.9)), "as much as to stay there for ever"
    env = BatchedEnv(gaps, 3, domain=Domain(gaps.starts, pay=pay))
    env.reset(z=np.array([before, beside, beyond]))
    paid = env.step(still)
    assert paid.reward == pytest.approx(pay.reward(gaps.at(env.z), still))
    while not paid.terminated[0]:
        paid = env.step(still)
    assert paid.outcome[0] == Outcome.CRASHED
    assert paid.reward[0] == pay.worst == 0 < paid.reward[1]


def test_who_is_paid_in_a_set_gets_nothing_for_ways_that_leave_it():
    gaps = hyrl_mj.get_task("gaps")
    left = WayToGo(gaps, 0.9, inside=lambda z: z[:, 1] > 0).pay
    above, below = (gaps.at(np.array([[0.5, y]])) for y in (0.3, -0.3))
    assert left.reward(above, np.zeros((1, 1))) > 0.1 > left.reward(below, np.zeros((1, 1))) == 0


def test_a_goal_that_no_way_leads_to_is_told():
    class Walled(type(hyrl_mj.get_task("gaps"))):
        def ending(self, measured):
            ends = super().ending(measured)
            ends[np.abs(measured[:, 0] - 2.2) < 0.1] = Outcome.CRASHED
            return ends

    with pytest.raises(
        NoWay, match=r"no way leads from its starts to its goal on .* nodes of the chart"
    ):
        WayToGo(Walled(), 0.9)


def test_how_episodes_fail_is_counted(vehicle):
    class Still:
        task = vehicle

        def act(self, measured):
            return measured[:, :1] * 0

    found = Failures.of(vehicle, Still())
    starts, ends = found.starts, found.ends
    crashed = ends == Outcome.CRASHED
    assert crashed.sum() == 1_000 - Arrivals.measure(vehicle, Still()).arrived > 500
    away = np.abs(starts[:, 1])
    assert away[crashed].max() < away[~crashed].min() + 0.01
    assert away[~crashed].min() == pytest.approx(0.75, abs=0.01)
    legend = figures.draw_arrivals(vehicle, starts, ends).axes[0].get_legend_handles_labels()[1]
    assert legend[-2:] == ["reached (248)", "crashed (752)"]
    assert found.nearest > vehicle.close
    assert found.earned is None


def test_what_stalls_and_earns_is_told_that_arriving_has_to_pay(circle, vehicle, monkeypatch):
    class Still:
        task = circle

        def act(self, measured):
            return measured[:, :1] * 0

    found = Failures.of(circle, Still())
    stalled = found.starts[found.ends == Outcome.STALLED]
    at, still = circle.placed(stalled).measurement, np.zeros((len(stalled), 1))
    assert found.earned == pytest.approx(circle.reward(at, still).mean())
    assert vehicle.ends_well
    settings = SimpleNamespace(stage1=preset(vehicle, "smoke").stage1)
    run = SimpleNamespace(task=vehicle, settings=settings, arrivals=Arrivals(0, 0, 2), policy=None)
    ends = np.full(2, Outcome.STALLED)
    for earned, told in ((0.9, True), (-0.9, False)):
        failures = Failures(np.zeros((2, 2)), ends, 0.1, earned)
        monkeypatch.setattr(Failures, "of", lambda *_, failures=failures: failures)
        with pytest.raises(
            HyrlError, match=r"2 stalled; the nearest comes within 0\.1 of"
        ) as error:
            runs._check_learned(run)
        assert ("earn 0.9 a sample where they are, and nothing once" in f"{error.value}") == told


SECOND = '<geom name="obstacle_2" type="cylinder" pos="0.6 0.9 0.1" size="0.2 0.1"/>'


@pytest.mark.parametrize("forgotten", [False, True])
def test_a_second_obstacle_of_the_template_is_a_crash_and_a_forgotten_one_is_told(
    forgotten, tmp_path
):
    name = "a_forgotten_post" if forgotten else "two_posts"
    write_task(name, tmp_path)
    model, path = tmp_path / f"{name}.xml", tmp_path / f"{name}.py"
    model.write_text(model.read_text().replace("<worldbody>", f"<worldbody>{SECOND}", 1))
    if forgotten:
        text = path.read_text().replace("in mjcf.obstacles(self.model)", 'in ["obstacle"]')
        path.write_text(text.replace("(measured[:, 3] > 0) | ", ""))
    task = hyrl_mj.get_task(path)
    ends = task.ending(task.placed(np.array([[0.6, 0.9]])).measurement)
    assert (ends == Outcome.RUNNING) == forgotten
    said = overlooked(task)
    assert ("whose puck is " in said and " inside of obstacle_2, as at x " in said) == forgotten
    assert bool(said) == forgotten


@pytest.mark.slow
def test_no_task_of_the_package_overlooks_an_obstacle_or_jumps_over_it():
    tasks = [hyrl_mj.get_task(name) for name in hyrl_mj.task_names()]
    own = [task for task in tasks if task.source is None]
    assert not [t for t in own if overlooked(t) or jumped_over(t) or torn(t)]


TRAILER = '<body><joint name="trailer" type="slide" axis="0 1 0"/><geom size="0.05"/></body>'
DRAWN = '<equality><joint name="bar" joint1="trailer" joint2="y"/></equality>'


@pytest.mark.parametrize("forgotten", [False, True])
def test_a_state_that_an_equality_constraint_pulls_together_is_told(forgotten, tmp_path):
    name = "a_forgotten_trailer" if forgotten else "a_trailer"
    write_task(name, tmp_path)
    model, path = tmp_path / f"{name}.xml", tmp_path / f"{name}.py"
    text = model.read_text().replace("<worldbody>", f"<worldbody>{TRAILER}", 1)
    text = text.replace("<actuator>", f"{DRAWN}<actuator>").replace('qpos="0 0"', 'qpos="0 0 0"')
    model.write_text(text)
    first = "0 * z[:, 1:]" if forgotten else "z[:, 1:]"
    code = path.read_text().replace("return z, np", f"return np.hstack([{first}, z]), np")
    path.write_text(code.replace("([np.ones", "([drift, np.ones"))
    said = torn(hyrl_mj.get_task(path))
    assert ("puts the robot where bar is off by 1." in said) == forgotten == bool(said)


@pytest.mark.parametrize(
    ("end", "jumps"),
    [
        ("np.abs(x - 2.2) < 0.004", True),
        ("np.hypot(x - 2.2, y - 1.0) < 0.01", True),
        ("np.hypot(x - 2.2, y - 1.0) < 0.1", False),
        ("(np.abs(x - 2.2) < 0.1) & (y > 1.0)", False),
    ],
)
def test_what_is_thinner_than_a_sample_leads_is_told(vehicle, monkeypatch, end, jumps):
    ends = type(vehicle).ending

    def ending(self, measured):
        x, y = measured.T  # noqa: RUF059 - the end looks at them
        return np.where(eval(end), Outcome.CRASHED, ends(self, measured))

    monkeypatch.setattr(type(vehicle), "ending", ending)
    assert bool(re.search(r"jumps over .* from x = 2\.1", jumped_over(vehicle))) == jumps


@pytest.mark.slow
def test_a_set_point_that_noise_hides_is_told_with_what_would_do(circle):
    """It moves by 0.05 rad in a sample: beside the set-point it may be by 0.1 rad of noise and that."""

    class Strict(type(circle)):
        close = 0.12

    class Looking(Strict):  # where its goal is tells its miss alone
        set_point = None
        miss = staticmethod(circle.miss)

    for strict in (Strict(), Looking()):
        said = hidden_goal(strict, 0.1)
        assert re.search(r"hides up to 0\.1\d* of that, and 0\.15\d* with", said), said
        told = re.search(r"a close of at least (0\.1[56]), or noise of at most (0\.0\d+)$", said)
        assert told, said
        assert not hidden_goal(strict, float(told[2]))
        strict.close = float(told[1])
        assert not hidden_goal(strict, 0.1), "what is told would do"
        strict.close = 0.12
        assert not hidden_goal(strict, 0.05)
    assert not hidden_goal(circle, 0.1)


@pytest.mark.slow
def test_a_robot_with_inertia_moves_from_rest_at_its_set_point(puck):
    """Elsewhere it moves by up to 0.05 m in a sample."""
    slow = type("Slow", (type(puck),), {"close": 0.13, "ending": at_no_end})
    assert puck.moves[1] > 0.045
    assert not hidden_goal(slow(), 0.1)


def at_no_end(self, measured):
    return np.full(len(measured), Outcome.RUNNING)
