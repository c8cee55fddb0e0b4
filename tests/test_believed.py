"""Noise, controllers and task files that are something else than they seem are refused, or left open."""

import dataclasses

import numpy as np
import pytest
from test_certificate import linear
from test_checks import PY as PYTHON, XML, changed
from test_truer_tasks import FLIPPED, PY, write
from trapped_plants import dial, task_of

from hyrl_mj import BadInput, HybridController, Noise, get_task, simulate
from hyrl_mj.judging.game import Lattice
from hyrl_mj.judging.proof.affine import Affine, Unbounded
from hyrl_mj.judging.proof.answers import BoundedAnswers
from hyrl_mj.judging.proof.cells import Cells
from hyrl_mj.judging.proof.rules import bounds
from hyrl_mj.policies import MlpPolicy, PolicyController
from hyrl_mj.sets import Everything, Grid
from hyrl_mj.simulation import Signal, noise as noises
from hyrl_mj.tasks import check_task
from hyrl_mj.tracing import BATCH, trace

# ---- noise


def louder(self, now):
    self.bound = 0.1 * (1 + now.k.max())
    return np.full(now.measurement.shape, self.bound) * self.shares


def on_all(self, now):
    self.shares[:] = 1.0
    return np.full(now.measurement.shape, self.bound)


def begun_louder(self, n, rng):
    Signal.reset(self, n, rng)
    self.bound *= 10


def full(self, now):
    return np.full(now.measurement.shape, self.bound) * self.shares


@pytest.mark.parametrize(
    "own", [{"sample": louder}, {"sample": on_all}, {"sample": full, "reset": begun_louder}]
)
def test_noise_cannot_widen_its_own_bound(own, vehicle, monkeypatch):
    kind = type("Own", (Signal,), {"kind": "own", "sample": full} | own)
    monkeypatch.setitem(noises._KINDS, "own", kind)
    policy = linear(vehicle, np.zeros((5, 3)), np.zeros(5))
    with pytest.raises(
        BadInput, match=r"as its largest magnitudes at sample \d and had \[.* 0\.1\]"
    ):
        simulate(vehicle, policy, [0.0, 0.5], Noise("own", 0.1))


# ---- controllers: a proof follows the package's own classes, not what inherits from them


class Opposite(MlpPolicy):
    def act(self, measured):
        return -super().act(measured)


def opposite(policy):
    fields = (f.name for f in dataclasses.fields(policy) if f.init)
    return Opposite(**{name: getattr(policy, name) for name in fields})


class Lazy(PolicyController):
    def step(self, q, measured):
        u, q = super().step(q, measured)
        return 0 * u, q


class Stubborn(HybridController):
    def step(self, q, measured):
        return super().step(q, measured)[0], q


class Nowhere(Everything):
    def signed_distance(self, z):
        return np.ones(len(z))


def as_hybrid(task, policy, kind=HybridController, members=Everything):
    return kind(task, {0: policy}, {0: members()})


@pytest.fixture(scope="module")
def cells(circle):
    return Cells.cover(Lattice.tabulate(circle, Grid.with_cells(circle.chart, 600)))


@pytest.mark.parametrize(
    ("controller", "name"),
    [
        (PolicyController, None),
        (lambda policy: as_hybrid(policy.task, policy), None),
        (Lazy, "Lazy"),
        (lambda policy: as_hybrid(policy.task, policy, Stubborn), "Stubborn"),
        (lambda policy: as_hybrid(policy.task, policy, members=Nowhere), "Nowhere"),
        (lambda policy: PolicyController(opposite(policy)), "Opposite"),
    ],
)
def test_a_class_that_acts_otherwise_is_not_proved(controller, name, circle, cells):
    loop = controller(linear(circle, [[0.0, -3.0]], [0.0]))
    if name is None:
        assert BoundedAnswers.enclose(cells, loop, np.array([0.05])).shifts
        return
    with pytest.raises(Unbounded, match=f"a .*{name} cannot be bounded"):
        BoundedAnswers.enclose(cells, loop, np.array([0.05]))


def test_the_observation_of_another_task_is_looked_at_too(tmp_path):
    seen = "return np.hstack([np.cos(measured), np.sin(measured / 2)])"
    robots = [dial(), dial()._replace(py=dial().py | {"observation": seen})]
    tasks = [task_of(robot, tmp_path) for robot in robots]
    chart = tasks[0].chart
    dials = Cells.cover(Lattice.tabulate(tasks[0], Grid.with_cells(chart, 600)))
    loop = PolicyController(linear(tasks[1], [[0.0, -3.0]], [0.0]))
    with pytest.raises(Unbounded, match=r"observation of .* tells whole turns of theta apart"):
        BoundedAnswers.enclose(dials, loop, np.array([0.05]))


def test_small_numbers_of_half_precision_are_rounded_more():
    program = trace(lambda x: (1e-6 * x).astype(np.float16), {"x": np.ones((BATCH, 1))}, "it")
    centre, half = np.linspace(-1, 1, 400)[:, None], np.array([1e-4])
    found = bounds(program, Affine.box(centre, half))
    values = (1e-6 * centre).astype(np.float16).astype(float)
    assert ((found.low <= values) & (values <= found.high)).all()


# ---- task files


def method(head, answer):
    return {"methods": f"    def {head}:\n        return {answer}\n"}


OTHER_ORDER = {
    "methods": FLIPPED + method("measure(self, sensors)", "sensors[:, ::-1]")["methods"],
    "ending": PY["ending"].replace("x, y =", "y, x ="),
}


@pytest.mark.parametrize(
    ("own", "message"),
    [
        ({"methods": "    dt = 0.1\n"}, "it defines dt, which hyrl_mj computes"),
        ({"methods": "    obstacles = {}\n"}, "it defines obstacles, which hyrl_mj computes"),
        (method("failed(self, measured)", "measured[:, 0] > 1"), "defines failed, which hyrl_mj"),
        (method("noise_in_chart(self, *given)", "np.zeros(2)"), "defines noise_in_chart, which"),
        (
            {"methods": "    sensors = 'uniform 0.1'\n"},
            "defines sensors, which nothing uses: if sensor is meant",
        ),
        (method("verdicts(self, m)", "0 * m[:, 0]"), "if verdict is meant"),
        (method("with_z(self, measured, z)", "measured"), r"with_z\(\) and z\(\) do not belong"),
        (
            {"measured": "observation * 2"},
            r"measured\(\) is not the inverse of observation\(\): observation\[",
        ),
        (OTHER_ORDER, "moves the chart's x by 1, and its share in noisy is 0"),
        (
            method("starts(self, n, rng)", "np.random.uniform(0, [0.4, 1], (n, 2))"),
            "draws other starts from a generator of the same seed",
        ),
    ],
)
def test_methods_that_are_not_what_they_seem_are_refused(own, message, tmp_path):
    with pytest.raises(BadInput, match=message):
        check_task(get_task(write(tmp_path, own)))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"sample_time"', '"sampletime"', "the numeric sampletime .* is called sample_time"),
        (
            ' joint="x"/>',
            ' joint="x" noise="0.05"/>',
            r"has noise=0\.05, which MuJoCo adds nowhere",
        ),
    ],
)
def test_what_mujoco_does_not_use_is_refused(old, new, message, tmp_path):
    path = write(tmp_path, text=lambda xml: xml.replace(old, new))
    with pytest.raises(BadInput, match=message):
        check_task(get_task(path))


SWAPPED = (XML, r'name="x"(.*)"1 0 0"/>\n(.*)"0 1 0"', r'name="x"\1"0 1 0"/>\n\2"1 0 0"')


@pytest.mark.slow
@pytest.mark.parametrize(
    "edit",
    [
        SWAPPED,
        (PYTHON, "max_steps = 70", "max_steps = 70\n    plane = (0, 2)"),
    ],
)
def test_a_chart_that_begins_with_another_place_is_refused(edit, tmp_path):
    task = changed(tmp_path, edit, (PYTHON, r"mirror = Mirror\(.*\)", "mirror = None"))
    with pytest.raises(
        BadInput, match="begins with x and y, and these are not the place of tracked"
    ):
        check_task(task)


@pytest.mark.slow
@pytest.mark.parametrize("code", ["100 * measured[:, :2]", "measured[:, 1::-1]"])
def test_places_that_are_not_on_the_robot_are_refused(code, tmp_path):
    where = f"def where(self, measured):\n        return {code}\n\n    def miss"
    task = changed(tmp_path, (PYTHON, "def miss", where))
    with pytest.raises(BadInput, match=r"where\(\) gives .*, and tracked is at"):
        check_task(task)
