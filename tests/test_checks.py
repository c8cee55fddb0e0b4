"""What is wrong with a task is found before it is trained, and what fails later names the state."""

import itertools
import re

import mujoco
import numpy as np
import pytest
from dm_control.mujoco.wrapper import core

import hyrl_mj
from hyrl_mj import BadInput, Outcome
from hyrl_mj.gym_export import BatchedEnv
from hyrl_mj.physics import memory, mjcf, mujoco_log
from hyrl_mj.policies import PolicyController
from hyrl_mj.simulation import LoopSettings, Noise, closed_loop
from hyrl_mj.tasks import SPARING, check_task, trial
from hyrl_mj.tasks.scaffold import write_task

pytestmark = pytest.mark.usefixtures("few_steps")
PY, XML = "py", "xml"
NUMBER = itertools.count()


def changed(folder, *edits):
    """Returns the task of the scaffold after edits (file, pattern, replacement)."""
    name = f"changed_{next(NUMBER)}"
    write_task(name, folder)
    for file, old, new in edits:
        path = folder / f"{name}.{file}"
        text = path.read_text()
        assert re.search(old, text), old
        path.write_text(re.sub(old, new, text))
    return hyrl_mj.get_task(folder / f"{name}.py")


OBSERVED = r"return measured\[:, :3\]\n\n    def measured"
REWARDED, REWARD = r"        close = np\.maximum", "        close = np.maximum"
ENDED, THEN = r"        return ends\n", "\n\n    def measured"
BAND = (
    r"return -self\.clearance\(measured\)",
    "c = self.clearance(measured)\n        return np.where(np.abs(c - 0.5) < 0.1, np.nan, -c)",
)
CROSSED = r"ends\[measured\[:, 0\] >= self\.set_point\[0\]\] = Outcome\.REACHED"
MISTAKES = {
    "no start to replay": ((PY, r"starts=\(.*\)\),? time", "starts=(), time"), "scene.starts is empty"),
    "a chart of seven coordinates": (
        (PY, r"Chart\(\(.*\)", 'Chart(tuple("abcdefg"), *4 * [(1,) * 7])'),
        r"its chart has 7 coordinates \(a, b, c, d, e, f, g\): give at most 6, those in which the decision",
    ),
    "a scale of too few numbers": (
        (PY, r"\(False, False\)\)", "(False, False), scale=(1,))"),
        r"its chart has 2 name\(s\) and 1 value\(s\) of scale: give 2",
    ),
    "a scale of nothing": (
        (PY, r"\(False, False\)\)", "(False, False), scale=(1, 0))"),
        r"its chart has the scale \(1, 0\): give finite numbers > 0",
    ),
    "a limit that is a float": ((PY, "max_steps = 70", "max_steps = 70.0"), "max_steps 70.0 cannot be"),
    "a limit of no samples": ((PY, "max_steps = 70", "max_steps = 0"), "integer from 1 to 100,000"),
    "a limit that is true": ((PY, "max_steps = 70", "max_steps = True"), "max_steps True cannot be"),
    "endings in a column": ((PY, ENDED, "        return ends[:, None]\n"), r"ending\(\) .*shape \(\d+, 1\)"),
    "one ending for all": ((PY, ENDED, "        return Outcome.RUNNING\n"), r"ending\(\) .*a Outcome for"),
    "endings in a list": ((PY, ENDED, "        return list(ends)\n"), r"ending\(\) .*gives a list"),
    "no endings": ((PY, ENDED, "        ends = 0\n"), r"ending\(\) .*gives a NoneType"),
    "endings that are floats": ((PY, ENDED, "        return ends / 2\n"), "give a hyrl_mj.Outcome"),
    "an unknown ending": ((PY, r"= Outcome\.OUT_OF_BOUNDS", "= 9"), "give a hyrl_mj.Outcome"),
    "a reward that is nan late": (
        (PY, REWARDED, "        measured = np.where(measured > 2.5, np.nan, measured)\n" + REWARD),
        r"reward\(\) .*gives nan at x = 2\.5",
    ),
    "an error late": (
        (PY, REWARDED, "        assert (measured[:, 0] < 2.5).all(), 'far'\n" + REWARD),
        r"reward\(\) .*AssertionError: far, line \d+ at x = 2\.5",
    ),
    "an observation that is nan late": (
        (PY, OBSERVED, "return np.where(measured < 2.5, measured, -np.inf)[:, :3]" + THEN),
        r"observation\(\) .*-inf.* at x = 2\.5",
    ),
    "an error at the end": (
        (PY, OBSERVED, "assert (measured[:, 0] < 3).all()\n        return measured[:, :3]" + THEN),
        r"observation\(\) .*AssertionError.* at x = 3\.",
    ),
    "an exit": ((PY, REWARDED, "        raise SystemExit(0)\n" + REWARD), "SystemExit: 0"),
    "a state that is nan": ((PY, "return z, np.stack", "return z * np.nan, np.stack"), "qpos that is not"),
    "a state that is no pair": ((PY, "return z, np.stack", "return np.stack"), "give a tuple"),
    "a miss that is nan": ((PY, r"np\.abs\(z\[:, 1\]\)", "np.nan * z[:, 1]"), r"miss\(\) .*gives nan at x"),
    "misses that are complex": ((PY, r"np\.abs\(z\[:, 1\]\)", "z[:, 1] + 1j"), "array of real numbers"),
    "misses in columns": ((PY, r"np\.abs\(z\[:, 1\]\)", "np.abs(z)"), r"miss\(\) .*shape \(\d+, 2\)"),
    "a miss with a sign": ((PY, r"np\.abs\(z\[:, 1\]\)", "z[:, 1]"), r"miss\(\) gives -.*a distance"),
    "a danger that is nan": ((PY, *BAND), r"danger\(\) .*gives nan at x"),
    "one danger for all": ((PY, r"return -self\.clearance\(measured\)", "return 1.0"), r"danger\(\).*float"),
    "a sample of too many steps": ((XML, 'data="0.05"', 'data="100"'), "10,000 physics steps.*5,000"),
    "a sample that is not a time": ((XML, 'data="0.05"', 'data="nan"'), "XML contains a 'NaN'"),
    "a timestep of zero": ((XML, 'timestep="0.01"', 'timestep="0"'), "timestep .*0.0 cannot be used"),
    "a reward below its bound": ((PY, "worst_reward = 0.0", "worst_reward = 2.5"), "worst_reward is 2.5"),
    "a bound that is nan": ((PY, "worst_reward = 0.0", "worst_reward = np.nan"), "worst_reward nan"),
    "no distance that counts": ((PY, "close = 0.3", "close = -1.0"), "close -1.0 cannot be used"),
    "bounds the wrong way": (
        (PY, "observation_low, observation_high =", "observation_high, observation_low ="),
        "the lower ones first",
    ),
    "noise on too few columns": ((PY, r"noisy = .*\n", "noisy = ()\n"), r"noisy \[\] cannot be used"),
    "noise that is no tuple": ((PY, r"noisy = .*\n", "noisy = None\n"), "noisy None .*a tuple"),
    "noise that is negative": ((PY, r"noisy = .*\n", "noisy = (0, -1, 0, 0)\n"), r"noisy\[1\] -1"),
    "levels in a text": ((PY, "levels=5", "levels='5'"), r"learning\.levels '5'"),
    "a mirror that is none": ((PY, r"mirror = Mirror\(.*\)", "mirror = (1, -1)"), r"hyrl_mj\.Mirror"),
    "a start that is nan": ((PY, r"\(0\.0, -0\.8\)", "(0.0, np.nan)"), r"start_low\[1\] nan"),
    "a name that is a path": ((PY, r'    name = "\w+"', '    name = "../up"'), "letters, digits and _"),
    "a servo too strong for its link": (
        ((XML, 'kv="12"', 'kv="1e9"'), (XML, 'mass="1"', 'mass="0.001"')),
        r"breaks down under random inputs, from x = .*QACC.*lower kv or gear",
    ),
    "a gear too large": ((XML, 'kv="12"', 'kv="12" gear="1e12"'), "breaks down under"),
    "a body pushed apart": ((XML, 'gravity="0 0 0"', 'gravity="1e12 0 0"'), "breaks down under"),
    "noise on nothing": ((PY, r"noisy = .*\n", "noisy = (0, 0, 0, 0)\n"), "a share > 0"),
    "a share of noise on nothing as a whole": (
        (PY, r"noisy = .*\n", "noisy = (0, 0.5, 0, 0)\n"), "noise of none of x and y: divide it by 0.5"
    ),
    "noise that no network sees": (
        (PY, OBSERVED, "return measured[:, [0, 2, 2]]" + THEN), r"columns \[1\].*no network would see it"
    ),
    "noise beside the chart": (
        (PY, r"noisy = .*\n", "noisy = (0, 0, 1, 0)\n"), "noise of none of x and y: let the chart hold"
    ),
    "a plane seen from behind": (
        (PY, r"    def miss", "    plane = (1, 0)\n\n    def miss"), r"plane is \(1, 0\).*in this order"
    ),
    "sides exchanged": ((PY, r'\("left", "right"\)', '("Right", "Left")'), "passes the obstacle on its left"),
    "centimetres of metres": ((PY, r'\("m", "m"\)', '("m", "cm")'), "y is said to be in cm.*: say m"),
    "a mirror that is no symmetry": ((PY, r"\(1, -1, -1\)", "(1, 1, 1)"), "mirror is no symmetry of it"),
    "an input twice": (
        (PY, r'\("lateral",\), \("m/s",\)', '("lateral",) * 2, ("m/s",) * 2'), "name each once"
    ),
    "joints without a state": (
        (
            (PY, r"    def state\(self", "    def _state(self"),
            (XML, '<body name="robot">', '<body><joint/><geom size="0.1"/></body><body name="robot">'),
            (XML, 'qpos="0 0"', 'qpos="0 0 0"'),
        ),
        r"2 coordinate\(s\), and .* 3 positions of joints .*give the task a state",
    ),
    "an input without effect": ((XML, 'kv="12"', 'kv="0"'), "input lateral changes nothing"),
    "a link too heavy": ((XML, 'mass="1"', 'mass="1e300"'), "input lateral changes nothing"),
    "a mass that is nan": ((XML, 'mass="1"', 'mass="nan"'), "XML contains a 'NaN'"),
    "one level": ((PY, "levels=5", "levels=1"), r"1 levels of each of 1 input\(s\) cannot be used"),
    "a chart that is none": ((PY, r"chart = Chart\(.*\)", "chart = None"), r"chart is None: .*\.Chart"),
    "a side of no length": ((PY, r"\(3\.2, 1\.5\)", "(0.0, 1.5)"), "side that is not positive"),
    "a control without end": ((XML, 'ctrl="1 0"', 'ctrl="inf 0"'), "key_ctrl in .* are not finite"),
    "two sample times": ((XML, 'data="0.05"', 'data="0.05 0.05"'), r"sample_time .* 2 value\(s\): give it 1"),
    "nothing to pass": ((XML, 'name="obstacle"', 'name="pillar"'), "xml has no obstacle: begin the name"),
    "velocities in a row": ((PY, r"return z, np\.stack.*", "return z, z[:, 0]"), r"qvel has shape \(64,\)"),
    "an observation that counts": (
        (PY, OBSERVED, "self.n = getattr(self, 'n', 0) + 1\n        return measured[:, :3] + self.n" + THEN),
        r"measured\(\) is not the inverse of observation\(\)",
    ),
    "a sparse Jacobian": ((XML, "<option", '<option jacobian="sparse"'), r'4\.0\.0.*jacobian="dense"'),
}  # fmt: skip


@pytest.mark.fast(8)
@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_one_sentence(tmp_path, monkeypatch, mistake, caplog):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(memory, "WRONG_VERSION", memory.mujoco.__version__)
    edits, says = MISTAKES[mistake]
    edits = edits if isinstance(edits[0], tuple) else (edits,)
    with pytest.raises(BadInput, match=says) as refused:
        check_task(changed(tmp_path, *edits))
    text = str(refused.value)
    assert "\n" not in text
    assert str(tmp_path) in text
    assert caplog.text == "", "MuJoCo's warnings are part of the sentence"
    assert not (tmp_path / "MUJOCO_LOG.TXT").exists()


@pytest.mark.long
def test_starts_that_have_arrived_already_are_found(tmp_path):
    still = ((PY, CROSSED, "pass"), (PY, r"\(5\.0, 3\.0, 3\.0\)", "(9.0, 3.0, 3.0)"))
    there = (PY, r"np\.abs\(z\[:, 1\]\)", "0 * z[:, 1]")
    check_task(changed(tmp_path, *still))
    with pytest.raises(BadInput, match="64 of 64 starts already count as arrived, as x = "):
        check_task(changed(tmp_path, *still, there))


def test_extreme_inputs_from_all_over_the_chart_break_it_down(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    light = ((XML, 'kv="12"', 'kv="1e9"'), (XML, 'mass="1"', 'mass="0.001"'))
    with pytest.raises(BadInput, match="breaks down under extreme inputs, from x = "):
        trial.try_extreme(changed(tmp_path, *light))


def test_every_corner_is_held_and_alternates(vehicle, monkeypatch):
    seen = []

    def play(task, z, inputs, kind):
        seen.append((z, np.array([inputs(k) for k in range(4)])))
        return np.zeros(len(z))

    monkeypatch.setattr(trial, "_play", play)
    trial.try_extreme(vehicle)
    [(z, u)] = seen
    held = (u == u[0]).all(axis=(0, 2))
    assert 0 < held.sum() < len(z)
    np.testing.assert_array_equal(u[1:, ~held], -u[:-1, ~held])
    assert set(u.ravel()) == {-1.0, 1.0}
    assert np.ptp(z[:, 0]) > 1.5, "all over the chart, not only at the start"


def test_the_steps_of_a_trial_are_bounded(vehicle, monkeypatch):
    monkeypatch.setattr(type(vehicle), "max_steps", 100_000)
    steps = trial._samples(vehicle) * trial._side_by_side(vehicle)
    assert steps <= trial.STEPS


def test_a_trial_of_a_slow_plant_has_fewer_episodes(vehicle, monkeypatch):
    usual = trial._side_by_side(vehicle)
    monkeypatch.setattr(type(vehicle), "effort", SPARING)
    assert trial.FEWEST <= trial._side_by_side(vehicle) < usual


# ---- later, wherever a method is called


class Late:
    """Steers nearly ahead, and otherwise where noise shows it."""

    def act(self, measured):
        return 1e-3 * measured[:, 1:2]


LATE_END = "        assert (measured[:, 0] < 1).all()\n        return ends\n"
OBSERVES = "    def observation"
LATE_Z = (
    "    def z(self, m):\n        return np.where(m[:, :2] > 1, np.nan, m[:, :2])\n\n" + OBSERVES
)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        (ENDED, LATE_END, r"ending\(\) .*AssertionError.* at x = 1"),
        (OBSERVES, LATE_Z, r"z\(\) of the task .* gives \[nan"),
        (*BAND, r"danger\(\) of the task .* gives nan at x"),
    ],
)
def test_a_failure_in_a_simulation_names_method_and_state(tmp_path, old, new, says):
    task, settings = changed(tmp_path, (PY, old, new)), LoopSettings(quiet=True)
    noise, z0 = Noise("adversarial", 0.01), np.array([[0.0, 0.9]])
    with pytest.raises(BadInput, match=says):
        closed_loop(task, PolicyController(Late()), z0, noise, settings=settings)


@pytest.mark.parametrize(
    ("new", "says"),
    [
        ("        assert (measured[:, 0] < 1).all()\n", r"AssertionError.* at x = 1"),
        ("        return np.where(measured[:, 0] < 1, 1.0, np.nan)\n", r"gives nan at x = 1"),
        ("        return np.ones(3)\n", r"gives shape \(3,\) for 2 row"),
    ],
)
def test_a_failure_in_an_environment_names_method_and_state(tmp_path, new, says):
    env = BatchedEnv(changed(tmp_path, (PY, REWARDED, new + REWARD)), 2)
    env.reset(z=np.array([[0.0, 0.9], [0.0, -0.9]]))

    def play():
        for _ in range(40):
            env.step(np.zeros((2, 1)))

    with pytest.raises(BadInput, match=r"reward\(\) of the task .*" + says):
        play()


def test_an_error_that_no_single_row_raises_has_no_state(tmp_path):
    new = "        assert len(measured) == 1\n        close = np.maximum"
    task = changed(tmp_path, (PY, REWARDED, new))
    with pytest.raises(BadInput, match=r"AssertionError, line \d+$"):
        task.reward(np.zeros((2, 4)), np.zeros((2, 1)))


def test_a_subclass_may_add_columns_to_those_of_its_base(vehicle):
    class More(type(vehicle)):
        observation_low, observation_high = (
            (*vehicle.observation_low, -9),
            (*vehicle.observation_high, 9),
        )

        def observation(self, measured):
            return np.hstack([super().observation(measured), measured[:, :1]])

    assert More().observation(np.zeros((3, 2))).shape == (3, 4)


def test_a_method_that_works_returns_what_it_did(vehicle):
    z = np.array([[0.1, 0.2], [0.3, 0.4]])
    np.testing.assert_array_equal(vehicle.ending(z), [Outcome.RUNNING] * 2)
    assert type(vehicle).ending.__wrapped__.__qualname__.endswith("ending")


# ---- MuJoCo's warnings


@pytest.mark.parametrize(
    "handler", [None, core._warning_callback], ids=["no handler", "dm_control"]
)
def test_warnings_are_counted_and_said_once(tmp_path, monkeypatch, caplog, handler):
    """Also where dm_control has set its handler, as importing it does."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(mujoco_log, "_said", set())
    mujoco.set_mju_user_warning(handler)
    light = ((XML, 'kv="12"', 'kv="1e9"'), (XML, 'mass="1"', 'mass="0.001"'))
    plant = changed(tmp_path, *light).plant(20)
    before = mujoco_log.counts.copy()
    for _ in range(5):
        plant.set_state(np.zeros((20, 2)), np.ones((20, 2)))
        plant.step(np.full((20, 1), 0.5))
    assert (plant.warnings > 0).all()
    assert len(caplog.records) == 1
    assert "MuJoCo warns: Nan, Inf or huge value in QACC" in caplog.text
    assert re.match("MuJoCo warned [0-9]+ times, most often: Nan", mujoco_log.since(before))
    assert mujoco_log.since(mujoco_log.counts) == ""
    assert not (tmp_path / "MUJOCO_LOG.TXT").exists()


# ---- MuJoCo 4.0.0


@pytest.mark.parametrize(
    ("option", "joint", "wrong"),
    [
        ('jacobian="sparse"', 'limited="true" range="-1 1"', True),
        ('jacobian="sparse"', 'frictionloss="1"', True),
        ('jacobian="sparse"', "", False),
        ('jacobian="dense"', 'limited="true" range="-1 1"', False),
        ('jacobian="sparse" solver="CG"', 'limited="true" range="-1 1"', False),
    ],
)
def test_only_a_sparse_jacobian_with_constraints_is_refused(option, joint, wrong):
    model = mjcf.mujoco.MjModel.from_xml_string(
        f'<mujoco><option {option}/><worldbody><body><joint type="slide" {joint}/>'
        '<geom size="1" contype="0"/></body></worldbody></mujoco>'
    )
    assert bool(memory.wrong_physics(model, "4.0.0")) == wrong
    assert memory.wrong_physics(model, "4.0.1") == ""
    assert memory.wrong_physics(model, "3.17.0") == ""


def test_bodies_that_may_sleep_are_refused():
    xml = '<mujoco><option><flag sleep="{}"/></option><worldbody/></mujoco>'
    for word, wrong in (("enable", True), ("disable", False)):
        model = mjcf.mujoco.MjModel.from_xml_string(xml.format(word))
        assert ("lets bodies sleep" in memory.unusable(model)) == wrong


@pytest.mark.parametrize("name", hyrl_mj.task_names())
def test_the_robots_of_this_package_have_a_dense_jacobian(name):
    model = hyrl_mj.get_task(name).model
    assert not mjcf.mujoco.mj_isSparse(model)
    assert memory.wrong_physics(model, "4.0.0") == ""
