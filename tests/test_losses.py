"""Why starts are lost: indecision that holding the way cures, or passing closer than the noise."""

from types import SimpleNamespace

import numpy as np
import pytest
from planted import ChartPolicy, halves, pass_on, sign_policy

from hyrl_mj import simulate
from hyrl_mj.judging.game import NEVER, Game
from hyrl_mj.policies import PolicyController
from hyrl_mj.runs.diagnosis import losses_of, losses_sentence
from hyrl_mj.sets import Grid

EPS, CELLS = 0.1, 120


def sorted_losses(task, policy):
    settings = SimpleNamespace(eps=EPS, lattice=CELLS)
    run = SimpleNamespace(
        task=task, steady=policy, partition=halves(task), settings=settings, exact=True
    )
    return losses_of(run)


def lost_by(task, policy):
    grid = Grid.with_cells(task.chart, CELLS)
    game = Game(task, halves(task), {"policy": PolicyController(policy)}, EPS, grid=grid)
    own = game.value("policy", EPS)[-1, :-2]
    return grid.nodes[game.starts & game.winnable(EPS) & (own >= NEVER)]


def grazing_policy(task):
    """Goes left everywhere, and passes the pillar by less than the noise."""
    return ChartPolicy(task, lambda z: pass_on(1.0, z[:, 1], 0.76))


@pytest.mark.slow
def test_a_policy_that_only_cannot_decide_is_cured_by_hysteresis(vehicle):
    policy = sign_policy(vehicle)
    losses = sorted_losses(vehicle, policy)
    assert len(losses.undecided) == len(lost_by(vehicle, policy)) > 20
    assert not len(losses.grazing)
    assert not len(losses.unaided)
    assert np.abs(losses.undecided[:, 1]).max() <= 3 * EPS, "around the axis"
    assert "(100%: noise at M* keeps it undecided, hysteresis cures that)" in losses_sentence(
        losses
    )


def test_a_policy_that_passes_too_close_is_not(vehicle):
    policy = grazing_policy(vehicle)
    losses = sorted_losses(vehicle, policy)
    sizes = [len(z) for z in (losses.unaided, losses.undecided, losses.grazing)]
    assert sum(sizes) == len(lost_by(vehicle, policy))
    assert sizes[2] > 5 * sizes[1]
    assert "it passes closer than the noise" in losses_sentence(losses)
    # Right of the pillar it has no room to turn left: what it loses there it loses by itself.
    assert (
        f"it loses {sizes[0]:,} without noise, too (46%: it fails there by itself"
        in losses_sentence(losses)
    )
    for z, outcome in ((losses.unaided, "crashed"), (losses.grazing, "reached")):
        assert {arc.outcome for arc in simulate(vehicle, policy, z[:: len(z) // 100])} == {outcome}


def test_a_policy_that_stands_still_fails_without_noise(circle):
    policy = ChartPolicy(circle, lambda z: np.zeros((len(z), 1)))
    losses = sorted_losses(circle, policy)
    assert len(losses.unaided) == len(lost_by(circle, policy)) > 5
    assert not len(losses.undecided)
    assert not len(losses.grazing)
    said = losses_sentence(losses)
    assert said.startswith(
        f"it loses all {len(losses.unaided)} lost nodes without noise, too: it fails"
    )
    assert "closer than the noise" not in said
