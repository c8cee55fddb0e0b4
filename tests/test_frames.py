"""Where an environment's robot is in the world, and which of its joints turn without end."""

import gymnasium as gym
import mujoco
import numpy as np
import pytest

import hyrl_mj

pytestmark = pytest.mark.usefixtures("few_trials")
WALL = '<geom type="box" size="{size}" pos="{pos}" euler="0 0 {turn}"/>'
ROBOT = (
    '<body pos="{place}" euler="0 0 {turn}"><joint name="a" type="slide" axis="{a}" damping="2"/>'
    '<joint name="b" type="slide" axis="{b}" damping="2"/><geom type="sphere" size=".12" mass="1"/></body>'
)
MOTORS = "".join(f'<motor name="f{j}" joint="{j}" gear="4" ctrlrange="-1 1"/>' for j in "ab")


class Room(gym.Env):
    """A puck in a closed room with a rock in its middle; it goes from one side, x = -2, to the other."""

    def __init__(
        self,
        *,
        place="-2 0 .15",
        a="1 0 0",
        b="0 1 0",
        turn=0,
        of_walls=0,
        side=".1 2.2 .3",
        second=1,
    ):
        walls = [(side, f"{x} 0 .3", of_walls) for x in (-3, 3)]
        along = [("3.1 .1 .3", f"0 {y} .3", 0) for y in (-2.1, 2.1)]
        if second == 2:  # seen from the side: a floor and a ceiling
            walls = [(".1 1 2.2", f"{x} 0 0", 0) for x in (-3, 3)]
            along = [("3.1 1 .1", f"0 0 {z}", 0) for z in (-2.1, 2.1)]
        rock = ("0.3 0.5 0.3", "0.3 0 0.3", 0) if second == 1 else ("0.3 1 0.5", "0.3 0 0", 0)
        geoms = "".join(
            WALL.format(size=size, pos=pos, turn=angle)
            for size, pos, angle in [*walls, *along, rock]
        )
        robot = ROBOT.format(place=place, a=a, b=b, turn=turn)
        self.model = mujoco.MjModel.from_xml_string(
            f'<mujoco><option gravity="0 0 0" timestep=".01"/><worldbody>{geoms}{robot}</worldbody>'
            f"<actuator>{MOTORS}</actuator></mujoco>"
        )
        self.data, self.second = mujoco.MjData(self.model), second
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (4,), dtype=np.float64)
        self.action_space = gym.spaces.Box(-1, 1, (2,), dtype=np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        mujoco.mj_forward(self.model, self.data)
        off = np.array([-2.0, 0.0]) - self.data.xpos[1][[0, self.second]]
        axes = self.data.xaxis[:, [0, self.second]]
        self.data.qpos[:] = np.linalg.solve(axes.T, off + self.np_random.uniform(-0.5, 0.5, 2))
        mujoco.mj_forward(self.model, self.data)
        return self._get_obs(), {}

    def _get_obs(self):
        return np.concatenate([self.data.qpos, self.data.qvel])

    def step(self, action):
        self.data.ctrl[:] = action
        mujoco.mj_step(self.model, self.data, 6)
        off = self.data.xpos[1][[0, self.second]] - [2, 0]
        won = bool(np.linalg.norm(off) < 0.3)
        return self._get_obs(), -1.0, won, False, {"is_success": won}


@pytest.mark.slow
@pytest.mark.first(2)
@pytest.mark.parametrize(
    "frame",
    [
        {"place": "-8 1 .15", "of_walls": 90, "side": "2.2 .1 .3"},
        {"a": "0 -1 0", "b": "-1 0 0"},
        {"turn": 90},
        {"second": 2, "b": "0 0 1", "place": "-2 0 0"},
    ],
)
def test_walls_are_where_the_robot_is_in_the_world(frame):
    task = hyrl_mj.from_gymnasium(lambda: Room(**frame), steps=40)
    z = task.starts(100, np.random.default_rng(0))
    places = task.where(task.placed(z).measurement)
    assert (np.abs(places) <= [3, 2.1]).all()
    assert (np.ptp(places, axis=0) > [4.5, 3.2]).all(), "they are all over the room"
    assert list(task.obstacles) == ["island 1"]
    # From the chart point of one place to that of another, past the rock.
    axes = np.column_stack([np.gradient(places[:, i]) for i in (0, 1)])
    matrix, *_ = np.linalg.lstsq(np.gradient(z, axis=0), axes, rcond=None)
    shift = places[0] - z[0] @ matrix
    for side, mode in ((1.0, 0), (-1.0, 1)):
        way = np.column_stack([np.linspace(-1.5, 2, 40), np.full(40, side)])
        path = np.linalg.solve(matrix.T, (way - shift).T).T[:, None]
        assert task.direction(path) == [mode]


@pytest.mark.slow
def test_a_robot_whose_frame_is_oblique_has_no_walls():
    with pytest.raises(hyrl_mj.BadInput, match="nothing is decided"):
        hyrl_mj.from_gymnasium(lambda: Room(turn=30), steps=40)


class Knob(gym.Env):
    """It is done where it was turned by one and a half turns, either way."""

    XML = (
        '<mujoco><option timestep=".01"/>'
        '<worldbody><body><joint name="turn" type="hinge" axis="0 0 1" damping=".5"/><geom '
        'type="box" size=".3 .05 .05" mass=".5"/></body></worldbody><actuator><motor name="t" joint="turn" '
        'gear="2" ctrlrange="-1 1"/></actuator></mujoco>'
    )

    def __init__(self, seen=lambda angle: angle, won=lambda angle: abs(angle) > 3 * np.pi):
        self.model = mujoco.MjModel.from_xml_string(self.XML)
        self.data, self.seen, self.won = mujoco.MjData(self.model), seen, won
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (3,), dtype=np.float64)
        self.action_space = gym.spaces.Box(-1, 1, (1,), dtype=np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[0] = self.np_random.uniform(-1, 1)
        mujoco.mj_forward(self.model, self.data)
        return self._get_obs(), {}

    def _get_obs(self):
        return np.append(np.resize(self.seen(self.data.qpos[0]), 2), self.data.qvel)

    def step(self, action):
        self.data.ctrl[:] = action
        mujoco.mj_step(self.model, self.data, 6)
        won = bool(self.won(self.data.qpos[0]))
        return self._get_obs(), -1.0, won, False, {"is_success": won}


def both(angle):
    return np.cos(angle), np.sin(angle)


@pytest.mark.slow
@pytest.mark.first(1)
@pytest.mark.parametrize(
    ("seen", "won", "periodic"),
    [
        (both, lambda angle: np.cos(angle) < -0.9, True),
        (lambda angle: angle, lambda angle: np.cos(angle) < -0.9, False),
        (both, lambda angle: abs(angle) > 3 * np.pi, False),
    ],
)
def test_a_hinge_is_periodic_where_a_turn_changes_nothing(seen, won, periodic):
    task = hyrl_mj.from_gymnasium(lambda: Knob(seen, won), steps=60)
    assert task.chart.periodic == (periodic,)
    assert "turns one way or the other" in task.found["ways"]
