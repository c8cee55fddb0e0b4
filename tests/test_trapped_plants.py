"""What is not as it seems is refused, left open, or right: robots with planted traps, each trap by itself."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
import trapped_plants
from trapped_plants import TASK, TRAPS, Robot, dial, ends, examined, methods, task_of, vehicle

from hyrl_mj import BadInput
from hyrl_mj.judging.game import Lattice
from hyrl_mj.judging.proof import why_no_cells
from hyrl_mj.judging.proof.affine import Unbounded
from hyrl_mj.judging.proof.assumptions import check_assumptions
from hyrl_mj.sets import Grid
from hyrl_mj.simulation import noise
from hyrl_mj.tasks import Outcome, check_task, trial
from hyrl_mj.tasks.motion import begins_anew, stands_still

# The seeds of robots with every trap once: seed k has the trap number k modulo their number.
ROUNDS = [range(first, first + len(TRAPS)) for first in range(0, 13 * len(TRAPS), len(TRAPS))]


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:invalid value")
@pytest.mark.parametrize(
    "seeds", [ROUNDS[0], *(pytest.param(seeds, marks=pytest.mark.long) for seeds in ROUNDS[1:])]
)
def test_nothing_that_is_called_won_is_lost_in_mujoco(tmp_path, seeds):
    found = [examined(seed, tmp_path) for seed in seeds]
    assert [(f.trap, f.wrong) for f in found if f.wrong] == []
    assert any(f.claims for f in found)


@pytest.mark.slow
def test_honest_robots_are_proved(tmp_path):
    honest = [
        examined(seed * len(TRAPS), tmp_path) for seed in (0, 2)
    ]  # of one and of two coordinates
    assert {f.word for f in honest} == {"proved"}


# ---- each trap by itself


@pytest.mark.first(2)
@pytest.mark.parametrize("make", [vehicle, dial])
@pytest.mark.parametrize(
    "servo",
    ['delay="0.05" nsample="2"', 'delay="0.2" nsample="5"', 'dyntype="filterexact" dynprm="0.2"'],
)
def test_a_servo_with_a_memory_is_not_kinematic(tmp_path, monkeypatch, make, servo):
    task = task_of(make()._replace(servo=servo), tmp_path, monkeypatch)
    assert not task.kinematic
    assert "larger state" in Lattice.why_not(task)
    with pytest.raises(Unbounded, match=r"histories of actuators|activations of actuators"):
        check_assumptions(task)


@pytest.mark.parametrize(("mass", "kinematic"), [("1", True), ("1000", False), ("1e5", False)])
def test_a_mass_that_lags_is_not_kinematic(tmp_path, monkeypatch, mass, kinematic):
    robot = vehicle()._replace(kv=1e6)
    task = task_of(robot._replace(xml=robot.xml | {"mass": mass}), tmp_path, monkeypatch)
    assert task.kinematic == task.chart_is_state == kinematic


@pytest.mark.parametrize(("stiffness", "still"), [("1", True), ("1e7", False)])
def test_what_a_spring_moves_is_not_run_backward(tmp_path, monkeypatch, stiffness, still):
    robot = vehicle()._replace(kv=1e7, on_joint=f'stiffness="{stiffness}"')
    task = task_of(robot, tmp_path, monkeypatch)
    assert task.kinematic
    assert stands_still(task) == still
    z, u = np.array([[0.5, 1.0]]), np.array([[0.5]])
    plant = task.placed(z)
    plant.step(u)
    plant.step_backward(u)
    assert (np.abs(plant.qpos - z).max() < 1e-3) == still


def test_a_saturated_servo_is_no_direct_one(tmp_path, monkeypatch):
    weak = task_of(vehicle()._replace(kv=1e6, servo='forcerange="-5 5"'), tmp_path, monkeypatch)
    assert not begins_anew(weak)
    strong = vehicle()._replace(kv=1e6, servo='forcerange="-1e9 1e9"')
    task = task_of(strong, tmp_path, monkeypatch)
    assert "the forcerange of actuator u" in why_no_cells(
        task, Grid.with_cells(task.chart, 60).counts
    )


@pytest.mark.parametrize(
    ("code", "bad"),
    [
        ("np.sqrt(x - 2.5) >= -1", "x < 2.5"),
        ("np.log(x - 2.5) >= -99", "x < 2.5"),
        ("np.arcsin(x) >= -9", "x > 1"),
    ],
)
@pytest.mark.filterwarnings("ignore:invalid value", "ignore:divide by zero")
def test_an_end_by_nan_is_not_proved(tmp_path, monkeypatch, code, bad):
    from hyrl_mj.judging.proof.cells import Cells

    crash = f"ends[~({code}) & (x > 0.5)] = Outcome.CRASHED"
    task = task_of(ends(vehicle(), crash), tmp_path, monkeypatch)
    cells = Cells.cover(Lattice.tabulate(task, Grid.with_cells(task.chart, 60)))
    x = cells.middle(np.arange(cells.nodes))[:, 0]
    assert cells.failed[(x > 0.6) & eval(bad)].all()


@pytest.mark.first(2)
@pytest.mark.parametrize("turns", [-3, -2, 2])
@pytest.mark.parametrize("wide", [1e-4, 1.0])
def test_an_end_beyond_some_turns_is_told(tmp_path, monkeypatch, turns, wide):
    place = 2 * np.pi * turns + 1
    code = f"ends[np.abs(theta - {place}) < {wide}] = Outcome.CRASHED"
    task = task_of(ends(dial(), code), tmp_path, monkeypatch)
    why = why_no_cells(task, Grid.with_cells(task.chart, 600).counts)
    assert "the method ending" in why
    assert "tells whole turns of theta apart" in why


@pytest.mark.first(2)
@pytest.mark.parametrize(
    "code",
    [
        "ends[np.cos(3 * theta) > 2] = Outcome.CRASHED",
        "ends[np.remainder(theta + 0.3, 2 * np.pi) > 9] = Outcome.CRASHED",
        "ends[self.chart.wrap(measured)[:, 0] < -1] = Outcome.CRASHED",
        "ends[np.abs(self.chart.difference(measured, self.set_point))[:, 0] > 9] = Outcome.CRASHED",
    ],
)
def test_code_that_is_the_same_for_all_turns_is_covered(tmp_path, monkeypatch, code):
    task = task_of(ends(dial(), code), tmp_path, monkeypatch)
    assert why_no_cells(task, Grid.with_cells(task.chart, 600).counts) is None


@pytest.mark.parametrize(
    ("sensor", "says"),
    [
        (
            'interval="0.2" nsample="3"',
            r"sensor \(0\) of trapped_\d+_\d+ holds its value for 0.2 s",
        ),
        ('delay="0.1" nsample="4"', "is 0.1 s late, and the true state is taken from the sensors"),
        ('cutoff="2"', "is measured as x = 2 m"),
    ],
)
def test_a_sensor_that_does_not_tell_the_position_is_refused(tmp_path, monkeypatch, sensor, says):
    task = task_of(vehicle()._replace(sensor=sensor), tmp_path, monkeypatch)
    with pytest.raises(BadInput, match=says):
        check_task(task)


def test_starts_outside_of_their_box_are_refused(tmp_path, monkeypatch):
    code = "\n    def starts(self, n, rng):\n        return rng.uniform((0.0, -1.0), (0.41, 1.0), (n, 2))\n"
    task = task_of(methods(vehicle(), code), tmp_path, monkeypatch)
    with pytest.raises(
        BadInput, match=r"of 4,000 starts that starts\(\) draws lie outside of its box, as"
    ):
        check_task(task)


@pytest.mark.parametrize("radius", [0.4, 0.05])
def test_a_mirror_that_a_second_obstacle_breaks_is_refused(tmp_path, monkeypatch, radius):
    second = f"ends[(x - 2.4) ** 2 + (y - 0.8) ** 2 <= {radius} ** 2] = Outcome.CRASHED"
    scenery = vehicle().xml["scenery"]
    scenery += (
        f'<geom name="obstacle_b" size="{radius}" pos="2.4 0.8 0" contype="0" conaffinity="0"/>'
    )
    robot = ends(vehicle(), second)
    robot = Robot(**robot._asdict())._replace(
        xml=robot.xml | {"scenery": scenery}, py=robot.py | {"mirror": "Mirror((1, -1), (-1,))"}
    )
    task = task_of(robot, tmp_path, monkeypatch)
    with pytest.raises(
        BadInput, match=r"mirror is no symmetry of it: x = .*\((running|crashed), reward"
    ):
        check_task(task)


@pytest.mark.parametrize(
    "code",
    [
        "\n    def outcome(self, measurement, unstable):\n        return self.ending(measurement)\n",
        "\n    def at(self, z):\n        return z + 1\n",
        "\n    def with_z(self, measured, z):\n        return z + 1\n",
    ],
)
def test_a_method_that_a_proof_takes_for_the_default_must_be_it(tmp_path, monkeypatch, code):
    task = task_of(methods(vehicle(), code), tmp_path, monkeypatch)
    name = code.split("def ")[1].split("(")[0]
    with pytest.raises(Unbounded, match=rf"methods of its own \({name}\)"):
        check_assumptions(task)


@pytest.mark.parametrize(
    "code",
    [
        "self.count = self.count + 1\n        ends[(self.count > 5) & (x > 1)] = Outcome.CRASHED",
        "ends[(x > 1) & (y >= y.max() - 0.1)] = Outcome.CRASHED",
    ],
)
def test_an_end_with_a_memory_is_refused(tmp_path, monkeypatch, code):
    task = task_of(ends(vehicle(), code), tmp_path, monkeypatch)
    with pytest.raises(
        BadInput, match=r"gives \d and then \d for the same row|methods change count"
    ):
        check_task(task)


@pytest.mark.parametrize(
    ("room", "code", "says"),
    [
        ("COUNT = [0]", "COUNT[0] += 1", "methods change COUNT when"),
        ("RNG = np.random.default_rng()", "RNG.random()", "methods change RNG when"),
        ("", "ends[np.random.random(len(x)) < 1e-9] = 2", "draw from a global generator"),
        (
            "WIDE = np.random.default_rng().uniform(0.3, 0.6)",
            "ends[(x - 1.5) ** 2 + y**2 <= WIDE] = Outcome.CRASHED",
            r"ending\(\) gives .* where .*py is executed once more",
        ),
    ],
)
def test_what_a_file_remembers_or_draws_is_refused(tmp_path, monkeypatch, room, code, says):
    monkeypatch.setattr(
        trapped_plants, "TASK", TASK.replace("class Robot", f"{room}\n\nclass Robot")
    )
    task = task_of(ends(vehicle(), code), tmp_path, monkeypatch)
    with pytest.raises(BadInput, match=says):
        check_task(task)


def test_a_file_that_registers_what_can_be_registered_once_is_taken(tmp_path, monkeypatch):
    room = "@hyrl_mj.register_noise\nclass Mine(hyrl_mj.Signal):\n    kind = 'of_a_task_file'\n"
    room += "    def sample(self, now):\n        return 0.0 * now.measurement\n"
    monkeypatch.setattr(
        trapped_plants, "TASK", TASK.replace("class Robot", f"{room}\n\nclass Robot")
    )
    monkeypatch.setattr(noise, "_KINDS", dict(noise._KINDS))
    trial.try_methods(task_of(vehicle(), tmp_path, monkeypatch))


BEARING = """
    def measure(self, sensors):
        x, y = sensors.T
        return np.stack([np.hypot(x + 1, y), np.arctan2(y, x + 1)], axis=1)

    def z(self, measured):
        r, b = measured.T
        return np.stack([r * np.cos(b) - 1, r * np.sin(b)], axis=1)

    def with_z(self, measured, z):
        return self.measure(z)
"""
# Robots that are not what they seem, and what is said of each: changes of the MJCF, and of the task's file.
SEEMING = {
    "a keyframe with a speed": (
        vehicle()._replace(kv=100),
        {"keyframe": '<keyframe><key qvel="0 0.8" ctrl="1 0"/></keyframe>'},
        {},
        r"keyframe in trapped_\d+_\d+.xml has velocities",
    ),
    "a circle with a stop": (
        dial()._replace(kv=1e6, on_joint='limited="true" range="-180 180"'),
        {"flag": ""},
        {},
        "periodic, and joint theta has a range",
    ),
    "an angle that hides more far away": (
        methods(ends(vehicle(), "ends = ends"), BEARING),
        {},
        {
            "ending": "x, y = self.z(measured).T\n        ends = np.full(len(x), Outcome.RUNNING)",
            "noisy": "(True, True)",
            "box": "(0.0, -0.1), (0.2, 0.1)",
        },
        "noise of 1 in the noisy columns moves the chart's x by 2",
    ),
}


@pytest.mark.parametrize("what", SEEMING)
def test_what_is_not_as_it_seems_is_refused(tmp_path, monkeypatch, what):
    robot, xml, py, says = SEEMING[what]
    robot = robot._replace(xml=robot.xml | xml, py=robot.py | py)
    with pytest.raises(BadInput, match=says):
        check_task(task_of(robot, tmp_path, monkeypatch))


def test_who_hovers_beside_a_small_goal_has_not_arrived(tmp_path, monkeypatch):
    end = "x, y = measured.T\n        ends = np.full(len(x), Outcome.RUNNING)\n"
    end += "        ends[np.hypot(x - 9, y) <= 0.02] = Outcome.REACHED"
    wide = '("x", "y"), ("m", "m"), (-5.0, -10.0), (15.0, 10.0), (False, False)'
    robot = vehicle()
    robot = robot._replace(py=robot.py | {"ending": end, "chart": wide, "goal": "[9.0, 0.0]"})
    task = task_of(robot, tmp_path, monkeypatch)
    assert task.tells_arrival
    assert task.verdict(np.array([[8.9, 0.1]])) == Outcome.STALLED


@pytest.mark.parametrize(
    ("name", "code"),
    [
        ("danger", "(self, measured):\n        return measured[:, 1] - measured[:, 1].mean()"),
        ("miss", "(self, z):\n        return 9 + z[:, 1] - z[:, 1].min()"),
        ("state", "(self, z, rng=None):\n        return z, z - z.mean(axis=0)"),
        ("direction", "(self, path):\n        return np.random.randint(0, 2, path.shape[1])"),
    ],
)
def test_a_method_that_looks_at_other_rows_is_refused(tmp_path, monkeypatch, name, code):
    task = task_of(methods(vehicle(), f"\n    def {name}{code}\n"), tmp_path, monkeypatch)
    with pytest.raises(BadInput, match=rf"{name}\(\) gives .* for the same row"):
        trial.try_methods(task)


def test_a_callback_is_a_memory(vehicle):
    from hyrl_mj.physics import memory

    assert memory.remembers(vehicle.model) == ""
    try:
        mujoco.set_mjcb_passive(lambda model, data: None)
        assert "callback" in memory.remembers(vehicle.model)
    finally:
        mujoco.set_mjcb_passive(None)


def test_hops_between_the_nodes_count(vehicle, monkeypatch):
    """A plant that moves some states farther, but no node."""
    from hyrl_mj.judging.proof import cells as module

    lattice = Lattice.tabulate(vehicle, Grid.with_cells(vehicle.chart, 60))
    plant = type(vehicle.plant(1))
    stepped = plant.step

    def step(self, u, ids=None):
        stepped(self, u, ids)
        z = self.qpos
        z[:, 1] += 1e-3 * ((z[:, 0] > 1.001) & (z[:, 0] < 1.024))
        self._qpos[:] = z

    monkeypatch.setattr(plant, "step", step)
    with pytest.raises(Unbounded, match="does not move all states alike"):
        module.Cells.cover(replace(lattice))
