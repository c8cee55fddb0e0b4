"""The batched closed loop equals plain ones, and its hybrid arcs live on hybrid time domains."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from matplotlib.figure import Figure
from planted import (
    ChartPolicy,
    circle_policy,
    euler,
    halves,
    ideal_controller,
    one_way_policy,
    sign_policy,
)

from hyrl_mj import (
    BadArtifact,
    BadInput,
    HybridArc,
    LoopSettings,
    Noise,
    Outcome,
    closed_loop,
    simulate,
    simulate_batch,
)
from hyrl_mj.judging.game import Game, worst_signal
from hyrl_mj.policies.controllers import PolicyController
from hyrl_mj.sets import Grid
from hyrl_mj.simulation import NOT_STARTED, Programmes, Rules
from hyrl_mj.stages.critical_set import find_critical_set
from hyrl_mj.tasks.unit_circle import UnitCircle

ALTERNATING = Noise("alternating", 0.1)


@pytest.fixture
def chattering(vehicle):
    """Flow sets so narrow that alternating noise makes the modes jump at every sample."""
    return ideal_controller(vehicle, overlap=0.02)


@pytest.fixture
def jumping_arc(vehicle, chattering):
    return simulate(vehicle, chattering, np.array([0.0, 0.01]), ALTERNATING, q0=0)


def vehicle_starts(n):
    return np.random.default_rng(0).uniform((0.0, -1.0), (0.5, 1.0), (n, 2))


# ---- plain twins


def formula_run(task, controller, z, q, bound):
    """One closed loop, sample by sample, by the paper's equation: path, modes, outcome."""
    path, modes = [z], []
    for k in range(task.max_steps):
        if task.ending(z[None])[0] != Outcome.RUNNING:
            break
        noise = (bound if k % 2 == 0 else -bound) * np.array(task.noisy)
        u, next_mode = controller.step(np.array([q]), (z + noise)[None])
        q = next_mode[0]
        z = euler(task, z[None], u)[0]
        path.append(z)
        modes.append(q)
    outcome = task.ending(z[None])[0]
    return np.array(path), modes, outcome or task.verdict(z[None])[0]


def cases(circle, vehicle):
    theta = np.random.default_rng(0).uniform(0, 2 * np.pi, (15, 1))
    return [
        (vehicle, ideal_controller(vehicle, 0.15), vehicle_starts(15)),
        (vehicle, PolicyController(sign_policy(vehicle)), vehicle_starts(15)),
        (circle, PolicyController(circle_policy(circle)), theta),
    ]


@pytest.mark.slow
def test_it_equals_the_formula_one_by_one(circle, vehicle):
    for task, controller, starts in cases(circle, vehicle):
        q0 = np.zeros(len(starts), dtype=int)
        rollout = closed_loop(
            task, controller, starts, ALTERNATING, q0=q0, settings=LoopSettings(record=True)
        )
        for i, start in enumerate(starts):
            path, modes, outcome = formula_run(task, controller, start, 0, 0.1)
            end = rollout.length[i]
            assert end == len(path) - 1
            np.testing.assert_allclose(rollout.path[: end + 1, i], path, rtol=0, atol=1e-6)
            np.testing.assert_array_equal(rollout.q[:end, i], modes)
            assert rollout.outcome[i] == outcome


def test_a_run_that_ended_stays_where_it_ended(vehicle):
    rollout = closed_loop(vehicle, PolicyController(sign_policy(vehicle)), vehicle_starts(50))
    assert len(set(rollout.length)) > 1
    for i, end in enumerate(rollout.length):
        rest = rollout.path[end:, i]
        np.testing.assert_array_equal(rest, np.broadcast_to(rest[0], rest.shape))


def test_backward_undoes_forward(vehicle):
    loop = PolicyController(one_way_policy(vehicle, clear=9.0))
    starts = vehicle_starts(20)
    forward = closed_loop(vehicle, loop, starts, settings=LoopSettings(steps=6))
    back = closed_loop(
        vehicle, loop, forward.path[-1], settings=LoopSettings(steps=6, backward=True)
    )
    np.testing.assert_allclose(back.path[-1], starts, atol=1e-6)
    assert (back.outcome == Outcome.RUNNING).all()


def test_a_policy_that_gives_nan_is_stopped_before_mujoco(vehicle):
    policy = ChartPolicy(vehicle, lambda z: np.where(z[:, :1] > 0.3, np.nan, 0.0))
    with pytest.raises(BadInput, match=r"simulation 1"):
        simulate(vehicle, policy, np.array([[0.0, 0.0], [0.1, 0.0]]))


# ---- what it is all about


def test_noise_leads_the_plain_policy_into_the_obstacle(vehicle):
    still = simulate(vehicle, sign_policy(vehicle), np.array([0.0, 0.0]))
    noisy = simulate(vehicle, sign_policy(vehicle), np.array([0.0, 0.0]), ALTERNATING)
    assert (still.outcome, noisy.outcome) == ("reached", "crashed")
    assert np.abs(noisy.z[:, 1]).max() < 0.06, "it dithers"
    assert noisy.controller == "policy"


def test_hysteresis_does_not_mind(vehicle):
    controller = ideal_controller(vehicle, 0.15)
    for q0 in (0, 1):
        arcs = simulate(vehicle, controller, np.array(vehicle.scene.starts), ALTERNATING, q0=q0)
        assert [arc.outcome for arc in arcs] == ["reached"] * 5
        assert max(arc.j[-1] for arc in arcs) <= 1
        assert arcs[0].controller == "hyrl"


def test_noise_stalls_the_plain_policy_on_the_circle(circle):
    start = np.array([np.pi])
    assert simulate(circle, circle_policy(circle), start).outcome == "reached"
    stalled = simulate(circle, circle_policy(circle), start, ALTERNATING, horizon=4.0)
    assert stalled.outcome == "stalled"
    assert np.abs(stalled.z - np.pi).max() < 0.11


# ---- hybrid arcs


def test_time_doubles_and_modes_change_exactly_where_j_rises(jumping_arc):
    dt, jump = np.diff(jumping_arc.t), np.diff(jumping_arc.j) == 1
    assert jumping_arc.j[-1] >= 5, "the case has jumps"
    assert (jumping_arc.t[0], jumping_arc.j[0]) == (0.0, 0)
    np.testing.assert_array_equal(jump, dt == 0)
    np.testing.assert_array_equal(~jump, dt > 0)
    np.testing.assert_allclose(dt[dt > 0], 0.05)
    np.testing.assert_array_equal(np.diff(jumping_arc.q) != 0, jump)
    before, after = np.flatnonzero(jump), np.flatnonzero(jump) + 1
    for values in (jumping_arc.z, jumping_arc.measured, jumping_arc.state):
        np.testing.assert_array_equal(values[before], values[after])
    assert np.isnan(jumping_arc.u[before]).all(), "a jump costs no time"
    assert np.isfinite(jumping_arc.u[after]).all()
    assert np.isnan(jumping_arc.u[-1]).all(), "the last row ends the arc"
    assert np.isnan(jumping_arc.measured[-1]).all()
    assert np.isfinite(jumping_arc.z[-1]).all()
    rows = ("t", "j", "z", "measured", "q", "u", "state")
    assert len({len(getattr(jumping_arc, name)) for name in rows}) == 1


def test_the_input_is_what_the_mode_says(jumping_arc, chattering):
    acts = np.flatnonzero(np.isfinite(jumping_arc.u[:, 0]))
    u, q = chattering.step(jumping_arc.q[acts], jumping_arc.measured[acts])
    np.testing.assert_array_equal(u, jumping_arc.u[acts])
    np.testing.assert_array_equal(q, jumping_arc.q[acts])


def test_the_kept_state_gives_the_scene_back_without_a_policy(jumping_arc, vehicle):
    data = mujoco.MjData(vehicle.model)
    signature = mujoco.mjtState.mjSTATE_INTEGRATION
    assert jumping_arc.state.shape[1] == mujoco.mj_stateSize(vehicle.model, signature)
    for row in (0, 7, -1):
        mujoco.mj_setState(vehicle.model, data, jumping_arc.state[row], signature)
        np.testing.assert_array_equal(data.qpos, jumping_arc.z[row])
        assert data.time == pytest.approx(jumping_arc.t[row])


def test_at_finds_the_last_row_of_a_time(jumping_arc):
    for t in (0.0, 0.05, 0.3):
        row = jumping_arc.at(t)
        assert jumping_arc.t[row] == pytest.approx(t)
        assert row == len(jumping_arc.t) - 1 or jumping_arc.t[row + 1] > t + 0.04
    assert jumping_arc.at(0.07) == jumping_arc.at(0.05)
    assert jumping_arc.at(99.0) == len(jumping_arc.t) - 1


def test_the_horizon_cuts_an_arc(circle):
    arc = simulate(circle, circle_policy(circle), np.array([2.0]), horizon=0.5)
    assert arc.t[-1] == pytest.approx(0.5)
    np.testing.assert_allclose(arc.z[:, 0], 2.0 - arc.t, atol=1e-6)
    assert arc.outcome == "stalled"


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["uniform", "adversarial", "worst", "attack"])
def test_some_runs_may_have_a_start_mode_and_others_pick_theirs(vehicle, kind):
    loop = ideal_controller(vehicle)
    starts = np.array([[0.0, 0.02], [0.0, -0.02], [0.1, 0.3], [0.0, 0.0]])
    modes = np.array([NOT_STARTED, 1, NOT_STARTED, 0])
    if kind == "worst":
        grid = Grid.with_cells(vehicle.chart, 60)
        noise = Game(vehicle, halves(vehicle), {"hyrl": loop}, 0.1, grid=grid).worst_noise(
            "hyrl", 0.1
        )
    elif kind == "attack":
        rules = Rules(vehicle, loop, 0.1, np.array([0.0, 1.0]))
        noise = Programmes(vehicle, loop, rules, np.zeros((4, 1), dtype=int), segment=5)
    else:
        noise = Noise(kind, 0.1)
    mixed = closed_loop(vehicle, loop, starts, noise, modes)
    own = closed_loop(vehicle, loop, starts, noise)
    given = closed_loop(vehicle, loop, starts, noise, np.array([0, 1, 0, 0]))
    for i, alone in enumerate((own, given, own, given)):
        assert mixed.q0[i] == alone.q0[i]
        assert mixed.outcome[i] == alone.outcome[i]
        n = mixed.length[i] + 1
        np.testing.assert_array_equal(mixed.path[:n, i], alone.path[:n, i])


def test_angles_are_not_wrapped(circle):
    arc = simulate(circle, circle_policy(circle), np.array([6.0]), horizon=1.0)
    assert np.abs(np.diff(arc.z[:, 0])).max() < 0.051
    assert arc.z[:, 0].max() > 2 * np.pi


class Phase(UnitCircle):
    """The circle, whose pointer is measured through an angle between -pi and pi."""

    def measure(self, sensors):
        return np.arctan2(np.sin(sensors), np.cos(sensors))


@pytest.mark.slow
def test_a_phase_that_passes_pi_is_not_wrapped_either(circle):
    phase, policy = Phase(), circle_policy(circle, critical=2.0)
    plain, arc = (simulate(task, policy, 2.5, horizon=3.0) for task in (circle, phase))
    np.testing.assert_allclose(arc.z, plain.z, atol=1e-12)
    assert arc.z.max() > np.pi > arc.z.min(), "it passes the seam"
    found = [find_critical_set(task, policy, 40, 0.1, "outcome") for task in (circle, phase)]
    np.testing.assert_allclose(*(critical.points for critical in found), atol=1e-9)
    # The worst noise is recorded as noise, not as noise and a turn.
    controllers = {"policy": PolicyController(policy)}
    grid = Grid.with_cells(phase.chart, 150)
    game = Game(phase, halves(circle), controllers, 0.3, grid=grid)
    signal = worst_signal(game, "policy", np.array([[3.0]]), 0.3)
    assert np.abs(signal.values).max() <= 0.3 + 1e-9


def test_one_start_gives_one_arc_and_several_a_list(vehicle):
    assert isinstance(simulate(vehicle, sign_policy(vehicle), np.zeros(2)), HybridArc)
    arcs = simulate(vehicle, sign_policy(vehicle), np.zeros((3, 2)))
    assert [type(arc) for arc in arcs] == [HybridArc] * 3
    (alone,) = simulate_batch(vehicle, sign_policy(vehicle), [0.0, 0.0])
    np.testing.assert_array_equal(alone.z, arcs[0].z)


# ---- an arc in a notebook


def test_a_short_repr_says_how_it_ended(jumping_arc, circle):
    assert repr(jumping_arc) == (
        f"HybridArc(vehicle, hyrl: crashed after {jumping_arc.t[-1]:.2f} s, {jumping_arc.j[-1]} jumps, "
        "alternating noise of 0.1)"
    )
    arc = simulate(circle, circle_policy(circle), [0.0], horizon=0.1)
    assert repr(arc) == "HybridArc(unit_circle, policy: reached after 0.10 s, 0 jumps, no noise)"


@pytest.mark.slow
def test_a_plot_shows_every_coordinate_by_mode_and_marks_the_jumps(jumping_arc, vehicle, tmp_path):
    figure = jumping_arc.plot()
    assert [panel.get_ylabel() for panel in figure.axes] == ["x [m]", "y [m]"]
    assert figure.axes[-1].get_xlabel() == "t [s]"
    jumps = jumping_arc.t[np.flatnonzero(np.diff(jumping_arc.j))]
    assert len(jumps) > 3
    for panel, z in zip(figure.axes, jumping_arc.z.T, strict=True):
        lines = [line for line in panel.lines if line.get_linestyle() == "-"]
        marks = [line.get_xdata()[0] for line in panel.lines if line.get_linestyle() == "--"]
        np.testing.assert_array_equal(marks, jumps)
        drawn = np.concatenate([line.get_xydata() for line in lines])
        np.testing.assert_array_equal(drawn, np.column_stack([jumping_arc.t, z]))
        assert {line.get_label(): line.get_color() for line in lines} == {
            "mode 0": "C0",
            "mode 1": "C1",
        }
    assert [text.get_text() for text in figure.axes[0].get_legend().texts] == ["mode 0", "mode 1"]
    figure.savefig(tmp_path / "arc.png")


def test_a_plot_goes_into_axes_of_the_user(jumping_arc):
    figure = Figure()
    axes = figure.subplots(2)
    assert jumping_arc.plot(axes) is figure
    assert [panel.get_ylabel() for panel in axes] == ["x [m]", "y [m]"]
    ax = Figure().subplots()
    assert jumping_arc.plot(ax) is ax.figure
    assert [text.get_text() for text in ax.texts] == ["x [m]", "y [m]"]
    for wrong in (3, [], Figure().subplots(3), [ax, None]):
        with pytest.raises(BadInput, match=r"give one of matplotlib's Axes, or 2, as those of"):
            jumping_arc.plot(wrong)


def test_a_policy_has_no_mode_in_a_plot(jumping_arc):
    figure = replace(jumping_arc, controller="policy").plot()
    assert [text.get_text() for text in figure.axes[0].get_legend().get_texts()] == ["policy"]
    assert {line.get_color() for line in figure.axes[0].get_lines()[:2]} == {"0.2"}


def test_a_plot_does_without_the_task(jumping_arc):
    foreign = replace(jumping_arc, task="a robot of somebody's")
    assert [panel.get_ylabel() for panel in foreign.plot().axes] == ["z[0]", "z[1]"]


def test_a_start_that_is_over_already(vehicle):
    arc = simulate(vehicle, ideal_controller(vehicle), np.array([1.5, 0.0]), q0=1)
    assert arc.outcome == "crashed"
    assert (arc.t.tolist(), arc.j.tolist(), arc.q.tolist()) == ([0.0], [0], [1])
    assert arc.q.dtype.kind == "i"
    assert arc.j.dtype.kind == "i"


def test_an_arc_comes_back_from_disk(jumping_arc, tmp_path):
    jumping_arc.save(tmp_path / "arc.npz")
    back = HybridArc.load(tmp_path / "arc.npz")
    for name, values in vars(jumping_arc).items():
        np.testing.assert_array_equal(getattr(back, name), values)
        assert type(getattr(back, name)) is type(values)
    (tmp_path / "arc.npz").write_bytes((tmp_path / "arc.npz").read_bytes()[:-100])
    with pytest.raises(BadArtifact, match=r"arc\.npz"):
        HybridArc.load(tmp_path / "arc.npz")


# ---- noise


def signals(arcs):
    """The noise that each arc met, one row a sample."""
    return [(arc.measured - arc.z)[np.isfinite(arc.u[:, 0])] for arc in arcs]


def test_two_controllers_meet_the_same_noise(vehicle):
    starts, noise = vehicle_starts(8), Noise("uniform", 0.1)
    first = simulate(vehicle, sign_policy(vehicle), starts, noise, seed=3)
    second = simulate(vehicle, ideal_controller(vehicle), starts, noise, q0=1, seed=3)
    for a, b in zip(signals(first), signals(second), strict=True):
        common = min(len(a), len(b))
        assert common > 10
        np.testing.assert_allclose(a[:common], b[:common], atol=1e-12)


# ---- bad input


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"horizon": 0}, "horizon 0 s .*time > 0"),
        ({"horizon": np.nan}, "horizon nan s .*time > 0"),
        ({"horizon": np.inf}, "horizon inf s .*time > 0"),
        ({"z0": [0.0, 2.0]}, r"y = 2 m\) is outside vehicle"),
        ({"z0": np.zeros(3)}, "vehicle is 2 number"),
        ({"z0": np.zeros((0, 2))}, "no start is given"),
        ({"q0": 2}, r"mode 2 is unknown: choose one of \(0, 1\)"),
        ({"q0": 0.5}, r"mode 0.5 is unknown: choose one of \(0, 1\)"),
        ({"z0": np.zeros((3, 2)), "q0": np.array([0, 1])}, r"\(2,\)"),
    ],
)
def test_what_cannot_be_simulated_is_refused(vehicle, options, says):
    with pytest.raises(BadInput, match=says):
        simulate(vehicle, ideal_controller(vehicle), **{"z0": np.zeros(2), **options})
