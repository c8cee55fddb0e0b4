"""Training improves the policy in seconds, is reproducible, and leaves logs and checkpoints."""

import os
import pickle
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
import torch
import unmeasured
from planted import spare

import hyrl_mj
from hyrl_mj import MlpPolicy, Noise
from hyrl_mj.gym_export.core import BatchedEnv
from hyrl_mj.learning import training
from hyrl_mj.learning.presets import preset

# Samples of the quickest training that still updates the networks several times.
FEW = {"ppo": 4_096, "dqn": 4_000}


@pytest.fixture
def quick(task, quickly_judged):
    return replace(preset(task, "smoke").stage1, samples=FEW[task.learning.algorithm])


def assert_same_weights(a, b):
    assert a.weights.keys() == b.weights.keys()
    for name in a.weights:
        np.testing.assert_array_equal(a.weights[name], b.weights[name], err_msg=name)


def untrained(task):
    return training.export(training.build(task, preset(task, "smoke").stage1, seed=0), task)


@pytest.mark.slow
def test_training_returns_the_best_policy_that_it_met_and_logs_the_latest(
    task, tmp_path, monkeypatch
):
    """Whatever the evaluations say, the policy with the highest score comes back."""
    scores, policies = iter([(0.5, 3.0), (0.9, -1.0), *[(0.9, -2.0)] * 100]), []

    def scripted(task, policy, *_):
        policies.append(policy)
        return next(scores)

    monkeypatch.setattr(training, "evaluate", scripted)
    settings = replace(preset(task, "smoke").stage1, samples=FEW[task.learning.algorithm])
    best = training.train(task, settings, seed=0, log_dir=tmp_path)
    assert len(policies) > 2
    assert best is policies[1]
    assert_same_weights(MlpPolicy.load(tmp_path / "checkpoint.safetensors"), policies[-1])
    (events,) = (tmp_path / "tensorboard").glob("events.out.tfevents.*")
    assert events.stat().st_size > 200


@pytest.mark.long
def test_dqn_learns_the_vehicle_with_some_more_samples(vehicle):
    settings = replace(preset(vehicle, "smoke").stage1, samples=60_000)
    policy = training.train(vehicle, settings, seed=0)
    assert training.evaluate(vehicle, policy)[1] > 85


@pytest.mark.first(1)
@pytest.mark.slow
def test_the_seed_fixes_every_weight_whatever_threads_and_torch_are_set_to(
    task, quick, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    policies = []
    noisy = training.TaskGround(task, quick)
    noisy.noise = Noise("uniform", 0.1)
    for threads, seed in ((1, 4), (2, 4), (2, 5)):
        monkeypatch.setattr(training, "BatchedEnv", partial(BatchedEnv, threads=threads))
        policies.append(training.train(task, quick, seed=seed, ground=noisy))
    torch.set_default_dtype(torch.float64)  # as code of the user's may have set it for itself
    try:
        with torch.inference_mode():
            policies.append(training.train(task, quick, seed=5, ground=noisy))
    finally:
        torch.set_default_dtype(torch.float32)
    first, again, other, unset = policies
    assert_same_weights(first, again)
    assert_same_weights(other, unset)
    assert any(not np.array_equal(first.weights[n], other.weights[n]) for n in first.weights)
    assert not any(tmp_path.iterdir()), "without a folder for logs none are written"


def trained():
    """The weights of short trainings by three algorithms, after their last sample, as bytes."""
    found = []
    with pytest.MonkeyPatch.context() as patch:
        spare(patch, checkpoints=1)
        patch.setattr(training, "EPISODES", 16)
        for name, algorithm, samples in (
            ("unit_circle", "ppo", 2_048), ("vehicle", "dqn", 2_200), ("unit_circle", "td3", 1_100),
        ):  # fmt: skip
            task = hyrl_mj.get_task(name)
            settings = preset(task, "smoke", algorithm=algorithm).stage1
            settings = replace(settings, samples=samples, rehearse=0.0)
            with TemporaryDirectory() as folder:
                training.train(task, settings, seed=4, log_dir=Path(folder))
                found.append((Path(folder) / "checkpoint.safetensors").read_bytes())
    return found


@pytest.mark.slow
def test_cores_do_not_matter():
    """Another process, in which BLAS and torch have two threads, trains the same."""
    here = Path(__file__).parent
    program = (
        "import pickle, sys, test_training as t; sys.stdout.buffer.write(pickle.dumps(t.trained()))"
    )
    path = os.pathsep.join([str(Path(hyrl_mj.__file__).parents[1]), str(here)])
    threads = {"OMP_NUM_THREADS": "2", "OPENBLAS_NUM_THREADS": "2"}
    env = unmeasured.environment(PYTHONPATH=path, **threads)
    done = subprocess.run([sys.executable, "-c", program], env=env, capture_output=True, check=True)
    for own, other in zip(trained(), pickle.loads(done.stdout), strict=True):
        assert own == other


@pytest.mark.parametrize("fails", [False, True])
def test_torch_gets_its_threads_back(fails):
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        with pytest.raises(KeyError) if fails else training.threads(1):
            if fails:
                with training.threads(1):
                    raise KeyError
            assert torch.get_num_threads() == 1
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


def test_it_goes_on_from_a_policy(task):
    start = untrained(task)
    settings = preset(task, "paper").stage6
    model = training.build(task, settings, seed=1, start_from=start)
    assert_same_weights(training.export(model, task), start)


# ---- returns


@pytest.mark.slow
def test_evaluation_of_a_known_policy(circle, monkeypatch):
    """A policy that never moves: 150 times the reward of its start, or the discounted sum."""
    policy = untrained(circle)
    still = replace(policy, weights={n: 0 * w for n, w in policy.weights.items()})
    monkeypatch.setattr(circle, "starts", lambda n, rng: np.full((n, 1), 1.0))
    for gamma, factor in ((1.0, 150), (0.9, (1 - 0.9**150) / 0.1)):
        success, value = training.evaluate(circle, still, gamma)
        assert success == 0
        assert value == pytest.approx(-factor / np.pi, rel=1e-6)


def test_training_ends_when_a_policy_is_good_enough(vehicle):
    class Counted(training.TaskGround):
        enough = (1.0,)
        settled = 0.0
        asked = 0

        def __call__(self, policy):
            self.asked += 1
            return (self.asked / 2,)

    settings = preset(vehicle, "smoke").stage6
    ground = Counted(vehicle, settings)
    training.train(vehicle, settings, seed=0, ground=ground)
    assert ground.asked == 2


def rewards_seen(task, settings):
    """The rewards that the algorithm gets in 300 samples of 16 episodes, after 200 others."""
    env = training.build(task, settings, seed=0).get_env()
    env.seed(0)
    env.reset()
    rng = np.random.default_rng(0)
    actions = rng.integers(len(task.input_levels), size=(500, env.num_envs))
    return np.array([env.step(action)[1] for action in actions])[200:]


@pytest.mark.slow
def test_normalised_rewards_do_not_depend_on_the_unit_of_the_reward(vehicle, monkeypatch):
    settings = replace(preset(vehicle).stage1, envs=16, normalize=True)
    plain = rewards_seen(vehicle, replace(settings, normalize=False))
    small = rewards_seen(vehicle, settings)
    reward = type(vehicle).reward
    monkeypatch.setattr(vehicle, "reward", lambda *args: 1_000 * reward(vehicle, *args))
    large = rewards_seen(vehicle, settings)
    np.testing.assert_allclose(large, small, rtol=1e-2)
    assert np.corrcoef(plain.ravel(), small.ravel())[0, 1] > 0.99
    assert np.abs(small).max() < 1


def test_a_task_without_a_mirror_gets_a_wider_network():
    settings = {name: preset(hyrl_mj.get_task(name)).stage1 for name in ("gaps", "slalom")}
    assert settings["gaps"].hidden == (128, 128)
    assert settings["slalom"].hidden == (192, 192)
    assert all(s.normalize for s in settings.values())
    assert preset(hyrl_mj.get_task("slalom"), "paper", algorithm="ppo").stage1.hidden != (192, 192)


@pytest.mark.parametrize("name", ["unit_circle", "vehicle"])
def test_the_papers_problems_learn_from_plain_rewards(name):
    settings = preset(hyrl_mj.get_task(name))
    assert not settings.stage1.normalize
    assert not settings.stage6.normalize


@pytest.mark.slow
def test_a_ground_sees_a_policy_from_the_first_checkpoint_and_scores_it_after_half(
    vehicle, monkeypatch
):
    calls = []

    class Ground(training.TaskGround):
        def note_losses(self, policy):
            calls.append("seen")

        def __call__(self, policy):
            calls.append("scored")
            return (0.0,)

    spare(monkeypatch, checkpoints=8)
    settings = preset(vehicle, "smoke", algorithm="ppo").stage1
    settings = replace(settings, samples=4_096, envs=16, hidden=(8, 8))
    training.train(vehicle, settings, 0, ground=Ground(vehicle, settings))
    half = calls.index("scored")
    assert half == 3
    assert set(calls[:half]) == {"seen"}
    assert set(calls[half:]) == {"scored"}
