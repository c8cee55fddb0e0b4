"""Training improves the policy in seconds, is reproducible, and leaves logs and checkpoints."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from planted import ideal_controller, one_way_policy

from hyrl_mj import BadInput, MlpPolicy, Noise, training
from hyrl_mj.envs.core import BatchedEnv, Domain, cautious_reward
from hyrl_mj.extended_sets import ExtendedSets
from hyrl_mj.retraining import ModeGround
from hyrl_mj.sets import Grid, GridSet
from hyrl_mj.settings import preset

# Samples of the quickest training that still updates the networks several times.
FEW = {"ppo": 8_192, "dqn": 4_000}


@pytest.fixture
def quick(task):
    return replace(preset(task, "smoke").stage1, samples=FEW[task.algorithm])


@pytest.fixture(scope="module")
def smoke(task, tmp_path_factory):
    """The smoke preset, trained with logs: the policy and its log folder."""
    logs = tmp_path_factory.mktemp(task.name)
    return training.train(task, preset(task, "smoke").stage1, seed=0, log_dir=logs), logs


def assert_same_weights(a, b):
    assert a.weights.keys() == b.weights.keys()
    for name in a.weights:
        np.testing.assert_array_equal(a.weights[name], b.weights[name], err_msg=name)


def untrained(task):
    return training.export(training.build(task, preset(task, "smoke").stage1, seed=0), task)


def test_training_returns_the_best_policy_that_it_met(task, monkeypatch):
    """Whatever the evaluations say, the policy with the highest score comes back."""
    scores, policies = iter([(0.5, 3.0), (0.9, -1.0), *[(0.9, -2.0)] * 100]), []

    def scripted(task, policy, *_):
        policies.append(policy)
        return next(scores)

    monkeypatch.setattr(training, "evaluate", scripted)
    best = training.train(task, preset(task, "smoke").stage1, seed=0)
    assert len(policies) > 2
    assert best is policies[1]


def test_ppo_learns_the_circle_with_the_smoke_preset(circle):
    policy = training.train(circle, preset(circle, "smoke").stage1, seed=0)
    before = training.evaluate(circle, untrained(circle), Noise())[1]
    assert training.evaluate(circle, policy, Noise())[1] > before + 10


def test_dqn_learns_the_vehicle_with_some_more_samples(vehicle):
    settings = replace(preset(vehicle, "smoke").stage1, samples=40_000)
    policy = training.train(vehicle, settings, seed=0)
    assert training.evaluate(vehicle, policy, Noise())[1] > 85


def test_it_writes_the_latest_checkpoint_and_tensorboard_logs(smoke):
    policy, logs = smoke
    checkpoint = MlpPolicy.load(logs / "checkpoint.safetensors")
    assert {n: w.shape for n, w in checkpoint.weights.items()} == {
        n: w.shape for n, w in policy.weights.items()
    }
    events = list((logs / "tensorboard").glob("events.out.tfevents.*"))
    assert events
    assert events[0].stat().st_size > 200


def test_without_a_log_folder_nothing_is_written(task, quick, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    training.train(task, quick, seed=0)
    assert not any(tmp_path.iterdir())


def test_the_seed_fixes_every_weight(task, quick):
    first = training.train(task, quick, seed=4)
    assert_same_weights(first, training.train(task, quick, seed=4))
    other = training.train(task, quick, seed=5)
    assert any(not np.array_equal(first.weights[n], other.weights[n]) for n in first.weights)


def test_threads_of_the_physics_do_not_matter(task, quick, monkeypatch):
    policies = []
    for threads in (1, 2):
        monkeypatch.setattr(training, "BatchedEnv", partial(BatchedEnv, threads=threads))
        policies.append(training.train(task, quick, seed=4, noise=Noise("uniform", 0.1)))
    assert_same_weights(*policies)


@pytest.mark.parametrize("fails", [False, True])
def test_torch_gets_its_threads_back(fails):
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        with pytest.raises(KeyError) if fails else training.single_threaded():
            if fails:
                with training.single_threaded():
                    raise KeyError
            assert torch.get_num_threads() == 1
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


def test_training_restores_torchs_threads(vehicle):
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        settings = replace(preset(vehicle, "smoke").stage1, samples=2_500)
        training.train(vehicle, settings, seed=0)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


def test_it_goes_on_from_a_policy(task):
    start = untrained(task)
    settings = preset(task, "paper").stage6
    model = training.build(task, settings, seed=1, start_from=start)
    assert_same_weights(training.export(model, task), start)


def test_an_unknown_algorithm_lists_the_known(vehicle):
    settings = replace(preset(vehicle, "smoke").stage1, algorithm="sac")
    with pytest.raises(BadInput, match="unknown algorithm 'sac': choose one of ppo, dqn"):
        training.build(vehicle, settings, 0)


# ---- returns


def test_evaluation_of_a_known_policy(circle):
    """A policy that never moves: 150 times the reward of its start, or the discounted sum."""
    policy = untrained(circle)
    still = replace(policy, weights={n: 0 * w for n, w in policy.weights.items()})
    starts = Domain(lambda n, rng: np.full((n, 1), 1.0), lambda z: np.full(len(z), True), -1.0)
    for gamma, factor in ((1.0, 150), (0.9, (1 - 0.9**150) / 0.1)):
        success, value = training.evaluate(circle, still, Noise(), starts, gamma, episodes=4)
        assert success == 0
        assert value == pytest.approx(-factor / np.pi, rel=1e-6)


# ---- where modes are trained


@pytest.fixture(scope="module")
def vehicle_sets(vehicle):
    grid = Grid.with_cells(vehicle.chart, 60)
    ideal = ideal_controller(vehicle, 0.15)
    sets = tuple(GridSet(grid, ideal.flow_set(q).signed_distance(grid.nodes)) for q in (0, 1))
    winning = tuple(grid.nodes[:, 0] < 0.4 for _ in sets)
    return ExtendedSets((0, 1), sets, winning, 0.3, 0.1, np.empty((0, 2)), np.empty(0))


def test_mode_starts_cover_the_set_with_room_for_the_noise(vehicle, vehicle_sets):
    domain = ModeGround(vehicle, vehicle_sets, 0).domain(gamma=0.9)
    z = domain.starts(5000, np.random.default_rng(0))
    cell = vehicle_sets.sets[0].grid.cell
    assert vehicle.chart.contains(z).all()
    assert -0.25 - cell <= z[:, 1].min() <= -0.2
    assert z[:, 1].max() > 1.4
    assert z[:, 0].max() <= 0.4 + cell
    again = domain.starts(5000, np.random.default_rng(0))
    np.testing.assert_array_equal(z, again)


def test_a_mode_that_leaves_its_set_pays_for_ever(vehicle, circle, vehicle_sets):
    domain = ModeGround(vehicle, vehicle_sets, 1).domain(gamma=0.9)
    inside = domain.contains(np.array([[0.1, 0.22], [0.1, 0.28], [0.1, -1.0]]))
    np.testing.assert_array_equal(inside, [True, False, True])
    assert domain.exit_reward == 0.0
    grid = Grid.with_cells(circle.chart, 60)
    whole = GridSet.from_mask(grid, np.ones(60, dtype=bool))
    sets = ExtendedSets((0,), (whole,), (whole.mask,), 0.5, 0.1, np.empty((0, 1)), np.empty(0))
    assert ModeGround(circle, sets, 0).domain(gamma=0.9).exit_reward == pytest.approx(-10.0)


# ---- the judge of stage 6


def test_a_cautious_reward_is_the_least_around(vehicle):
    rng = np.random.default_rng(0)
    measured = rng.uniform([0.1, -1.3], [2.9, 1.3], (200, 2))
    worst = cautious_reward(vehicle, measured, np.array([0.0, 0.1]))
    for shift in (-0.1, -0.05, 0.0, 0.05, 0.1):
        state = measured + np.array([0.0, shift])
        crashed = vehicle.clearance(state) <= 1e-3
        assert (worst <= np.where(crashed, 0.0, vehicle.reward(state)) + 1e-12).all()
    np.testing.assert_array_equal(
        cautious_reward(vehicle, measured, np.zeros(2)),
        np.where(vehicle.clearance(measured) <= 1e-3, 0.0, vehicle.reward(measured)),
    )
    # Within the noise of the pillar there is nothing to earn.
    assert cautious_reward(vehicle, np.array([[1.5, 0.84]]), np.array([0.0, 0.1]))[0] == 0.0


@pytest.fixture(scope="module")
def left(vehicle):
    """The ground of the vehicle's mode 0 with ideal sets, where they can be won."""
    grid = Grid.with_cells(vehicle.chart, 120)
    ideal = ideal_controller(vehicle, 0.15)
    sets = tuple(GridSet(grid, ideal.flow_set(q).signed_distance(grid.nodes)) for q in (0, 1))
    open_ = grid.nodes[:, 1] > -(0.4 - grid.nodes[:, 0])
    found = ExtendedSets((0, 1), sets, (open_, ~open_), 0.3, 0.1, np.empty((0, 2)), np.empty(0))
    return ModeGround(vehicle, found, 0)


def test_the_judge_prefers_a_policy_that_loses_nothing(vehicle, left):
    wide = left(one_way_policy(vehicle, 1.0, clear=1.0))
    assert wide[0] == 0.0
    assert not len(left.lost)
    grazing = left(one_way_policy(vehicle, 1.0, clear=0.8))
    wrong = left(one_way_policy(vehicle, -1.0))
    assert wrong < grazing < wide
    assert len(left.lost)


def test_a_policy_that_ends_far_off_is_not_good_enough(vehicle, left):
    # It passes the pillar and then goes straight on, a metre off the set-point.
    score = left(one_way_policy(vehicle, 1.0, clear=1.0))
    assert score < left.enough
    assert -score[1] * vehicle.precision >= 1.0


def test_training_goes_on_where_the_game_is_lost(vehicle, left):
    left(one_way_policy(vehicle, 1.0, clear=0.8))
    rng = np.random.default_rng(0)
    z = left.starts(4000, rng)
    lost = np.isin(left.grid.nearest(z), left.lost)
    left(one_way_policy(vehicle, 1.0, clear=1.0))
    elsewhere = np.isin(left.grid.nearest(left.starts(4000, rng)), left.nodes)
    assert lost.mean() > 0.15
    assert elsewhere.all()


def test_training_ends_when_a_policy_is_good_enough(vehicle):
    class Judge:
        enough = (1.0,)
        asked = 0

        def __call__(self, policy):
            self.asked += 1
            return (self.asked / 2,)

    judge, settings = Judge(), preset(vehicle, "smoke").stage6
    training.train(vehicle, settings, seed=0, judge=judge)
    assert judge.asked == 2
