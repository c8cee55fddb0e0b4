"""Which starts are simulated under which noise, and what a replay shows of them."""

from types import SimpleNamespace

import numpy as np
import pytest
from planted import decisions, halves, ideal_controller, sign_policy

from hyrl_mj import BadArtifact, BadInput, HybridArc, Run
from hyrl_mj.learning.presets import preset
from hyrl_mj.policies.controllers import PolicyController
from hyrl_mj.runs.arcs import noisy_arcs, replay_arcs
from hyrl_mj.viz.shows import replay_shows


@pytest.fixture(scope="module")
def run(vehicle):
    """A run of the vehicle with planted controllers, as far as arcs are concerned."""
    policy, controller = sign_policy(vehicle), ideal_controller(vehicle, clear=1.004)
    return SimpleNamespace(
        task=vehicle,
        settings=SimpleNamespace(eps=0.1, seed=0, lattice=240),
        controller=controller,
        controllers={"policy": PolicyController(policy), "hyrl": controller},
        critical_set=decisions(vehicle),
        split=halves(vehicle),
        why_no_game=None,
        exact=True,
        policy_title="RL policy (DQN)",
        extended_sets=SimpleNamespace(modes=(0, 1)),
    )


@pytest.mark.slow
def test_the_starts_are_the_paper_s_and_one_on_the_critical_set_that_is_lost(run, monkeypatch):
    arcs = replay_arcs(run)
    names = ["start0", "start1", "start2", "start3", "start4", "critical"]
    assert list(dict.fromkeys(start for start, _ in arcs)) == names
    found = np.array([arcs[name, "policy"].z[0] for name in names])
    np.testing.assert_array_equal(found[:5], run.task.scene.starts)
    np.testing.assert_allclose(found[5], [0, 0])
    assert arcs["critical", "policy"].outcome == "crashed"
    # The nearest point of M* is left for one from which the policy is lost.
    arrives = HybridArc.arrives
    monkeypatch.setattr(
        HybridArc, "arrives", lambda arc, task: arc.z[0][0] == 0 or arrives(arc, task)
    )
    beyond = replay_arcs(run)["critical", "policy"]
    assert 0 < beyond.z[0][0] < 0.2
    assert beyond.outcome == "crashed"


def test_all_controllers_meet_the_noise_that_was_asked_for(run):
    z0 = np.array([[0.0, 0.05], [0.0, -0.3]])
    arcs = noisy_arcs(run, z0, "uniform", 0.07, (0, 1), seed=5)
    assert list(arcs) == ["policy", "hyrl_q0", "hyrl_q1"]
    noise = [(arc.measured - arc.z)[:15, 1] for several in arcs.values() for arc in several]
    for other in noise[2::2]:
        np.testing.assert_allclose(other, noise[0], atol=1e-9)
    assert 0.02 < np.abs(noise[0]).max() <= 0.07 + 1e-9
    assert {arc.bound for several in arcs.values() for arc in several} == {0.07}
    assert [arc.q[0] for arc in arcs["hyrl_q1"]] == [1, 1]
    chosen = noisy_arcs(run, z0, "none")["hyrl"]
    assert [arc.q[0] for arc in chosen] == [0, 1]


@pytest.mark.slow
def test_the_worst_noise_is_each_controller_s_own(run):
    arcs = noisy_arcs(run, np.array([[0.1, 0.05]]), "worst", None, (0, 1))
    (policy,) = arcs["policy"]
    assert (policy.outcome, policy.noise, policy.bound) == ("crashed", "worst", 0.1)
    for q in (0, 1):
        (arc,) = arcs[f"hyrl_q{q}"]
        assert arc.outcome == "reached"
        assert not np.allclose(arc.measured[5:12] - arc.z[5:12], (policy.measured - policy.z)[5:12])


def test_the_worst_noise_lasts_as_long_as_the_run_and_keeps_the_bound_that_was_asked_for(run):
    (arc,) = noisy_arcs(run, np.array([[0.0, 0.3]]), "worst", 0.13, horizon=1.5)["hyrl"]
    assert (arc.bound, len(arc.t)) == (0.13, 31)
    assert (np.abs(arc.measured - arc.z)[:-1, 1] > 0.1).all()


@pytest.mark.slow
def test_shows_are_one_for_each_mode_or_all_of_the_paper_s_at_once(run):
    arcs = replay_arcs(run)
    assert len(arcs) == 6 * 3
    # The start on M* meets the strongest noise that is known for each controller.
    assert {arc.noise for (start, _), arc in arcs.items() if start != "critical"} == {"alternating"}
    assert {arc.noise for (start, _), arc in arcs.items() if start == "critical"} == {"worst"}
    assert arcs["critical", "policy"].outcome == "crashed"
    assert {arcs["critical", f"hyrl_q{q}"].outcome for q in (0, 1)} == {"reached"}
    shows = replay_shows(run, "critical", "none")
    assert [show.hybrid[0].q[0] for show in shows] == [0, 1]
    assert all(len(show.policy) == len(show.hybrid) == 1 for show in shows)
    (paper,) = replay_shows(run, "paper", "alternating")
    assert (len(paper.policy), len(paper.hybrid)) == (5, 10)
    starts = np.array([arc.z[0] for arc in paper.hybrid])
    np.testing.assert_allclose(starts, np.repeat(run.task.scene.starts, 2, axis=0))
    np.testing.assert_array_equal(paper.policy[3].z, arcs["start3", "policy"].z)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("mine",), "unknown starts 'mine'"),
        (("paper", "white"), "unknown noise 'white'.*worst"),
        (("paper", "uniform", 2.0), "hides the whole state space"),
        (("latest", "uniform"), "the latest simulation has its noise"),
    ],
)
def test_what_cannot_be_shown(run, arguments, message):
    with pytest.raises(BadInput, match=message):
        replay_shows(run, *arguments)


def test_an_arc_of_another_task_is_refused(run, circle, tmp_path):
    (arc,) = noisy_arcs(run, np.array([[0.0, 0.3]]), "none")["policy"]
    other, path = Run(tmp_path, preset(circle, "smoke")), tmp_path / "arcs" / "start0_policy.npz"
    with other.manifest.stage("simulate"):
        arc.save(path)
    with pytest.raises(BadArtifact, match=r"npz is an arc of vehicle, .* a run of unit_circle"):
        other.arc(path)
    with pytest.raises(BadArtifact, match=r"mine.npz is no file that a run writes"):
        other.arc(path.with_name("mine.npz"))
