"""Rehearsal: starts anywhere on the chart, more of them where the latest policy lost or decided."""

from dataclasses import replace

import numpy as np
import pytest
from planted import ChartPolicy, spare
from planted_field import Field

import hyrl_mj
from hyrl_mj.learning.presets import preset
from hyrl_mj.learning.rehearsal import Rehearsal, running_points
from hyrl_mj.learning.training import TaskGround, build, train

POST = {"": (2, 0, 0.5)}


@pytest.fixture
def field():
    return Field(POST)


def rehearsal_of(task, share):
    """The rehearsal of a training of which this share of the episodes starts anywhere."""
    training = preset(hyrl_mj.get_task("gaps"), "smoke").stage1
    return Rehearsal(task, replace(training, rehearse=share))


def straight(task):
    """Straight ahead: into the post from |y| < 0.5 and x < 2."""
    return ChartPolicy(task, lambda z: np.tile([1.0, 0.0], (len(z), 1)))


def over_the_top(task):
    """Always past the left of the post, from wherever a run starts."""

    def inputs(z):
        clear = (z[:, 1] > 0.6) | (z[:, 0] > 2.6)
        return np.stack([clear, ~clear], axis=1).astype(float)

    return ChartPolicy(task, inputs)


def among_starts(task, z):
    return task.may_start(z)


def in_front(z):
    """Where straight ahead is lost, and another way is open."""
    return (np.abs(z[:, 1]) < 0.5) & (z[:, 0] < 1.2)


def test_a_share_of_the_episodes_starts_anywhere_outside_obstacles(field):
    rng = np.random.default_rng(0)
    z = rehearsal_of(field, 0.4).starts(20_000, rng)
    elsewhere = z[~among_starts(field, z)]
    box = field.chart.sides.prod()
    inside = np.prod(np.subtract(field.start_high, field.start_low)) / (box - np.pi * 0.25)
    assert len(elsewhere) / len(z) == pytest.approx(0.4 * (1 - inside), abs=0.02)
    assert (np.hypot(z[:, 0] - 2, z[:, 1]) > 0.5).all()
    assert elsewhere[:, 0].max() > 3.8, "the whole chart"


@pytest.mark.slow
def test_many_of_these_start_where_the_latest_policy_lost(field):
    drawn = rehearsal_of(field, 1.0)
    rng = np.random.default_rng(0)
    usual = in_front(drawn.starts(20_000, rng)).mean()
    drawn.update(straight(field))
    late = in_front(drawn.starts(20_000, rng)).mean()
    assert late > usual + 0.25
    field.max_steps = 200
    drawn.update(over_the_top(field))
    assert in_front(drawn.starts(20_000, rng)).mean() < usual, "only the last policy counts"


@pytest.mark.slow
def test_many_of_these_start_where_the_latest_policy_goes_two_ways(field):
    drawn = rehearsal_of(field, 1.0)
    rng = np.random.default_rng(0)
    at = 0.7

    def decides_there(z):
        return (np.abs(z[:, 1] - at) < 0.1) & (z[:, 0] < 1.8)

    usual = decides_there(drawn.starts(20_000, rng)).mean()
    away = ChartPolicy(field, lambda z: np.stack([np.ones(len(z)), np.sign(z[:, 1] - at)], axis=1))
    drawn.update(away)
    assert decides_there(drawn.starts(20_000, rng)).mean() > usual + 0.25
    field.max_steps = 200
    drawn.update(over_the_top(field))
    assert decides_there(drawn.starts(20_000, rng)).mean() < usual + 0.02, "only the last policy"


@pytest.mark.slow
def test_what_is_lost_late_is_rehearsed_more_often(field):
    drawn = rehearsal_of(field, 1.0)
    drawn.update(straight(field))
    rng = np.random.default_rng(0)
    x = (z := drawn.starts(40_000, rng))[in_front(z), 0]
    far, close = ((x > a) & (x < a + 0.4) for a in (0.1, 1.0))
    assert far.sum() > 1.5 * close.sum()


@pytest.mark.slow
def test_a_policy_that_wins_everything_leaves_nothing_to_rehearse(field):
    field = Field({"": (9, 9, 0.1)})
    drawn = rehearsal_of(field, 0.5)
    drawn.update(straight(field))
    assert drawn.starts(100, np.random.default_rng(0)).shape == (100, 2)


def test_where_every_episode_ends_at_once_all_points_count(field, monkeypatch):
    monkeypatch.setattr(type(field), "ending", lambda self, m: np.full(len(m), 2))
    assert len(running_points(field, 50, np.random.default_rng(0))) == 50


@pytest.mark.long
@pytest.mark.slow
def test_a_training_rehearses_what_its_checkpoints_lose(monkeypatch):
    spare(monkeypatch, checkpoints=4)
    task = hyrl_mj.get_task("gaps")
    tried = []
    update = Rehearsal.update
    monkeypatch.setattr(Rehearsal, "update", lambda self, p: (tried.append(p), update(self, p)))
    settings = preset(task, "smoke").stage1
    assert settings.rehearse == 0.4
    settings = replace(settings, samples=8_192, envs=64)
    train(task, settings, 0)
    assert len(tried) > 1
    domain = TaskGround(task, replace(settings, rehearse=1.0)).domain(0.9)
    env = build(task, settings, 0, domain=domain).env.core
    env.reset()
    assert not task.may_start(env.z).all()


@pytest.mark.parametrize("name", ["unit_circle", "vehicle"])
def test_tuned_robots_start_where_their_task_starts(name):
    task = hyrl_mj.get_task(name)
    stage1 = preset(task).stage1
    assert stage1.rehearse == 0
    assert TaskGround(task, stage1).domain(0.9) is None
