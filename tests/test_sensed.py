"""What is proved under a sensor that remembers: no such sensor beats it."""

from functools import cache

import numpy as np
import pytest
from planted import halves
from test_certificate import hybrid, linear, played

import hyrl_mj
from hyrl_mj import MlpPolicy, Sensor
from hyrl_mj.judging.game import NEVER, Game
from hyrl_mj.judging.proof import Certificate
from hyrl_mj.judging.proof.sensed import Memory, proved_cells
from hyrl_mj.policies import PolicyController
from hyrl_mj.sets import Grid


def certified(task, text, controllers, cells):
    """A certificate of controllers under noise that covers a sensor; controllers are made by functions."""
    sensor = Sensor.parse(text)
    bound, shares = sensor.on(hyrl_mj.get_task(task))
    task = hyrl_mj.get_task(task).with_sensor(text, shares)
    loops = {name: make(task) for name, make in controllers.items()}
    game = Game(task, halves(task), loops, bound, grid=Grid.with_cells(task.chart, cells))
    return Certificate.certify(game, loops), loops, bound


def nearer_side(task):
    """Drives to the side of the vehicle's pillar on which it is, until |y| is 1.1 m, then straight on."""
    policy = linear(task, np.zeros((5, 3)), [0.0, -99.0, -1.1, -99.0, 0.0])
    weights = dict(policy.weights)
    by_side = weights[
        "action_net.weight"
    ].copy()  # of y where it is positive, and where it is negative
    by_side[[4, 0, 2], 2], by_side[[4, 0, 2], 5] = (1.0, -1.0, 2.0), (-1.0, 1.0, 2.0)
    return MlpPolicy(task, "ppo", "relu", weights | {"action_net.weight": by_side})


@cache
def vehicle_under(text):
    return certified(
        "vehicle",
        text,
        {"policy": lambda task: PolicyController(nearer_side(task)), "hyrl": hybrid},
        120,
    )


@pytest.mark.parametrize(("delay", "hold"), [(0, 3), (1, 0), (1, 2), (2, 0), (3, 1)])
def test_memories_are_what_a_late_sensor_shows(delay, hold):
    shifts = [(2, -1), (2, 0), (2, 1)]
    memory = Memory.of_sensor(shifts, delay, hold, 10_000)
    rng = np.random.default_rng(0)
    for _ in range(20):
        at, held, places, shown = 0, 0, [np.zeros(2, dtype=int)] * (delay + 1), np.zeros(2)
        for _ in range(12):
            which = rng.integers(len(shifts))
            places = [*places, places[-1] + shifts[which]]
            lost = rng.random() < 0.5 and held < hold
            held = held + 1 if lost else 0
            shown = shown if lost else places[-1 - delay]
            at = memory.after[at, which, int(lost)]
            np.testing.assert_array_equal(memory.shown[at], places[-1] - shown)


def test_too_many_memories_are_not_played():
    assert Memory.of_sensor([(1, 0), (1, 1)], 3, 3, 20) is None


@pytest.mark.first(1)
@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "stronger"),
    [
        ("uniform 0.05 + bias 0.05 + delay 1", "alternating 0.05 + bias 0.05 + delay 1"),
        ("uniform 0.05 + hold 2", "alternating 0.05 + hold 2 rate 0.9"),
        ("uniform 0.08 + delay 0-2", "alternating 0.08 + delay 2"),
    ],
)
def test_no_such_sensor_beats_what_is_proved(text, stronger):
    certificate, loops, bound = vehicle_under(text)
    cells, game = certificate.cells, certificate.game
    starts = cells.all_corners(game.starts)
    lost = {}
    for name, loop in loops.items():
        own, some = proved_cells(certificate, name, Sensor.parse(text))
        covered = certificate.value(name, bound)[-1, : cells.nodes] < NEVER
        assert own[starts].sum() > covered[starts].sum()
        for proved in (own, ~own):
            at = np.flatnonzero(proved & starts)
            rng = np.random.default_rng(0)
            # Those near the axis are the weakest.
            near = at[np.argsort(np.abs(cells.middle(at)[:, 1]))[: len(at) // 3]]
            z = cells.draw(rng.choice(near, 1_500), rng)
            arrives = [played(game, loop, z, Sensor.parse(noise)) for noise in (text, stronger)]
            lost[name, proved is own] = int((~np.array(arrives)).sum())
        z = cells.draw(rng.choice(np.flatnonzero(some & starts), 1_000), rng)
        for q in loop.modes:
            assert played(game, loop, z, Sensor.parse(stronger), np.full(len(z), q)).all()
    assert lost["policy", True] == lost["hyrl", True] == 0
    assert lost["policy", False] > 0
