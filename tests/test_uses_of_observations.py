"""What steps, resets and wrappers do with observations and places that noise or a start does not reach."""

from dataclasses import dataclass
from types import SimpleNamespace

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from environments import GOAL, XML
from test_truer_environments import outcomes
from test_wrapped_environments import Flat, Home

from hyrl_mj import BadInput, from_gymnasium

# A second for each environment.
pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("few_trials")]


class Noting(Home):
    """Keeps its place in an object, and in one of a list in its info."""

    def begin(self):
        self.robot = SimpleNamespace(place=self.data.qpos.copy())

    def after(self):
        self.robot.place = self.data.qpos.copy()

    def step(self, action):
        observation, *rest, info = super().step(action)
        return observation, *rest, info | {"bodies": [{"name": "puck", "at": observation[:2]}]}


@dataclass(slots=True)
class Pose:
    """Has slots in place of a dictionary."""

    place: np.ndarray


class Slotted(Noting):
    """Keeps its place in such an object."""

    def begin(self):
        self.robot = Pose(self.data.qpos.copy())


class ByObject(gym.ObservationWrapper):
    def observation(self, observation):
        return np.append(self.unwrapped.robot.place, observation[2:])


class ByList(gym.Wrapper):
    def step(self, action):
        observation, *rest, info = self.env.step(action)
        return np.append(info["bodies"][0]["at"], observation[2:]), *rest, info


@pytest.mark.first(1)
@pytest.mark.parametrize(
    ("wrapper", "env", "way"),
    [
        (ByObject, Noting, r"attribute robot\.place"),
        (ByObject, Slotted, r"attribute robot\.place"),
        (ByList, Noting, r"info bodies\.0\.at"),
    ],
)
def test_wrappers_that_observe_what_objects_hold_are_refused(wrapper, env, way):
    with pytest.raises(
        BadInput, match=rf"a wrapper of .* observes .*{way}.*, which follows the place"
    ):
        from_gymnasium(lambda: wrapper(env()))


class Servo(Flat):
    """Brakes beside the right wall, by the observation of the step before."""

    def reset(self, **options):
        self.last, info = super().reset(**options)
        return self.last, info

    def step(self, action):
        beyond = max(self.last[0] - 1.2, 0.0)
        self.last, *rest = super().step(np.asarray(action) - [2.0 * beyond, 0.0])
        return self.last, *rest


def test_a_controller_within_an_environment_that_noise_does_not_reach_is_refused():
    with pytest.raises(BadInput, match=r"step\(\) of Servo moves the robot by what _get_obs"):
        from_gymnasium(Servo)


class Clipped(Flat):
    """Clips what it observes to the room, which only noise leaves."""

    def step(self, action):
        observation, *rest = super().step(action)
        observation[0] = np.clip(observation[0], -2.05, 2.05)
        return observation, *rest


def test_what_a_step_does_where_only_noise_shows_the_robot_is_refused():
    with pytest.raises(BadInput, match=r"step\(\) of Clipped changes what _get_obs\(\) gives"):
        from_gymnasium(Clipped)


class Judging(Flat):
    """Judges by its own observation, which it is given without noise."""

    def step(self, action):
        observation, _, terminated, truncated, info = super().step(action)
        off = float(np.linalg.norm(observation[2:4]))
        return observation, -off, terminated, truncated, info | {"success": off < 0.25}


@pytest.mark.long
def test_an_environment_may_judge_by_its_own_observation():
    assert outcomes(Judging, 0.1) == outcomes(Flat, 0.1)


class Speeding(Home):
    """Ends where it has moved by more than it could in a sample, from where the reset led to."""

    limit = 0.5

    def begin(self):
        mujoco.mj_forward(self.model, self.data)
        self.before = self.data.qpos.copy()

    def step(self, action):
        observation, reward, _, truncated, info = super().step(action)
        moved, self.before = np.linalg.norm(self.data.qpos - self.before), self.data.qpos.copy()
        return observation, reward, bool(moved > self.limit), truncated, info


class Leashed(Home):
    """Ends far from where the reset led to, where a run comes late or never."""

    def begin(self):
        mujoco.mj_forward(self.model, self.data)
        self.home = self.data.qpos.copy()

    def step(self, action):
        observation, reward, _, truncated, info = super().step(action)
        away = np.linalg.norm(self.data.qpos - self.home)
        return observation, reward, bool(away > 2.9), truncated, info


def test_a_place_that_matters_late_is_found():
    with pytest.raises(BadInput, match=r"reset\(\) of Leashed notes where it leads to \(home\)"):
        from_gymnasium(Leashed)


@pytest.mark.long
def test_a_place_that_a_reset_notes_and_a_step_goes_by_is_refused_on_the_chart():
    with pytest.raises(BadInput, match=r"reset\(\) of Speeding notes where it leads to \(before\)"):
        from_gymnasium(Speeding)
    assert from_gymnasium(Speeding, starts="reset", steps=5).max_steps == 5


RIG = '<body name="rig" {}pos="0 0 2">{}<geom size="0.1" mass="1" contype="0" conaffinity="0"/></body>'
SLIDES = "".join(f'<joint type="slide" axis="{axis}"/>' for axis in ("1 0 0", "0 1 0"))


class Rigged(Home):
    """A camera above the robot is put there by code, and where it is is observed."""

    beside, part, at = RIG.format('mocap="true" ', ""), "mocap_pos", slice(2)

    def __init__(self):
        super().__init__()
        xml = XML.replace("</worldbody>", f"{self.beside}</worldbody>")
        self.model = mujoco.MjModel.from_xml_string(xml)
        self.data = mujoco.MjData(self.model)

    def reset(self, *, seed=None, options=None):
        gym.Env.reset(self, seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:2] = -1.4, 0.1
        mujoco.mj_forward(self.model, self.data)
        return self._get_obs(), {}

    def step(self, action):
        self.data.ctrl[:] = action
        mujoco.mj_step(self.model, self.data, nstep=5)
        self.after()
        mujoco.mj_forward(self.model, self.data)
        off = float(np.linalg.norm(self.data.qpos[:2] - GOAL))
        return self._get_obs(), -off, False, False, {"success": off < 0.25}

    def after(self):
        getattr(self.data, self.part).flat[self.at] = self.data.qpos[:2] + 0.1

    def _get_obs(self):
        place, rig = self.data.qpos[:2], getattr(self.data, self.part).flat[self.at]
        return np.concatenate([place, self.data.qvel[:2], rig])


class OnJoints(Rigged):
    beside, part, at = RIG.format("", SLIDES), "qpos", slice(2, 4)


class InUserdata(Rigged):
    """What it has noted in MuJoCo's data, a wrapper observes."""

    beside, part = '</worldbody><size nuserdata="2"/><worldbody>', "userdata"

    def _get_obs(self):
        return np.concatenate([self.data.qpos, self.data.qvel, GOAL])


class Noted(gym.ObservationWrapper):
    def observation(self, observation):
        return np.append(self.unwrapped.data.userdata, observation[2:])


class Chasing(Rigged):
    """Something chases it, and is observed: that is no copy."""

    def after(self):
        rig = self.data.mocap_pos[0]
        rig[:2] += 0.1 * (self.data.qpos[:2] - rig[:2])


@pytest.mark.parametrize(
    ("make", "part"),
    [
        (Rigged, r"mocap_pos\[0\]"),
        (OnJoints, r"qpos\[2\]"),
        (lambda: Noted(InUserdata()), r"userdata\[0\]"),
    ],
)
def test_copies_of_the_place_in_the_state_may_not_be_observed(make, part):
    with pytest.raises(BadInput, match=rf"observes shows {part}.*, to which code copies the place"):
        from_gymnasium(make)


@pytest.mark.parametrize("make", [Chasing, InUserdata])
def test_what_chases_the_robot_or_is_not_observed_is_no_copy(make):
    assert from_gymnasium(make, steps=20).max_steps == 20
