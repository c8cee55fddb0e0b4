"""Environments of which a sample misleads: they are run as they are, or refused by name."""

import functools
import time
from dataclasses import replace

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from environments import GOAL, XML, Puck
from gymnasium import spaces
from gymnasium.wrappers import DelayObservation, FlattenObservation, FrameStackObservation

from hyrl_mj import BadInput, Noise, closed_loop, from_callable, from_gymnasium, simulate
from hyrl_mj.policies import PolicyController
from hyrl_mj.simulation import LoopSettings, Programmes, Recorded, Rules
from hyrl_mj.system.generators import global_state, kept_generators

pytestmark = pytest.mark.slow  # a second for each environment
BOX = spaces.Box(-np.inf, np.inf, (4,))


def puck_with(old="", new=""):
    """Returns the puck on another model."""

    class Other(Puck):
        def __init__(self):
            super().__init__()
            self.model = mujoco.MjModel.from_xml_string(XML.replace(old, new))
            self.data = mujoco.MjData(self.model)

    return Other


def east(observation):
    """An agent that drives to the right, and up or down by the second number that it sees."""
    return np.column_stack(
        [np.full(len(observation), 1.5), np.where(observation[:, 1] > 0, 1.0, -1.0)]
    )


class Key(Puck):
    """The goal counts only once the robot has been at a key, far from where random inputs lead.

    What it observes holds the last action.
    """

    observation_space = spaces.Box(-np.inf, np.inf, (6,))
    taken, last = False, np.zeros(2)

    def reset(self, **options):
        self.taken, self.last = False, np.zeros(2)
        return super().reset(**options)

    def step(self, action):
        self.last = np.array(action, dtype=float)
        observation, reward, terminated, truncated, info = super().step(action)
        self.taken = self.taken or bool(self.data.qpos[0] > 1.3 and self.data.qpos[1] > 1.0)
        info["success"] = info["success"] and self.taken
        return observation, reward, terminated, truncated, info

    def _get_obs(self):
        return np.concatenate([self.data.qpos, self.data.qvel, self.last])


@pytest.fixture(scope="module")
def key():
    return from_gymnasium(Key, steps=30)


def test_what_a_run_remembers_is_its_own(key):
    agent = from_callable(lambda o: np.tile([4.0, 0.0], (len(o), 1)), key)
    up = from_callable(lambda o: np.tile([0.0, 4.0], (len(o), 1)), key)
    goal, at_key = [1.0, 0.0], [1.6, 0.9]
    assert [arc.outcome for arc in simulate(key, up, [at_key, at_key])] == ["stalled"] * 2
    # The runs before have taken keys; these have not.
    assert [arc.outcome for arc in simulate(key, agent, [goal, goal])] == ["stalled"] * 2


def test_an_observed_action_is_that_of_the_run(key):
    plant = key.plant(2)
    plant.set_state(*key.state(np.array([[-1.0, 0.5], [-1.2, 0.0]])))
    plant.step(np.array([[1.0, 2.0], [3.0, -1.0]]))
    noise = np.zeros((2, key.measurement_columns))
    noise[:, :2] = 0.05
    observed = key.observation(plant.observe(plant.truth(np.arange(2)), noise, np.arange(2)))
    np.testing.assert_allclose(observed[:, 4:], [[1.0, 2.0], [3.0, -1.0]])
    np.testing.assert_allclose(observed[:, :2], plant.qpos + 0.05)


def wrapped():
    """Shows the puck a sample late, and the frame before."""
    return FrameStackObservation(DelayObservation(FlattenObservation(Puck()), 1), 2)


@pytest.fixture(scope="module")
def short():
    """Returns the task of the puck, bare or wrapped, with few steps."""
    return functools.cache(
        lambda is_wrapped: from_gymnasium(wrapped if is_wrapped else Puck, steps=25)
    )


def test_noise_reaches_what_lies_around_an_environment_delays_and_frames(short):
    task, rng = short(True), np.random.default_rng(0)
    values = np.zeros((6, 1, task.measurement_columns))
    values[:, 0, :2] = rng.uniform(-0.1, 0.1, (6, 2))
    agent = from_callable(lambda o: np.tile([0.5, 0.1], (len(o), 1)), task)
    arc = simulate(task, agent, [-1.0, 0.5], Recorded(values, 0.1), horizon=0.5)
    at = 2 * [*Puck.observation_space.spaces].index("position")
    last = arc.measured[4, 2:-3].reshape(-1, 6)[:, at : at + 2]
    np.testing.assert_allclose(last, (arc.z + values[:, 0, :2])[2:4], atol=1e-6)


class Difference(Puck):
    """It observes a velocity that is the difference to where it was a step ago."""

    observation_space, before = BOX, None

    def reset(self, **options):
        self.before = None
        return super().reset(**options)

    def step(self, action):
        self.before = self.data.qpos.copy()
        return super().step(action)

    def _get_obs(self):
        before = self.data.qpos if self.before is None else self.before
        return np.concatenate([self.data.qpos, (self.data.qpos - before) / 0.1])


class Cached(Puck):
    """It observes a place that step() has stored."""

    observation_space, place = BOX, np.zeros(2)

    def reset(self, **options):
        super().reset(**options)
        self.place = self.data.qpos.copy()
        return self._get_obs(), {}

    def step(self, action):
        result = super().step(action)
        self.place = self.data.qpos.copy()
        return self._get_obs(), *result[1:]

    def _get_obs(self):
        return np.concatenate([self.place, self.data.qvel])


class Terminating(Puck):
    """Reaching the goal ends the episode."""

    def step(self, action):
        observation, reward, _, truncated, info = super().step(action)
        return observation, (5.0 if info["success"] else reward), info["success"], truncated, {}


@pytest.mark.parametrize("success", ["reward >= 4", "distance(puck, goal) < 0.3"])
def test_an_end_at_the_goal_is_an_arrival_by_a_condition_that_does_not_ask_for_ends(success):
    task = from_gymnasium(Terminating, success=success, steps=30)
    assert simulate(task, from_callable(east, task), [1.2, 0.0]).outcome == "reached"


class Monitor(gym.Wrapper):
    """A user's wrapper with the name of one that only counts: this one turns the actions."""

    def step(self, action):
        return self.env.step(-np.asarray(action))


def test_an_end_at_the_goal_is_an_arrival_and_a_wrapper_with_the_name_of_one_that_counts_is_kept():
    task = from_gymnasium(lambda: Monitor(Terminating()), success="terminated", steps=30)
    west = from_callable(lambda o: -east(o), task)
    assert simulate(task, west, [1.2, 0.0]).outcome == "reached"
    arc = simulate(task, from_callable(east, task), [-1.0, 1.0])
    assert arc.z[4, 0] < arc.z[0, 0]


class Colliding(Terminating):
    """Collisions end the episode, too."""

    def step(self, action):
        observation, reward, terminated, truncated, info = super().step(action)
        return observation, reward, bool(terminated or self.data.ncon), truncated, info


def test_collisions_are_no_success():
    success = "terminated and reward >= 4 and distance(puck, goal) < 0.3"
    task = from_gymnasium(Colliding, success=success, steps=80)
    assert simulate(task, from_callable(east, task), [-1.0, 0.0]).outcome == "crashed"
    assert simulate(task, from_callable(east, task), [1.2, 0.0]).outcome == "reached"


CART = (
    '<body name="cart" pos="0 2.6 0.1"><joint type="slide" axis="1 0 0"/>'
    '<joint type="slide" axis="0 1 0"/><geom size="0.1" mass="1"/></body>'
    '<body name="goal" mocap="true" pos="1.5 0 0"/>'
)


class Cart(puck_with('<body name="puck"', CART + '<body name="puck"')):
    """Beside the puck rolls a cart; each reset draws its motion, and where the goal is, a mocap body."""

    def reset(self, *, seed=None, options=None):
        gym.Env.reset(self, seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[2:] = self.np_random.uniform((-1.8, -1.2), (-1.0, 1.2))
        self.data.qvel[:2] = self.np_random.uniform(-1, 1, 2)
        self.data.mocap_pos[0, :2] = self.np_random.uniform((1.3, -1), (1.6, 1))
        mujoco.mj_forward(self.model, self.data)
        return self._get_obs(), {}

    def _get_obs(self):
        place, speed = self.data.qpos[2:].copy(), self.data.qvel[2:].copy()
        to_goal = self.data.mocap_pos[0, :2] - place
        return {"position": place, "velocity": speed, "to_goal": to_goal}

    def step(self, action):
        self.data.ctrl[:] = np.clip(action, -4, 4)
        mujoco.mj_step(self.model, self.data, nstep=5)
        distance = float(np.linalg.norm(self.data.qpos[2:] - GOAL))
        return self._get_obs(), -distance, False, False, {"success": distance < 0.25}


def test_what_a_reset_drew_is_kept_of_other_bodies_or_pinned_also_of_a_mocap_body():
    env = Cart()
    env.reset(seed=3)
    pinned = {"qvel[1]": 0.5, "mocap_pos[0]": 1.4, "mocap_pos[1]": 0.2}
    task = from_gymnasium(Cart, chart=["x", "y"], seed=3, pinned=pinned)
    _, qvel = task.state(np.array([[-1.0, 0.5]]))
    np.testing.assert_array_equal(qvel, [[env.data.qvel[0], 0.5, 0.0, 0.0]])
    seen = np.split(task.observation(task.at(np.zeros((1, 2))))[0], 3)
    to_goal = dict(zip(task.observation_parts, seen, strict=True))["to_goal"]
    np.testing.assert_allclose(to_goal, [1.4, 0.2])


class Site(Puck):
    """Each reset draws a goal, and puts a site there."""

    goal = GOAL

    def reset(self, **options):
        gym.Env.reset(self, seed=options.get("seed"))
        self.goal = self.np_random.uniform((1.3, -1), (1.6, 1))
        self.model.site_pos[0, :2] = self.goal
        return super().reset(**options)

    def _get_obs(self):
        return super()._get_obs() | {"to_goal": self.goal - self.data.qpos}


class Failing(Puck):
    """Its step fails somewhere."""

    def step(self, action):
        if self.data.qpos[0] > -1:
            raise ValueError("broken")
        return super().step(action)


class Slow(Puck):
    """Its reset takes long."""

    def reset(self, **options):
        time.sleep(3.2)
        return super().reset(**options)


REFUSED = {
    "a stored difference": (Difference, {}, r"does not follow its state: observation\[2\]"),
    "a cached place": (Cached, {}, "each reset of Cached draws place"),
    "collisions": (
        Colliding,
        {"success": "terminated"},
        "touches what it does not touch elsewhere",
    ),
    "a cart and a mocap body": (
        Cart,
        {"chart": ["x", "y"]},
        r"draws qvel\[0\], qvel\[1\], mocap_pos\[0\], mocap_pos\[1\].*pin it",
    ),
    "a site": (Site, {}, "draws site_pos of its model, goal.*pin it"),
    "a pinned goal whose site is drawn": (Site, {"pinned": {"goal": [1.5, 0.2]}}, "draws site_pos"),
    "a contradiction": (
        Site,
        {"pinned": {"goal": [1.5, 0.2]}, "seed": 0},
        r"site_pos\[0\].*stays at",
    ),
    "a step that fails": (Failing, {}, r"step\(\) of Failing raises ValueError: broken: repair it"),
    "a slow reset": (Slow, {}, r"reset\(\) of Slow takes 3.* s"),
    "pinned of another kind": (Puck, {"pinned": {"data": 1.0}}, "no attribute data of shape"),
    "a key that is not there": (
        Puck,
        {"success": 'info["won"]'},
        "no method of it has that word: name an entry of info; it has had success",
    ),
    "success and failure": (
        Puck,
        {"failure": 'info["success"]'},
        "it is a success .* and a failure",
    ),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_misleads_is_refused_by_name(what):
    make, given, message = REFUSED[what]
    with pytest.raises(BadInput, match=message):
        from_gymnasium(make, **given)


def test_a_start_may_touch_a_wall_no_deeper_than_runs_do(short):
    # The rock ends at x = -0.3, and the puck is 0.1 m wide.
    z = np.array([[-0.41, 0.0], [-0.36, 0.0]])
    assert short(False).goes_on(z).tolist() == [True, False]


@pytest.mark.parametrize("is_wrapped", [False, True])
@pytest.mark.parametrize("kind", ["none", "uniform", "alternating", "attack"])
def test_runs_do_not_depend_on_how_many_are_played_side_by_side(
    is_wrapped, kind, short, monkeypatch
):
    task, rng = short(is_wrapped), np.random.default_rng(0)
    loop = PolicyController(from_callable(east, task))
    z, found, settings = task.starts(9, rng), [], LoopSettings(record=True, passing=True)
    assert task.abilities.side_by_side > 9
    for side in (9, 2):
        monkeypatch.setattr(task, "abilities", replace(task.abilities, side_by_side=side))
        noise = Noise() if kind in ("none", "attack") else Noise(kind, 0.1)
        if kind == "attack":
            rules = Rules(task, loop, 0.1, np.array(task.noisy))
            programmes = np.random.default_rng(1).integers(len(rules) - 1, size=(9, 3))
            noise = Programmes(task, loop, rules, programmes, 4)
        run = closed_loop(task, loop, z, noise, seed=1, settings=settings)
        found.append((run, getattr(noise, "values", np.zeros(1)), getattr(noise, "danger", 0)))
    (a, *of_a), (b, *of_b) = found
    assert np.ptp(a.length) > 0
    for name in ("path", "length", "outcome", "q0", "before", "q", "u", "state"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), name)
    for i, end in enumerate(a.length):
        np.testing.assert_array_equal(a.measured[:end, i], b.measured[:end, i])
        np.testing.assert_array_equal(a.true[:end, i], b.true[:end, i])
    for one, other in zip((a.passing.turned, *of_a), (b.passing.turned, *of_b), strict=True):
        np.testing.assert_array_equal(one, other)


class Behind(Puck):
    """It observes places as `mj_step` leaves them behind: those of the physics step before.

    Around it there are no walls, but the rock.
    """

    def _get_obs(self):
        return {
            **super()._get_obs(),
            "was_at": self.data.xpos[self.model.body("puck").id, :2].copy(),
        }

    def __init__(self):
        super().__init__()
        lines = [line for line in XML.splitlines() if '<geom type="box"' not in line]
        self.model = mujoco.MjModel.from_xml_string("\n".join(lines))
        self.data = mujoco.MjData(self.model)
        parts = self.observation_space.spaces
        self.observation_space = spaces.Dict({**parts, "was_at": spaces.Box(-np.inf, np.inf, (2,))})


@pytest.fixture(scope="module")
def behind():
    return from_gymnasium(Behind)


def test_walls_in_the_open_do_not_end_the_chart(behind):
    assert np.all(np.less(behind.chart.low, [-1.8, -1.2]))
    assert np.all(np.greater(behind.chart.high, [0.5, 1.2]))


def test_what_lags_by_a_physics_step_is_moved_by_noise_where_the_robot_was_then(behind, short):
    task = behind
    assert "a physics step before" in task.found["lag"]
    assert "lag" not in short(False).found
    plant, rows = task.plant(2), np.arange(2)
    plant.set_state(*task.state(np.array([[-1.2, 0.4], [-1.2, 0.4]])))
    noise = np.zeros_like(plant.measurement)
    noise[1, :2] = 0.03, -0.02
    for _ in range(3):
        plant.step(np.tile([2.0, 1.0], (2, 1)))
    true, alike = plant.observe(plant.truth(rows), noise, rows)
    seen = slice(-3 - 2, -3)  # before reward, success and outcome
    assert not np.allclose(true[seen], true[:2], rtol=0, atol=1e-4)  # it moves
    np.testing.assert_allclose(alike[seen] - true[seen], noise[1, :2], rtol=0, atol=1e-12)


class Pressed(Puck):
    """It observes forces of contacts, which only its own step computes."""

    observation_space = spaces.Dict(
        {**Puck.observation_space.spaces, "force": spaces.Box(-1, 1, (6,))}
    )

    def step(self, action):
        *_, info = super().step(action)
        mujoco.mj_rnePostConstraint(self.model, self.data)
        return self._get_obs(), 0.0, False, False, info

    def _get_obs(self):
        return super()._get_obs() | {"force": np.clip(self.data.body("puck").cfrc_ext, -1, 1)}


ANTS = "AntMaze_Medium-v5", {"reset": {"goal_cell": [6, 6]}, "chart": ["qpos[0]", "qpos[1]"]}


@pytest.mark.parametrize(
    ("make", "given"), [(Pressed, {}), pytest.param(*ANTS, marks=pytest.mark.long)]
)
def test_forces_of_neither_the_end_of_a_step_nor_a_physics_step_before_are_refused_under_noise(
    make, given
):
    with pytest.raises(
        BadInput, match=r"observation\[\d+\] .* include_cfrc_ext_in_observation=False"
    ):
        from_gymnasium(make, **given)


@pytest.mark.long
def test_without_these_forces_an_ant_does_not_lag_behind():
    kwargs = {"include_cfrc_ext_in_observation": False}
    assert "lag" not in from_gymnasium(ANTS[0], kwargs=kwargs, **ANTS[1]).found


class Flagged(Puck):
    """All of its instances share a flag, which a reset lowers and a place far to the right raises."""

    raised = {"flag": False}

    def reset(self, **options):
        self.raised["flag"] = False
        return super().reset(**options)

    def step(self, action):
        self.raised["flag"] = self.raised["flag"] or bool(self.data.qpos[0] > 1.5)
        return super().step(action)


def test_what_all_instances_share_may_not_change_in_an_episode_though_a_reset_sets_it_again():
    with pytest.raises(BadInput, match=r"class Flagged\.raised, which all its instances share"):
        _driven_right(from_gymnasium(Flagged, steps=30))


def _driven_right(task):
    agent = from_callable(lambda o: np.tile([4.0, 0.0], (len(o), 1)), task)
    return simulate(task, agent, [[1.0, 1.0]] * 2)


def test_any_number_of_random_numbers_is_noticed():
    """Also as many as fill the table of the generator, after which its place is the same."""
    with kept_generators():
        np.random.seed(0)
        for count in (1, 312, 624):
            before = global_state()
            np.random.random(count)
            assert global_state() != before
