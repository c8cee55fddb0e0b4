"""Starts on the chart: nothing that a reset sets to the place it leads to stays elsewhere without a word."""

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from environments import GOAL, XML, Home, Puck, outcomes
from gymnasium.wrappers import FrameStackObservation, TransformReward
from planted import without_judges

from hyrl_mj import BadInput, from_gymnasium

pytestmark = pytest.mark.slow  # a second for each environment
MOTORS = XML[XML.index("<actuator>") + 10 : XML.index("</actuator>")]
SERVOS = "".join(
    f'<position name="to_{axis}" joint="{axis}" kp="20" ctrlrange="-3 3"/>' for axis in "xy"
)


class OnePlace(Puck):
    """All of its resets lead to one place, which a variable holds."""

    draws = False

    def away(self, place):
        return float(np.linalg.norm(self.data.qpos[:2] - place))


class Setpoint(Puck):
    """Its actions move the setpoints of servos."""

    xml = XML.replace(MOTORS, SERVOS)

    def begin(self, place):
        self.data.ctrl[:] = place

    def control(self, action):
        self.data.ctrl[:] += 0.02 * action


class Centred(Setpoint):
    """Its only place is zero, where nothing in the numbers tells a setpoint."""

    def first(self):
        return np.array([0.0, 1.0])


class Fence(OnePlace):
    draws = True

    def begin(self, place):
        self.home = place.copy()

    def crashed(self):
        return self.away(self.home) > 3.4


class FenceAtOnePlace(Fence):
    draws = False


class Planning(Fence):
    """It computes for long before it notes its place."""

    draws = False

    def begin(self, place):
        for _ in range(60_000):
            pass
        super().begin(place)


class Leashed(Home):
    """It ends far from where the reset led to, where a run comes late or never."""

    def begin(self, place):
        self.home = place.copy()

    def crashed(self):
        return bool(np.linalg.norm(self.data.qpos - self.home) > 2.9)


class Fading(Home):
    """Its motors are the weaker the farther from the goal a place was that stands in its code."""

    def begin(self, place):
        self.far = float(np.linalg.norm(place - GOAL))

    def control(self, action):
        super().control(np.asarray(action) * min(1.0, self.far / 4))


class Patrol(Home):
    """It loses where it comes back to its charger, which lies on the pilot's way."""

    def first(self):
        return np.array([0.62, 0.77])

    def begin(self, place):
        self.charger, self.left = place.copy(), False

    def crashed(self):
        away = float(np.linalg.norm(self.data.qpos - self.charger))
        self.left = self.left or away > 0.8
        return self.left and away < 0.2


class Late(Puck):
    """Its motors are weaker at the end by something that a reset computes of its place."""

    def begin(self, place):
        self.share = abs(float(np.cos(3 * place[0]) * place[1]))

    def control(self, action):
        late = self.data.time > 14.5
        super().control(np.asarray(action) * (self.share if late else 1.0))


class Speeding(Home):
    """Ends where it has moved by more than it could in a sample, from where the reset led to."""

    def begin(self, place):
        self.before = place.copy()

    def crashed(self):
        moved, self.before = np.linalg.norm(self.data.qpos - self.before), self.data.qpos.copy()
        return bool(moved > 0.5)


class FenceByRegion(Puck):
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
        return self.away(self.model.site_pos[0, :2]) > 3.4


class Tied(OnePlace):
    """A load hangs on it."""

    geom = '<geom size="0.05" contype="0" conaffinity="0"/>'
    load = f'<body name="load" pos="0 0 0.1"><freejoint/>{{}}{geom}</body>'
    weld = '<equality><weld body1="load" body2="puck"/></equality>'
    xml = XML.replace("</worldbody>", f"{load.format('')}</worldbody>{weld}")

    def begin(self, place):
        self.data.qpos[2:4] = place


class Towing(Tied):
    """The load hangs on a rope."""

    rope = '<spatial limited="true" range="0 0.5"><site site="hook"/><site site="tail"/></spatial>'
    xml = XML.replace("</worldbody>", Tied.load.format('<site name="hook"/>') + "</worldbody>")
    xml = xml.replace('<geom type="sphere"', '<site name="tail"/><geom type="sphere"')
    xml = xml.replace("<actuator>", f"<tendon>{rope}</tendon><actuator>")


class AtHome(OnePlace):
    """Each reset leads to its home, as those of Gymnasium's own environments do."""

    key = False

    def __init__(self):
        super().__init__()
        self.init_qpos = np.array([0.0, 1.0])

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


class HomeInAClosure(AtHome):
    """Nothing but a variable of a function holds where it began."""

    def begin(self, place):
        self.away = lambda now: float(np.linalg.norm(now - place))

    def crashed(self):
        return self.away(self.data.qpos[:2]) > 1.0


class HomeOfWholeNumbers(AtHome):
    """It notes one coordinate, which is 1."""

    def begin(self, place):
        self.line = float(place[1])

    def crashed(self):
        return abs(self.data.qpos[1] - self.line) > 1.0


class HomeOfAKey(HomeOfWholeNumbers):
    xml = XML.replace("</mujoco>", '<keyframe><key qpos="0 1"/></keyframe></mujoco>')
    key = True


class Posture(AtHome):
    """It stays near a posture, which is where resets lead to, wherever it began."""

    def crashed(self):
        return self.away(self.init_qpos) > 3.0


class Ahead(AtHome):
    """Its goal lies ahead of its home."""

    def begin(self, place):
        self.goal = self.init_qpos[:2] + 1.0

    def crashed(self):
        return self.away(self.goal) > 3.0


class Renamed(AtHome):
    """Its resets hold otherwise what its constructor has made."""

    def __init__(self):
        super().__init__()
        self.last, self.path = np.zeros(2), np.zeros(2)

    def begin(self, place):
        self.last, self.path = None, []


class Written(OnePlace):
    """The place stands in the code of its reset, and it notes how near to the goal it has been since."""

    def begin(self, place):
        self.best = float(np.linalg.norm(place - GOAL))

    def crashed(self):
        off = self.away(GOAL)
        self.best = min(self.best, off)
        return off > self.best + 0.5

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


class Twice(AtHome):
    """Its place stands twice in its code, the second time as what it notes."""

    def reset(self, *, seed=None, options=None):
        gym.Env.reset(self, seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:], self.home = [-1.4, 0.1], (-1.4, 0.1)
        mujoco.mj_forward(self.model, self.data)
        return self._get_obs(), {}

    def crashed(self):
        return self.away(self.home) > 1.0


class Walking(Written):
    """It goes on from a place of its own."""

    crashed = Puck.crashed

    def begin(self, place):
        self.place = np.array([0.0, 1.0])

    def control(self, action):
        self.place = self.place + 0.02 * action
        self.data.qpos[:] = self.place


class Beacon(OnePlace):
    """Its goal is a mocap body ahead of where the robot begins; nothing else holds that."""

    site = '<body name="beacon" mocap="true"><site name="end" pos="0 0 1"/></body>'
    xml = XML.replace("<worldbody>", f"<worldbody>{site}")

    def reset(self, **options):
        super().reset(**options)
        self.data.mocap_pos[0, :2] = self.data.qpos + np.array([0.6, 0.1])
        mujoco.mj_forward(self.model, self.data)
        return self._get_obs(), {}

    def crashed(self):
        return self.away(self.data.mocap_pos[0, :2]) > 3.0


class Twin(OnePlace):
    """It steps a state of its own, and shows that in `data`."""

    def __init__(self):
        super().__init__()
        self.plant = mujoco.MjData(self.model)

    def begin(self, place):
        mujoco.mj_resetData(self.model, self.plant)
        self.plant.qpos[:] = -1.3, 0.5

    def step(self, action):
        self.plant.ctrl[:] = action
        mujoco.mj_step(self.model, self.plant, nstep=5)
        for part in ("qpos", "qvel"):
            getattr(self.data, part)[:] = getattr(self.plant, part)
        self.data.time = self.plant.time
        mujoco.mj_forward(self.model, self.data)
        off = self.away(GOAL)
        return self._get_obs(), -off, False, False, {"success": off < 0.25}


class Moving(gym.Wrapper):
    """Its resets put the robot to a place of their own."""

    def reset(self, **options):
        self.env.reset(**options)
        self.unwrapped.data.qpos[:2] = [-1.5, 0.4]
        return self.unwrapped._get_obs(), {}


SEED, XY = {"seed": 0}, {"chart": {"x": "x", "y": "y"}}
STAYS = {
    "a home": (Ahead, {}, r"goal"),
    "a mocap body": (Beacon, {}, r"mocap_pos\[0\]"),
    "a closure": (HomeInAClosure, {}, r"away.place\)"),
    "a whole number": (HomeOfWholeNumbers, {}, r"line\)"),
    "a key": (HomeOfAKey, {}, r"line\)"),
    "a distance in code": (Written, {}, r"best\)"),
    "numbers that stand twice": (Twice, {}, r"home\)"),
    "numbers": (Walked, {}, r"x, y\)"),
    "a place of its own": (Walking, {}, r"place\)"),
    "a setpoint": (Setpoint, SEED, r"ctrl\[0\], ctrl\[1\]\)"),
    "a setpoint at zero": (Centred, {}, r"ctrl\[0\], ctrl\[1\]\)"),
    "a fence": (Fence, SEED, r"home\)"),
    "a fence in a box": (Fence, SEED | {"starts": "reset"}, r"home\)"),
    "a fence at one place": (FenceAtOnePlace, {}, r"home\)"),
    "numbers in its code": (Fading, {}, r"far\)"),
    "what matters late": (Late, {"steps": 200}, ".*share"),
    "a leash": (Leashed, {"steps": None}, r"home\)"),
    "a leash below frames": (
        lambda: FrameStackObservation(Leashed(), 2), {"steps": None}, r".*home\)",
    ),
    "the place before": (Speeding, {"steps": None}, r"before\)"),
    "a marker": (FenceByMarker, SEED, r"site_pos of its model\)"),
}  # fmt: skip
OTHERWISE = {
    "a second state": (Twin, {}, r"step\(\) of Twin leads to one x, wherever .* by a second one"),
    "a fence that is drawn": (
        Fence, {}, "draws home, .* first step",
    ),
    "what takes long": (Planning, {}, r"reset\(\) of Planning takes more than 100,000 lines"),
    "a region": (FenceByRegion, {}, r"draws region|notes where it leads to \(region"),
    "a load": (Tied, XY, "or limits of tendons tie the robot of Tied"),
    "a rope": (Towing, XY, "tie the robot of Towing to something that stays"),
    "pins and a wrapper": (
        lambda: Moving(Puck()), {"pinned": {"qvel[0]": 0.0}},
        r"wrapper of lambda moves the robot in its reset\(\) after",
    ),
    "a wrapper": (lambda: Moving(Puck()), {}, "let no wrapper move the robot after that"),
}  # fmt: skip
TABLE = OTHERWISE | {
    name: (make, given, rf"notes where it leads to \({what}")
    for name, (make, given, what) in STAYS.items()
}


# What differs from another one in where it notes its place alone.
TOO = "a whole number", "a fence in a box", "a fence at one place", "the place before", "a rope"


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.long] * (name in TOO)) for name in TABLE]
)
def test_what_stays_at_the_place_of_the_reset_is_refused(name, monkeypatch):
    without_judges(monkeypatch)
    make, given, message = TABLE[name]
    with pytest.raises(BadInput, match=message):
        from_gymnasium(make, **{"steps": 60, **given})


def test_what_a_reset_notes_and_few_runs_come_to_is_refused_there():
    with pytest.raises(BadInput, match=r"notes where it leads to \(charger\)"):
        outcomes(Patrol, starts=np.array([[-0.8, 1.0], [-1.3, 0.5]]))


class Later(Puck):
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


@pytest.mark.long
@pytest.mark.parametrize("is_state", [False, True])
def test_a_chart_is_no_state_where_the_time_matters_late(is_state):
    kind = type("Open", (Later,), {"gate": np.inf}) if is_state else Later
    assert from_gymnasium(kind, steps=100).chart_is_state == is_state


def test_one_place_may_be_noted_where_runs_begin_there_alone():
    found = from_gymnasium(FenceAtOnePlace, starts="reset", steps=5).found
    assert "one place, so no reset shows" in found["starts"]


# ---- draws


class Fault(Puck):
    """One reset in ten reverses the motors."""

    def begin(self, place):
        self.sign = -1 if self.np_random.random() > 0.9 else 1

    def control(self, action):
        super().control(self.sign * action)


class Weak(Puck):
    """One reset in ten weakens the motors, in the model."""

    def begin(self, place):
        self.model.actuator_gainprm[:, 0] = 0.1 if self.np_random.random() > 0.9 else 1.0


class Lucky(Puck):
    """It is told by a number, of which only the largest do something."""

    def begin(self, place):
        self.luck = self.np_random.random()

    def control(self, action):
        super().control(-action if self.luck > 0.93 else action)


class Heading(Puck):
    """It pushes along its own axes, and its heading is drawn."""

    yaw = '<joint name="yaw" axis="0 0 1" damping="2"/>'
    xml = XML.replace('<geom type="sphere"', f'{yaw}<geom type="sphere"')
    spread = np.pi

    def begin(self, place):
        self.data.qpos[2] = self.np_random.uniform(-self.spread, self.spread)

    def control(self, action):
        c, s = np.cos(self.data.qpos[2]), np.sin(self.data.qpos[2])
        super().control(np.array([[c, -s], [s, c]]) @ action)


class Pushed(Puck):
    """Resets draw its velocity."""

    speed = 3.0

    def begin(self, place):
        self.data.qvel[:2] = self.np_random.uniform(-self.speed, self.speed, 2)


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


@pytest.mark.first(1)
@pytest.mark.parametrize(
    ("base", "what", "name"),
    [(Pushed, {"speed": 0.01}, "qvel[0]"), (Heading, {"spread": 0.01}, "qpos[2]")],
)
def test_small_noise_of_resets_is_said(base, what, name):
    kept = from_gymnasium(type("Small", (base,), what), steps=20).found["kept"]
    assert name in kept
    assert "of the robot" in kept


class Spinning(Heading):
    """It always turns at the same speed, and pushes along its own axes."""

    def begin(self, place):
        self.data.qvel[2] = 4.0


def test_velocities_that_all_resets_set_alike_stay():
    task = from_gymnasium(Spinning, steps=20)
    assert task.specification.state[task.specification.qvel].tolist() == [0, 0, 4]
    assert "at rest but for qvel[2] and all else" in task.found["starts"]


CART = (
    '<body name="cart" pos="0 2.6 0.1"><joint type="slide" axis="1 0 0"/>'
    '<joint type="slide" axis="0 1 0"/><geom size="0.1" mass="1"/></body>'
    '<body name="goal" mocap="true" pos="1.5 0 0"/>'
)


class Cart(Puck):
    """Beside the puck rolls a cart; each reset draws its motion, and where the goal is, a mocap body."""

    xml, at = XML.replace('<body name="puck"', CART + '<body name="puck"'), slice(2, 4)

    def begin(self, place):
        self.data.qvel[:2] = self.np_random.uniform(-1, 1, 2)
        self.data.mocap_pos[0, :2] = self.np_random.uniform((1.3, -1), (1.6, 1))

    def _get_obs(self):
        to_goal = self.data.mocap_pos[0, :2] - self.data.qpos[self.at]
        return super()._get_obs() | {"to_goal": to_goal}


def test_what_a_reset_drew_is_kept_of_other_bodies_or_pinned_also_of_a_mocap_body():
    draws = r"draws qvel\[0\], qvel\[1\], mocap_pos\[0\], mocap_pos\[1\].*pin it"
    with pytest.raises(BadInput, match=draws):
        from_gymnasium(Cart, chart=["x", "y"], steps=20)
    env = Cart()
    env.reset(seed=3)
    pinned = {"qvel[1]": 0.5, "mocap_pos[0]": 1.4, "mocap_pos[1]": 0.2}
    task = from_gymnasium(Cart, chart=["x", "y"], seed=3, pinned=pinned, steps=20)
    _, qvel = task.state(np.array([[-1.0, 0.5]]))
    np.testing.assert_array_equal(qvel, [[env.data.qvel[0], 0.5, 0.0, 0.0]])
    seen = np.split(task.observation(task.at(np.zeros((1, 2))))[0], 3)
    to_goal = dict(zip(task.observation_parts, seen, strict=True))["to_goal"]
    np.testing.assert_allclose(to_goal, [1.4, 0.2])


# ---- what is honest


class Shaped(Puck):
    """Its reward is how much closer it comes."""

    def begin(self, place):
        self.before = float(np.linalg.norm(place - GOAL))

    def step(self, action):
        observation, reward, *rest = super().step(action)
        gained, self.before = self.before + reward, -reward
        return observation, gained, *rest


class Servo(OnePlace):
    """Its actions are the setpoints."""

    xml = Setpoint.xml

    def begin(self, place):
        self.data.ctrl[:] = place


class ServoToAGoal(Servo):
    """Each reset draws its place, to which it sets the setpoints, and its goal."""

    goal = '<body name="goal" mocap="true" pos="1.5 0 0"/>'
    xml = Servo.xml.replace("<worldbody>", f"<worldbody>{goal}")
    draws = True

    def begin(self, place):
        super().begin(place)
        self.data.mocap_pos[0, 1] = self.aim = self.np_random.uniform(-0.5, 0.5)

    def _get_obs(self):
        return super()._get_obs() | {"to_goal": self.data.mocap_pos[0, :2] - self.data.qpos[:2]}


class Muscles(OnePlace):
    """Muscles pull at it, whose activations all resets set alike."""

    xml = XML.replace(
        MOTORS, "".join(f'<muscle joint="{axis}" lengthrange="-3 3" force="9"/>' for axis in "xy")
    )

    def begin(self, place):
        self.data.act[:] = 0.1


class Viewed(Puck):
    """It keeps a view of MuJoCo's positions, and what its model was built from, with a number."""

    def __init__(self):
        super().__init__()
        self.place, self.built_of = self.data.qpos[:2], (mujoco.MjSpec(), 1.5)

    def _get_obs(self):
        return super()._get_obs() | {"position": self.place.copy()}


@pytest.mark.parametrize(
    ("make", "given"),
    [
        (Shaped, {}),
        (ServoToAGoal, {"seed": 3}),
        (Posture, {}),
        (Shaped, {"seed": 0}),
        (Servo, {}),
        (Muscles, {}),
        (Renamed, {}),
        (lambda: TransformReward(Viewed(), float), {}),
        (Speeding, {"starts": "reset"}),
        (Heading, {"pinned": {"qpos[2]": 0.0}}),
    ],
)
def test_what_matters_to_no_run_is_accepted(make, given):
    assert from_gymnasium(make, steps=20, **given).max_steps == 20
