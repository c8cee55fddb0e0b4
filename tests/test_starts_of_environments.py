"""Starts on the chart: nothing that a reset sets to the place it leads to stays elsewhere without a word."""

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from environments import GOAL, XML, Puck

from hyrl_mj import BadInput, from_gymnasium

# A second for each environment.
pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("few_trials")]
PLACE = np.array([-1.3, 0.5])
MOTORS = XML[XML.index("<actuator>") + 10 : XML.index("</actuator>")]
SERVOS = "".join(
    f'<{{kind}} name="to_{axis}" joint="{axis}" kp="20" {{limit}}="-3 3"/>' for axis in "xy"
)


class At(Puck):
    """Each reset leads to one place, or draws it; what else it sets to it is of the classes below."""

    xml, draws = XML, True

    def __init__(self):
        super().__init__()
        self.model = mujoco.MjModel.from_xml_string(self.xml)
        self.data = mujoco.MjData(self.model)

    def reset(self, *, seed=None, options=None):
        gym.Env.reset(self, seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        place = self.np_random.uniform((-1.8, -1.2), (-1.0, 1.2)) if self.draws else PLACE.copy()
        self.begin(place)
        self.data.qpos[:2] = place
        mujoco.mj_forward(self.model, self.data)
        return self._get_obs(), {}

    def begin(self, place):
        pass

    def _get_obs(self):
        place = self.data.qpos[:2].copy()
        return {"position": place, "velocity": self.data.qvel[:2].copy(), "to_goal": GOAL - place}

    def step(self, action):
        self.control(np.clip(action, -4, 4))
        mujoco.mj_step(self.model, self.data, nstep=5)
        off = float(np.linalg.norm(self.data.qpos[:2] - GOAL))
        return self._get_obs(), -off, self.crashed(), False, {"success": off < 0.25}

    def control(self, action):
        self.data.ctrl[:] = action

    def crashed(self):
        return False


class Setpoint(At):
    """Its actions move the setpoints of servos."""

    xml = XML.replace(MOTORS, SERVOS.format(kind="position", limit="ctrlrange"))

    def begin(self, place):
        self.data.ctrl[:] = place

    def control(self, action):
        self.data.ctrl[:] += 0.02 * action


class Centred(Setpoint):
    """Its only place is zero, where nothing in the numbers tells a setpoint."""

    draws = False

    def begin(self, place):
        place[:] = [0.0, 1.0]
        super().begin(place)


class Integrated(At):
    xml = XML.replace(MOTORS, SERVOS.format(kind="intvelocity", limit='ctrlrange="-1 1" actrange'))
    draws = False

    def begin(self, place):
        self.data.act[:] = place


class Fence(At):
    def begin(self, place):
        self.home = place.copy()

    def crashed(self):
        return bool(np.linalg.norm(self.data.qpos[:2] - self.home) > 3.4)


class FenceAtOnePlace(Fence):
    draws = False


class FenceByDistance(Fence):
    """It notes how far the goal was, and crashes farther away from it."""

    def begin(self, place):
        self.most = float(np.linalg.norm(place - GOAL))

    def crashed(self):
        return bool(np.linalg.norm(self.data.qpos[:2] - GOAL) > self.most + 1.0)


class FenceByRegion(At):
    """It notes in which region of the room it began."""

    def begin(self, place):
        self.region = int(place[1] > 0)

    def control(self, action):
        super().control(action * (1 if self.region else 0.8))


class FenceByMarker(Fence):
    """It notes its place in the model."""

    def begin(self, place):
        self.model.site_pos[0, :2] = place

    def crashed(self):
        return bool(np.linalg.norm(self.data.qpos[:2] - self.model.site_pos[0, :2]) > 3.4)


class Tied(At):
    """A load hangs on it."""

    xml = XML.replace(
        "</worldbody>",
        '<body name="load" pos="0 0 0.1"><freejoint/><geom size="0.05" contype="0" conaffinity="0"/></body>'
        '</worldbody><equality><weld body1="load" body2="puck"/></equality>',
    )
    draws = False

    def begin(self, place):
        self.data.qpos[2:4] = place


class Home(At):
    """Each reset leads to its home, as those of Gymnasium's own environments do."""

    home, draws, key = (0.0, 1.0), False, False

    def __init__(self):
        super().__init__()
        self.init_qpos = np.array(self.home)

    def reset(self, *, seed=None, options=None):
        gym.Env.reset(self, seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        if self.key:
            mujoco.mj_resetDataKeyframe(self.model, self.data, 0)
        else:
            self.data.qpos[:] = self.init_qpos
        self.begin(self.data.qpos[:2].copy())
        mujoco.mj_forward(self.model, self.data)
        return self._get_obs(), {}


class HomeInAClosure(Home):
    """Nothing but a variable of a function holds where it began."""

    def begin(self, place):
        self.away = lambda now: float(np.linalg.norm(now - place))

    def crashed(self):
        return self.away(self.data.qpos[:2]) > 1.0


class HomeOfWholeNumbers(HomeInAClosure):
    """It notes one coordinate, which is 1."""

    def begin(self, place):
        self.line = float(place[1])

    def crashed(self):
        return abs(self.data.qpos[1] - self.line) > 1.0


class HomeOfAKey(HomeOfWholeNumbers):
    xml = XML.replace("</mujoco>", '<keyframe><key qpos="0 1"/></keyframe></mujoco>')
    key = True


class Furthest(At):
    """It notes how near to the goal it has been, first at a place that a variable holds."""

    draws = False

    def begin(self, place):
        self.best = float(np.linalg.norm(place - GOAL))

    def crashed(self):
        off = float(np.linalg.norm(self.data.qpos[:2] - GOAL))
        self.best = min(self.best, off)
        return off > self.best + 0.5


class Written(Furthest):
    """The place stands in the code of its reset."""

    def reset(self, *, seed=None, options=None):
        gym.Env.reset(self, seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = [0.0, 1.0]
        self.begin(self.data.qpos.copy())
        mujoco.mj_forward(self.model, self.data)
        return self._get_obs(), {}


class Walked(Written):
    """It notes where it was before."""

    def begin(self, place):
        self.walked, self.x, self.y = 0.0, 0.0, 1.0

    def crashed(self):
        x, y = self.data.qpos.tolist()
        self.walked += float(np.hypot(x - self.x, y - self.y))
        self.x, self.y = x, y
        return self.walked > 3.0


class Walking(Written):
    """It goes on from a place of its own."""

    crashed = At.crashed

    def begin(self, place):
        self.place = np.array([0.0, 1.0])

    def control(self, action):
        self.place = self.place + 0.02 * action
        self.data.qpos[:] = self.place


class Posture(Home):
    """It stays near a posture, which is where resets lead to, wherever it began."""

    def crashed(self):
        return float(np.linalg.norm(self.data.qpos[:2] - self.init_qpos)) > 3.0


class Ahead(Home):
    """Its goal lies ahead of its home."""

    def begin(self, place):
        self.goal = self.init_qpos[:2] + 1.0

    def crashed(self):
        return float(np.linalg.norm(self.data.qpos[:2] - self.goal)) > 3.0


class Beacon(At):
    """Its goal is a mocap body ahead of where the robot begins; nothing else holds that."""

    draws = False
    xml = XML.replace(
        "<worldbody>",
        '<worldbody><body name="beacon" mocap="true"><site name="end" pos="0 0 1"/></body>',
    )

    def reset(self, **options):
        super().reset(**options)
        self.data.mocap_pos[0, :2] = self.data.qpos + np.array([0.6, 0.1])
        mujoco.mj_forward(self.model, self.data)
        return self._get_obs(), {}

    def crashed(self):
        return float(np.linalg.norm(self.data.qpos - self.data.mocap_pos[0, :2])) > 3.0


class Twin(At):
    """It steps a state of its own, and shows that in `data`."""

    draws = False

    def __init__(self):
        super().__init__()
        self.plant = mujoco.MjData(self.model)

    def reset(self, **options):
        mujoco.mj_resetData(self.model, self.plant)
        self.plant.qpos[:] = -1.3, 0.5
        return super().reset(**options)

    def step(self, action):
        self.plant.ctrl[:] = action
        mujoco.mj_step(self.model, self.plant, nstep=5)
        for part in ("qpos", "qvel"):
            getattr(self.data, part)[:] = getattr(self.plant, part)
        self.data.time = self.plant.time
        mujoco.mj_forward(self.model, self.data)
        off = float(np.linalg.norm(self.data.qpos - GOAL))
        return self._get_obs(), -off, False, False, {"success": off < 0.25}


class Muscles(At):
    """Muscles pull at it, whose activations all resets set alike."""

    draws = False
    xml = XML.replace(
        MOTORS, "".join(f'<muscle joint="{axis}" lengthrange="-3 3" force="9"/>' for axis in "xy")
    )

    def begin(self, place):
        self.data.act[:] = 0.1


class Renamed(Home):
    """Its resets hold otherwise what its constructor has made."""

    def __init__(self):
        super().__init__()
        self.last, self.path = np.zeros(2), np.zeros(2)

    def begin(self, place):
        self.last, self.path = None, []


class Towing(Tied):
    """The load hangs on a rope."""

    xml = Tied.xml.replace('<geom size="0.05"', '<site name="hook"/><geom size="0.05"')
    xml = xml.replace('<geom type="sphere"', '<site name="tail"/><geom type="sphere"')
    xml = xml[: xml.index("<equality>")] + xml[xml.index("</equality>") + 11 :]
    xml = xml.replace(
        "<actuator>",
        '<tendon><spatial limited="true" range="0 0.5"><site site="hook"/><site site="tail"/></spatial>'
        "</tendon><actuator>",
    )


@pytest.mark.first(6)
@pytest.mark.parametrize(
    ("make", "given", "message"),
    [
        (Ahead, {}, r"notes where it leads to \(goal"),
        (Beacon, {}, r"notes where it leads to \(mocap_pos\[0\]"),
        (Twin, {}, r"step\(\) of Twin leads to one x, wherever .* by a second one"),
        (HomeInAClosure, {}, r"notes where it leads to \(away.place\)"),
        (HomeOfWholeNumbers, {}, r"notes where it leads to \(line\)"),
        (HomeOfAKey, {}, r"notes where it leads to \(line\)"),
        (Furthest, {}, r"notes where it leads to \(best"),
        (Written, {}, r"notes where it leads to \(best\)"),
        (Walked, {}, r"notes where it leads to \(x, y\)"),
        (Walking, {}, r"notes where it leads to \(place\)"),
        (Setpoint, {"seed": 0}, r"notes where it leads to \(ctrl\[0\], ctrl\[1\]\)"),
        (Centred, {}, r"notes where it leads to \(ctrl\[0\], ctrl\[1\]\)"),
        (Integrated, {}, r"notes where it leads to \(act\[0\], act\[1\]\)"),
        (Fence, {}, "draws home, or sets it to the place that it leads to, .* first step"),
        (Fence, {"seed": 0}, r"notes where it leads to \(home\)"),
        (Fence, {"seed": 0, "starts": "reset"}, r"notes where it leads to \(home\)"),
        (FenceAtOnePlace, {}, r"notes where it leads to \(home\)"),
        (FenceByDistance, {"seed": 0}, r"notes where it leads to \(most\)"),
        (FenceByRegion, {}, r"draws region|notes where it leads to \(region"),
        (FenceByMarker, {"seed": 0}, r"notes where it leads to \(site_pos of its model\)"),
        (Tied, {"chart": {"x": "x", "y": "y"}}, "or limits of tendons tie the robot of Tied"),
        (
            Towing,
            {"chart": {"x": "x", "y": "y"}},
            "tie the robot of Towing to something that stays",
        ),
    ],
)
def test_what_stays_at_the_place_of_the_reset_is_refused(make, given, message):
    with pytest.raises(BadInput, match=message):
        from_gymnasium(make, steps=60, **given)


class Moving(gym.Wrapper):
    """Its resets put the robot to a place of their own."""

    def reset(self, **options):
        self.env.reset(**options)
        self.unwrapped.data.qpos[:2] = [-1.5, 0.4]
        return self.unwrapped._get_obs(), {}


class Later(At):
    """A gate that closes late holds it; it moves without inertia."""

    gate = 4.5

    def step(self, action):
        before = self.data.qpos.copy()
        self.data.qpos[:2] += 0.02 * action
        held = self.data.time > self.gate and (before[0] - 0.9) * (self.data.qpos[0] - 0.9) < 0
        self.data.time += 0.1
        mujoco.mj_forward(self.model, self.data)
        if held or self.data.ncon:
            self.data.qpos[:] = before
        off = float(np.linalg.norm(self.data.qpos[:2] - GOAL))
        return self._get_obs(), -off, False, False, {"success": off < 0.25}


def test_a_wrapper_that_moves_the_robot_to_its_own_start_is_refused():
    with pytest.raises(BadInput, match=r"wrapper of lambda moves the robot in its reset\(\)"):
        from_gymnasium(lambda: Moving(At()), steps=20, pinned={"qvel[0]": 0.0})
    with pytest.raises(BadInput, match="let no wrapper move the robot in its reset"):
        from_gymnasium(lambda: Moving(At()), steps=20)


@pytest.mark.long
def test_a_chart_is_no_state_where_the_time_matters_late():
    kinds = Later, type("Open", (Later,), {"gate": np.inf})
    assert [from_gymnasium(kind, steps=100).chart_is_state for kind in kinds] == [False, True]


@pytest.mark.long
def test_one_place_may_be_noted_where_runs_begin_there_alone():
    assert from_gymnasium(FenceAtOnePlace, starts="reset", steps=5).max_steps == 5
    found = from_gymnasium(type("OnePlace", (At,), {"draws": False}), steps=5).found
    assert "one place, so no reset shows" in found["starts"]


# ---- draws


class Fault(At):
    """One reset in ten reverses the motors."""

    def begin(self, place):
        self.sign = -1 if self.np_random.random() > 0.9 else 1

    def control(self, action):
        super().control(self.sign * action)


class Weak(At):
    """One reset in ten weakens the motors, in the model."""

    def begin(self, place):
        self.model.actuator_gainprm[:, 0] = 0.1 if self.np_random.random() > 0.9 else 1.0


class Lucky(Fault):
    """It is told by a number, of which only the largest do something."""

    def begin(self, place):
        self.luck = self.np_random.random()

    def control(self, action):
        At.control(self, -action if self.luck > 0.93 else action)


class Heading(At):
    """It pushes along its own axes, and its heading is drawn."""

    xml = XML.replace(
        '<geom type="sphere"', '<joint name="yaw" axis="0 0 1" damping="2"/><geom type="sphere"'
    )
    spread = np.pi

    def begin(self, place):
        self.data.qpos[2] = self.np_random.uniform(-self.spread, self.spread)

    def control(self, action):
        c, s = np.cos(self.data.qpos[2]), np.sin(self.data.qpos[2])
        super().control(np.array([[c, -s], [s, c]]) @ action)


class Pushed(At):
    """Resets draw its velocity."""

    speed = 3.0

    def begin(self, place):
        self.data.qvel[:2] = self.np_random.uniform(-self.speed, self.speed, 2)


@pytest.mark.first(2)
@pytest.mark.parametrize(
    ("make", "name"),
    [
        (Fault, "sign"),
        (Weak, "actuator_gainprm of its model"),
        (Lucky, "luck"),
        (Heading, r"qpos\[2\]"),
        (Pushed, r"qvel\[0\], qvel\[1\]"),
    ],
)
def test_rare_draws_and_those_of_the_robot_have_to_be_pinned(make, name):
    with pytest.raises(BadInput, match=f"draws {name}, and what is to be done depends on it"):
        from_gymnasium(make, starts="reset", steps=20)


@pytest.mark.long
def test_small_noise_of_resets_is_said():
    for base, what, name in (
        (Pushed, {"speed": 0.01}, "qvel[0]"),
        (Heading, {"spread": 0.01}, "qpos[2]"),
    ):
        task = from_gymnasium(type("Small", (base,), what), steps=20)
        assert name in task.found["kept"]
        assert "of the robot" in task.found["kept"]
    assert from_gymnasium(Heading, pinned={"qpos[2]": 0.0}, steps=20).max_steps == 20


class Spinning(Heading):
    """It always turns at the same speed, and pushes along its own axes."""

    def begin(self, place):
        self.data.qvel[2] = 4.0


def test_velocities_that_all_resets_set_alike_stay():
    task = from_gymnasium(Spinning, steps=20)
    assert task.specification.state[task.specification.qvel].tolist() == [0, 0, 4]
    assert "at rest but for qvel[2] and all else" in task.found["starts"]


# ---- what is honest


class Shaped(At):
    """Its reward is how much closer it comes."""

    def begin(self, place):
        self.before = float(np.linalg.norm(place - GOAL))

    def step(self, action):
        observation, reward, *rest = super().step(action)
        gained, self.before = self.before + reward, -reward
        return observation, gained, *rest


class Servo(At):
    """Its actions are the setpoints."""

    xml, draws = Setpoint.xml, False

    def begin(self, place):
        self.data.ctrl[:] = place


class ServoToAGoal(Servo):
    """Each reset draws its place, to which it sets the setpoints, and its goal."""

    xml = Servo.xml.replace(
        "<worldbody>", '<worldbody><body name="goal" mocap="true" pos="1.5 0 0"/>'
    )
    draws = True

    def begin(self, place):
        super().begin(place)
        self.data.mocap_pos[0, 1] = self.aim = self.np_random.uniform(-0.5, 0.5)

    def _get_obs(self):
        return super()._get_obs() | {"to_goal": self.data.mocap_pos[0, :2] - self.data.qpos[:2]}


PINNED = {"pinned": {"goal": np.array([1.0, 2.0])}}


def shared_rewards():
    return gym.wrappers.NormalizeReward(At())


@pytest.mark.first(1)
@pytest.mark.parametrize(
    ("make", "given"),
    [
        (Shaped, {}),
        (Shaped, {"seed": 0}),
        (Servo, {}),
        (ServoToAGoal, {"seed": 3}),
        (shared_rewards, {}),
        (Posture, {}),
        (Muscles, {}),
        (Renamed, {}),
        (Ahead, PINNED),
    ],
)
def test_what_matters_to_no_run_is_accepted(make, given):
    assert from_gymnasium(make, steps=20, **given).max_steps == 20
