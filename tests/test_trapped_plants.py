"""What is not as it seems is refused, left open, or right: robots with planted traps, each trap by itself."""

import mujoco
import numpy as np
import pytest
import trapped_plants
from trapped_plants import ROBOTS, TASK, dial, ends, examined, methods, task_of, vehicle

from hyrl_mj import BadInput
from hyrl_mj.judging.game import Lattice
from hyrl_mj.judging.proof import why_no_cells
from hyrl_mj.judging.proof.affine import Unbounded
from hyrl_mj.judging.proof.assumptions import check_assumptions
from hyrl_mj.judging.proof.cells import Cells
from hyrl_mj.physics import memory
from hyrl_mj.sets import Grid
from hyrl_mj.simulation import judge_task, noise
from hyrl_mj.tasks import Outcome, check_task, trial
from hyrl_mj.tasks.motion import begins_anew, stands_still


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:invalid value", "ignore:divide by zero")
@pytest.mark.parametrize("trap", ROBOTS)
def test_nothing_that_is_called_won_is_lost_in_mujoco(tmp_path, trap):
    assert examined(ROBOTS[trap], tmp_path).wrong == ()


@pytest.mark.slow
@pytest.mark.parametrize("trap", ["nothing", "nothing of a dial"])
def test_honest_robots_are_proved(tmp_path, trap):
    assert examined(ROBOTS[trap], tmp_path) == ("proved", ())


# ---- each trap by itself


@pytest.mark.parametrize("trap", ["delay", "filter"])
def test_a_servo_with_a_memory_is_not_kinematic(tmp_path, trap):
    task = task_of(ROBOTS[trap], tmp_path)
    assert not task.kinematic
    assert "larger state" in Lattice.why_not(task)
    with pytest.raises(Unbounded, match=r"histories of actuators|activations of actuators"):
        check_assumptions(task)


def test_a_mass_that_lags_is_not_kinematic(tmp_path):
    light = ROBOTS["lag"]._replace(xml=vehicle().xml | {"mass": "1"})
    for robot, kinematic in ((light, True), (ROBOTS["lag"], False)):
        task = task_of(robot, tmp_path)
        assert task.kinematic == task.chart_is_state == kinematic


@pytest.mark.parametrize(("stiffness", "still"), [("1", True), ("1e7", False)])
def test_what_a_spring_moves_is_not_run_backward(tmp_path, stiffness, still):
    task = task_of(ROBOTS["spring"]._replace(on_joint=f'stiffness="{stiffness}"'), tmp_path)
    assert task.kinematic
    assert stands_still(task) == still
    z, u = np.array([[0.5, 1.0]]), np.array([[0.5]])
    plant = task.placed(z)
    plant.step(u)
    plant.step_backward(u)
    assert (np.abs(plant.qpos - z).max() < 1e-3) == still


def test_a_saturated_servo_is_no_direct_one(tmp_path):
    assert not begins_anew(task_of(ROBOTS["weak servo"], tmp_path))
    strong = vehicle()._replace(kv=1e6, servo='forcerange="-1e9 1e9"')
    task = task_of(strong, tmp_path)
    why = why_no_cells(task, Grid.with_cells(task.chart, 60).counts)
    assert "the forcerange of actuator u" in why


@pytest.mark.filterwarnings("ignore:invalid value")
def test_an_end_by_nan_is_not_proved(tmp_path):
    task = task_of(ROBOTS["NaN"], tmp_path)
    cells = Cells.cover(Lattice.tabulate(task, Grid.with_cells(task.chart, 60)))
    x = cells.middle(np.arange(cells.nodes))[:, 0]
    assert cells.failed[(x > 1.1) & (x < 1.5)].all()


@pytest.mark.parametrize(
    "code",
    [
        "np.cos(3 * theta) > 2",
        "np.remainder(theta + 0.3, 2 * np.pi) > 9",
        "np.abs(self.chart.difference(measured, self.set_point))[:, 0] > 9",
        "np.abs(theta + 6 * np.pi - 1) < 1e-4",
    ],
)
def test_an_end_beyond_some_turns_is_told(tmp_path, code):
    task = task_of(ends(dial(), f"ends[{code}] = Outcome.CRASHED"), tmp_path)
    why = why_no_cells(task, Grid.with_cells(task.chart, 600).counts)
    if "1e-4" in code:
        assert "the method ending" in why
        assert "tells whole turns of theta apart" in why
    else:  # the same for all turns
        assert why is None


@pytest.mark.parametrize("corner", ["(2.9, 1.5)", "(3.0, 1.2)"])
def test_where_episodes_go_on_beyond_the_chart_the_game_does_not_decide(tmp_path, corner):
    """Before a goal line beyond it all would count as lost, and beside a corridor those who make room."""
    robot = vehicle()
    chart = robot.py["chart"].replace("(3.0, 1.5)", corner)
    task = task_of(robot._replace(py=robot.py | {"chart": chart}), tmp_path)
    why = why_no_cells(task, Grid.with_cells(task.chart, 60).counts)
    assert "goes on where a sample leads out of its chart, as at x = " in why


def test_a_method_that_a_proof_takes_for_the_default_must_be_it(tmp_path):
    with pytest.raises(Unbounded, match=r"methods of its own \(outcome\)"):
        check_assumptions(task_of(ROBOTS["outcome"], tmp_path))


# What is said of robots that are refused.
REFUSED = {
    "held sensor": r"sensor \(0\) of trapped_\d+ holds its value for 0.2 s",
    "late sensor": "is 0.1 s late, and the true state is taken from the sensors",
    "short sensor": "is measured as x = 2 m",
    "starts": r"of 4,000 starts that starts\(\) draws lie outside of its box, as",
    "a start that is over": r"[1-9] of 4,000 starts are over before they begin: .* is crashed",
    "mirror": r"mirror is no symmetry of it: x = .*\((running|crashed), reward",
    "count": r"gives \d and then \d for the same row|methods change count",
    "other rows": r"gives \d and then \d for the same row",
}


@pytest.mark.parametrize("trap", REFUSED)
def test_what_cannot_be_used_is_refused(tmp_path, trap):
    with pytest.raises(BadInput, match=REFUSED[trap]):
        check_task(task_of(ROBOTS[trap], tmp_path))


def in_file(monkeypatch, room):
    """Puts code before the class in the files of tasks."""
    code = TASK.replace("class Robot", f"{room}\n\nclass Robot")
    monkeypatch.setattr(trapped_plants, "TASK", code)


@pytest.mark.parametrize(
    ("room", "code", "says"),
    [
        ("COUNT = [0]", "COUNT[0] += 1", "methods change COUNT when"),
        ("RNG = np.random.default_rng()", "RNG.random()", "methods change RNG when"),
        ("import counting", "counting.COUNT[0] += 1", "methods change COUNT when"),
        ("from ticking import tick", "tick()", "methods change COUNT when"),
        ("K = itertools.count()", "next(K)", "methods change K when"),
        ("def tick(n=[0]):\n    n[0] += 1", "tick()", "change a default of tick when"),
        ("def tick():\n    tick.n += 1\n\n\ntick.n = 0", "tick()", "change n of tick when"),
        (
            "def made():\n    seen = deque()\n    return lambda x: seen.append(x.max())\n\n\nTICK = made()",
            "TICK(x)",
            "methods change seen of TICK when",
        ),
        (
            "def counted(f, seen=0):\n    @functools.wraps(f)\n    def g(x):\n        nonlocal seen\n"
            "        seen += 1\n        return f(x)\n    return g\n\n\nTICK = counted(lambda x: x)",
            "TICK(x)",
            "methods change seen of TICK when",
        ),
        (
            "class Low:\n    y = 0.0\n\n    def __call__(self):\n        self.y += 1\n\n\nLOW = Low()",
            "LOW()",
            "methods change y of LOW when",
        ),
        ("class Count:\n    n = 0", "Count.n += 1", "methods change n of Count when"),
        (
            "class A:\n    n = 0\n\n\nclass B:\n    a = A()\n\n\nROOM = B()",
            "ROOM.a.n += 1",
            "methods change n of a of (ROOM|B) when",
        ),
        ("KEPT = (np.zeros(1),)", "KEPT[0][0] += 1", "methods change 0 of KEPT when"),
        ("KEPT = SimpleNamespace(n=0)", "KEPT.n += 1", "methods change n of KEPT when"),
        (
            "def made():\n    n = 0\n    while True:\n        n += 1\n        yield n\n\n\nKEPT = made()",
            "next(KEPT)",
            "methods change n of KEPT when",
        ),
        ("", "ends[np.random.random(len(x)) < 1e-9] = 2", "draw from a global generator"),
        ("", "ends[(x > 1) & (np.random.default_rng().random(len(x)) < 0.02)] = 2", "the same row"),
        (
            "WIDE = np.random.default_rng().uniform(0.8, 1.2)",
            "ends[(x - 1.5) ** 2 + y**2 <= WIDE] = Outcome.CRASHED",
            r"ending\(\) gives .* where .*py is executed once more",
        ),
    ],
)
def test_what_a_file_remembers_or_draws_is_refused(tmp_path, monkeypatch, room, code, says):
    top = "import functools\nimport itertools\nfrom collections import deque\n"
    in_file(monkeypatch, f"{top}from types import SimpleNamespace\n{room}")
    for name in ("counting", "ticking"):
        text = "COUNT = [0]\n\n\ndef tick():\n    COUNT[0] += 1\n"
        (tmp_path / f"{name}.py").write_text(text)
    with pytest.raises(BadInput, match=says):
        check_task(task_of(ends(vehicle(), code), tmp_path))


BOOL = "    {}def ending({}measured):\n        return np.abs(measured[:, 1]) > 1\n"
WRONG = "gives bool from False to (False|True): give a hyrl_mj.Outcome"
NO_METHOD = "its ending is no method of its class, or was put there later"


@pytest.mark.parametrize(
    ("before", "inside", "after", "says"),
    [
        ("class Mixin:\n" + BOOL.format("", "self, "), "", "", WRONG),
        ("", BOOL.format("@staticmethod\n    ", ""), "", WRONG),
        ("", "    ending = functools.partialmethod(lambda self, m: m)\n", "", NO_METHOD),
        (
            "",
            "    def __init__(self):\n        self.ending = lambda m: m[:, 1] > 1\n",
            "",
            NO_METHOD,
        ),
        ("", "", "\nRobot.ending = lambda self, m: m[:, 1] > 1\n", NO_METHOD),
    ],
)
def test_a_method_from_elsewhere_is_looked_at_too(
    tmp_path, monkeypatch, before, inside, after, says
):
    own = TASK[TASK.index("    def ending") : TASK.index("    def direction")]
    text = TASK.replace("class Robot(", f"{before}\n\nclass Robot({'Mixin, ' * bool(before)}")
    text = text.replace(own, inside + own * ("self.ending" in inside or bool(after)))
    monkeypatch.setattr(trapped_plants, "TASK", "import functools\n" + text + after)
    with pytest.raises(BadInput, match=says):
        check_task(task_of(vehicle(), tmp_path))


def test_what_is_filled_once_or_anew_each_time_is_no_memory(tmp_path, monkeypatch):
    room = """
import functools
import math


@functools.wraps(math.hypot)  # which is no function of Python
def hypot(*sides):
    return math.hypot(*sides)


class Room:
    def __init__(self):
        self.known, self.last = {{}}, None

    def far(self, y):
        self.last = y
        return np.array([self.known.setdefault(round(float(v), 3), abs(v) > 1.4) for v in y])


ROOM = Room()
"""
    in_file(monkeypatch, room)
    trial.try_methods(task_of(ends(vehicle(), "ends[ROOM.far(y)] = Outcome.CRASHED"), tmp_path))


def test_a_file_that_registers_what_can_be_registered_once_is_taken(tmp_path, monkeypatch):
    room = "@hyrl_mj.register_noise\nclass Mine(hyrl_mj.Signal):\n    kind = 'of_a_task_file'\n"
    room += "    def sample(self, now):\n        return 0.0 * now.measurement\n"
    in_file(monkeypatch, room)
    monkeypatch.setattr(noise, "_KINDS", dict(noise._KINDS))
    trial.try_methods(task_of(vehicle(), tmp_path))


def test_a_measurement_in_single_precision_is_taken(tmp_path):
    single = "\n    def measure(self, sensors):\n        return sensors.astype(np.float32)\n"
    task = task_of(methods(vehicle(), single), tmp_path)
    assert task.measure(np.ones((3, 2))).dtype == float
    assert judge_task(task) == 50


GRID = """
    def starts(self, n, rng):
        return np.linspace(self.start_low, self.start_high, n)
"""
COUNTING = """
    def miss(self, z):
        return np.abs(z[:, 1])

    @property
    def close(self):
        type(self).count += 1
        return 0.3
"""
OTHER = """
    @property
    def model(self):
        if "_made" not in vars(self):
            spec = mujoco.MjSpec.from_file(str(self.model_path))
            spec.body("robot").mass = np.random.default_rng().uniform(1, 2)
            spec.body("robot").explicitinertial = True
            spec.body("robot").inertia = np.ones(3)
            self._made = spec.compile()
        return self._made
"""


@pytest.mark.parametrize(
    ("code", "says"),
    [
        (GRID, r"starts\(1\) gives x = 0 each time, and starts\(64\) others"),
        (COUNTING, "methods change count when"),
        (OTHER, "its model is another one where .* is executed once more"),
    ],
)
def test_starts_properties_and_models_that_are_not_the_same_are_refused(
    tmp_path, monkeypatch, code, says
):
    monkeypatch.setattr(trapped_plants, "TASK", "import mujoco\n" + TASK)
    with pytest.raises(BadInput, match=says):
        check_task(task_of(methods(vehicle(), code), tmp_path))


@pytest.mark.slow
@pytest.mark.parametrize("other", ["hash('wall') % 1_000 / 1_000", "0.0"])
def test_what_another_process_computes_otherwise_is_refused(tmp_path, other):
    robot = vehicle()
    robot = robot._replace(py=robot.py | {"observation": f"return measured + {other}"})
    task = task_of(robot, tmp_path)
    if other == "0.0":
        trial.try_elsewhere(task)
        return
    with pytest.raises(BadInput, match=r"observation\(\) gives .* in another process, where sets"):
        trial.try_elsewhere(task)


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
        r"keyframe in trapped_\d+.xml has velocities",
    ),
    "a circle with a stop": (
        dial()._replace(kv=1e6, on_joint='limited="true" range="-180 180"'),
        {"flag": ""},
        {},
        "periodic, and joint theta has a range",
    ),
    "an angle that is cut": (
        methods(
            dial()._replace(kv=1e6),
            "    def measure(self, sensors):\n        return sensors % (2 * np.pi)\n",
        ),
        {},
        {"chart": '("theta",), ("rad",), (0.0,), (2 * np.pi,), (False,)', "box": "(0.1,), (6.1,)"},
        r"theta leaps from \S+ to \S+ rad: say in the chart that it is periodic",
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
def test_what_is_not_as_it_seems_is_refused(tmp_path, what):
    robot, xml, py, says = SEEMING[what]
    robot = robot._replace(xml=robot.xml | xml, py=robot.py | py)
    with pytest.raises(BadInput, match=says):
        check_task(task_of(robot, tmp_path))


def test_who_hovers_beside_a_small_goal_has_not_arrived(tmp_path):
    end = "x, y = measured.T\n        ends = np.full(len(x), Outcome.RUNNING)\n"
    end += "        ends[np.hypot(x - 9, y) <= 0.02] = Outcome.REACHED"
    wide = '("x", "y"), ("m", "m"), (-5.0, -10.0), (15.0, 10.0), (False, False)'
    robot = vehicle()
    robot = robot._replace(py=robot.py | {"ending": end, "chart": wide, "goal": "[9.0, 0.0]"})
    task = task_of(robot, tmp_path)
    assert task.tells_arrival
    assert task.verdict(np.array([[8.9, 0.1]])) == Outcome.STALLED


@pytest.mark.parametrize(
    ("name", "code"),
    [
        ("danger", "(self, measured):\n        return measured[:, 1] - measured[:, 1].mean()"),
        ("miss", "(self, z):\n        return 9 + z[:, 1] - z[:, 1].min()"),
        ("measure", "(self, sensors):\n        return sensors - 1e-7 * sensors.mean(axis=0)"),
        ("state", "(self, z, rng=None):\n        return z, z - z.mean(axis=0)"),
        ("direction", "(self, path):\n        return np.random.randint(0, 2, path.shape[1])"),
    ],
)
def test_a_method_that_looks_at_other_rows_is_refused(tmp_path, name, code):
    task = task_of(methods(vehicle(), f"\n    def {name}{code}\n"), tmp_path)
    with pytest.raises(BadInput, match=rf"{name}\(\) gives .* for the same row"):
        trial.try_methods(task)


def test_a_callback_is_a_memory(vehicle):
    assert memory.remembers(vehicle.model) == ""
    try:
        mujoco.set_mjcb_passive(lambda model, data: None)
        assert "callback" in memory.remembers(vehicle.model)
    finally:
        mujoco.set_mjcb_passive(None)


def test_hops_between_the_nodes_count(vehicle, monkeypatch):
    """A plant that moves some states farther, but no node."""
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
        Cells.cover(lattice)
