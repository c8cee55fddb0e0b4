"""The gate's pillar swings as its phase says, and an expert's M* is the analytic surface."""

import mujoco
import numpy as np
import pytest
from experts import Constant, moved
from planted import ChartPolicy

import hyrl_mj
from hyrl_mj import Outcome
from hyrl_mj.physics import mjcf
from hyrl_mj.stages import find_critical_set

ROOM = 0.6  # between the expert's way and where the pillar will be [m]


@pytest.fixture(scope="module")
def gate():
    return hyrl_mj.get_task("gate")


def met(task, z):
    """Where the pillar will be when the vehicle is beside it: y (n,) [m], from chart points (n, 3)."""
    speed, _, rate = task.speeds
    x, _, phase = z.T
    return task.pillar(phase + rate * (task.obstacle[0] - x) / speed)


def expert(task, side=None):
    """Goes to the side with the shorter way past where the pillar will be, then for the goal."""

    def rule(z):
        x, y, _ = z.T
        where = met(task, z)
        chosen = np.where(y >= where, 1.0, -1.0) if side is None else side
        # Behind the pillar, the same number would be where it has been.
        wanted = np.where(x < task.obstacle[0] + 0.4, where + chosen * ROOM, 0.0)
        return np.clip((wanted - y) / task.dt, -1, 1)[:, None]

    return ChartPolicy(task, rule)


def test_one_sample_is_its_equation(gate):
    z = np.random.default_rng(0).uniform(gate.chart.low, gate.chart.high, (500, 3))
    u = np.random.default_rng(1).uniform(-1, 1, (500, 1))
    plant = gate.plant(500)
    plant.set_state(*gate.state(z))
    plant.step(u)
    speed, _, rate = gate.speeds
    after = z + gate.dt * np.column_stack([np.full(500, speed), u, np.full(500, rate)])
    np.testing.assert_allclose(gate.z(plant.measurement), after, rtol=0, atol=1e-6)
    plant.step_backward(u)
    np.testing.assert_allclose(gate.z(plant.measurement), z, rtol=0, atol=1e-6)


def test_the_pillar_in_the_picture_is_where_its_phase_says(gate):
    data = mujoco.MjData(gate.model)
    runs = moved(gate, Constant(1.0), [[0.0, -0.8, 2.0], [0.2, 0.0, -1.0]], record=True)
    geom = mjcf.object_id(gate.model, mujoco.mjtObj.mjOBJ_GEOM, "obstacle")
    low, high = np.inf, -np.inf
    for state, z in zip(runs.state[:, 0], runs.path[:, 0], strict=True):
        mujoco.mj_setState(gate.model, data, state, mujoco.mjtState.mjSTATE_INTEGRATION)
        mujoco.mj_kinematics(gate.model, data)
        x, y, _ = data.geom_xpos[geom]
        assert (x, y) == pytest.approx((gate.obstacle[0], float(gate.pillar(z[2]))), abs=1e-4)
        low, high = min(low, y), max(high, y)
    assert high - low > 0.5


@pytest.mark.parametrize("phase", [-2.0, 0.3, 1.5])
def test_what_touches_the_pillar_has_crashed(gate, phase):
    radius = mjcf.geom_size(gate.model, "obstacle")[0]
    angle = np.linspace(0, 2 * np.pi, 30)
    for off, outcome in ((-1e-3, Outcome.CRASHED), (1e-3, Outcome.RUNNING)):
        x = gate.obstacle[0] + (radius + off) * np.cos(angle)
        y = gate.pillar(phase) + (radius + off) * np.sin(angle)
        measured = np.column_stack([x, y, np.full(30, phase)])
        assert (gate.ending(measured) == outcome).all()


def test_who_waits_for_the_pillar_is_hit_and_who_knows_its_phase_is_not(gate):
    z = gate.starts(500, np.random.default_rng(0))
    knows = moved(gate, expert(gate), z)
    assert (knows.outcome == Outcome.REACHED).all()
    assert gate.miss(knows.path[-1]).max() < gate.close
    blind = moved(gate, Constant(0.0), z)
    assert 0.3 < (blind.outcome == Outcome.CRASHED).mean() < 0.9


def test_the_way_is_the_side_of_the_pillar_where_it_then_is(gate):
    z = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, np.pi]])  # it will be on the left, and on the right
    for y, ways in ((0.0, [1, 0]), (0.45, [0, 0]), (-0.45, [1, 1])):
        starts = z + np.array([0.0, y, 0.0])
        assert gate.direction(moved(gate, expert(gate), starts).path).tolist() == ways
    for side, way in ((1, 0), (-1, 1)):
        path = moved(gate, expert(gate, side), z).path
        assert gate.direction(path).tolist() == [way, way]
        # Beyond a period it is the same, and behind the pillar nothing is left to decide.
        assert gate.direction(path + np.array([0, 0, 4 * np.pi])).tolist() == [way, way]
        assert gate.direction(path[40:]).tolist() == [-1, -1]


def test_half_a_period_later_it_is_its_mirror_image(gate):
    z = gate.starts(50, np.random.default_rng(0))
    image = z * [1, -1, 1] + [0, 0, np.pi]
    path, mirrored = (moved(gate, expert(gate), starts).path for starts in (z, image))
    np.testing.assert_allclose(mirrored[..., 1], -path[..., 1], atol=1e-5)
    seen = [gate.observation(points) for points in (z, image)]
    np.testing.assert_allclose(seen[1], seen[0] * gate.mirror.observation, atol=1e-12)


@pytest.mark.slow
def test_the_critical_set_of_the_expert_is_the_analytic_surface(gate):
    found = find_critical_set(gate, expert(gate), 24, 1 / 32, "outcome")
    off = np.abs(found.points[:, 1] - met(gate, found.points))
    assert np.median(off) < 0.02
    assert off.max() < 0.02
    assert found.pieces == 1
    # A surface: all phases, and all places from which there is time to decide.
    phases, _ = np.histogram(found.points[:, 2], 12, (-np.pi, np.pi))
    assert (phases > 3).all()
    assert found.points[:, 0].min() < 0.1
    assert found.points[:, 0].max() > 0.6
