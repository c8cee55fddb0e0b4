"""SB3 evaluates the hybrid controller and finds what the project's own simulation finds."""

import gymnasium as gym
import numpy as np
import pytest
from figure_parts import controller_of, policy_of
from planted import ChartPolicy, Cube, homing_controller, ideal_controller, random_states
from stable_baselines3.common.evaluation import evaluate_policy

from hyrl_mj import BadInput, LoopSettings, Noise, closed_loop
from hyrl_mj.gym_export.core import BatchedEnv
from hyrl_mj.gym_export.gym_env import action_space
from hyrl_mj.gym_export.sb3_env import TaskVecEnv
from hyrl_mj.gym_export.sb3_policy import Sb3Policy
from hyrl_mj.policies.controllers import as_controller

QUIET, ALTERNATING, UNIFORM = Noise(), Noise("alternating", 0.1), Noise("uniform", 0.1)


LOOPS = {"hyrl": controller_of, "policy": policy_of}


def observed(task, measured):
    """What the environments give (n, k)."""
    return task.observation(measured).astype(np.float32)


def simulated_returns(task, loop, z, noise, seed):
    """Returns and lengths (n,), (n,) of the project's own simulation."""
    rollout = closed_loop(
        task, as_controller(loop), z, noise, seed=seed, settings=LoopSettings(quiet=True)
    )
    u = np.zeros((len(z), len(task.inputs)))  # the rewards of these tasks do not depend on it
    rewards = np.array([task.reward(measurement, u) for measurement in rollout.path[1:]])
    played = np.arange(len(rewards))[:, None] < rollout.length
    return np.where(played, rewards, 0.0).sum(axis=0), rollout.length


def evaluated_returns(task, loop, z, noise, seed):
    """The same of SB3's `evaluate_policy`, an episode from each start."""
    env = TaskVecEnv(BatchedEnv(task, len(z), noise=noise))
    env.seed(seed)
    env.set_options([{"z": start} for start in z])
    episodes = {}

    def keep(local, _):
        if local["done"]:
            episodes[local["i"]] = local["info"]["episode"]

    model = Sb3Policy(task, loop)
    returns, _ = evaluate_policy(
        model, env, n_eval_episodes=len(z), callback=keep, return_episode_rewards=True
    )
    assert len(returns) == len(episodes) == len(z)
    return tuple(np.array([episodes[i][key] for i in range(len(z))]) for key in ("r", "l"))


# ---- what SB3 finds


@pytest.mark.parametrize("noise", [QUIET, ALTERNATING], ids=["quiet", "alternating"])
@pytest.mark.parametrize("loop", LOOPS)
def test_sb3_finds_the_returns_of_the_simulation(task, loop, noise):
    loop, z = LOOPS[loop](task), task.starts(60, np.random.default_rng(1))
    own, length = simulated_returns(task, loop, z, noise, 0)
    found, found_length = evaluated_returns(task, loop, z, noise, 0)
    np.testing.assert_array_equal(found_length, length)
    np.testing.assert_allclose(found, own, atol=1e-3)
    assert np.ptp(own) > 0.1


@pytest.mark.parametrize("loop", LOOPS)
def test_a_seed_gives_both_the_same_random_noise(task, loop):
    loop, z = LOOPS[loop](task), task.starts(60, np.random.default_rng(1))
    if task.name == "vehicle":
        # An episode that ends draws a start, and the others' noise is then another: none ends early.
        z = z[np.abs(z[:, 1]) > 0.3] * [0, 1]
    own, length = simulated_returns(task, loop, z, UNIFORM, 7)
    assert (length == task.max_steps).all()
    found, _ = evaluated_returns(task, loop, z, UNIFORM, 7)
    np.testing.assert_allclose(found, own, atol=1e-3)
    assert np.abs(own - simulated_returns(task, loop, z, UNIFORM, 8)[0]).max() > 0.01


@pytest.mark.slow
def test_the_mean_under_random_noise_is_that_of_the_simulation(task):
    loop = controller_of(task)
    env = TaskVecEnv(BatchedEnv(task, 100, noise=UNIFORM))
    env.seed(3)
    returns, _ = evaluate_policy(
        Sb3Policy(task, loop), env, n_eval_episodes=400, return_episode_rewards=True
    )
    z = task.starts(400, np.random.default_rng(4))
    own, _ = simulated_returns(task, loop, z, UNIFORM, 5)
    error = np.hypot(np.std(returns), np.std(own)) / 20
    assert abs(np.mean(returns) - np.mean(own)) < 4 * error


def test_the_single_environment_is_evaluated_too(task):
    env = gym.make(task.env_id)
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="Monitor"):
        mean, _ = evaluate_policy(Sb3Policy(task, controller_of(task)), env, n_eval_episodes=2)
    assert np.isfinite(mean)


# ---- one call


def test_a_call_gives_what_a_step_gives(task):
    controller, rng = controller_of(task), np.random.default_rng(2)
    measured, q = random_states(task, 3000, rng), rng.integers(0, 2, 3000)
    u, after = controller.step(q, measured)
    actions, (found,) = Sb3Policy(task, controller).predict(observed(task, measured), (q,))
    np.testing.assert_array_equal(found, after)
    np.testing.assert_allclose(BatchedEnv(task, 1).inputs(actions), u, atol=2e-5)
    assert (after != q).any()


def test_a_robot_with_inertia_is_answered_by_its_speed_too(puck):
    class Brake:
        def act(self, measured):
            return np.clip(-measured[:, 1:2] - measured[:, 2:3], *puck.input_limits)

    measured = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 4))
    actions, _ = Sb3Policy(puck, Brake()).predict(observed(puck, measured))
    np.testing.assert_allclose(actions, Brake().act(measured), atol=1e-6)


def test_actions_are_those_of_the_environments(task):
    model, space = Sb3Policy(task, controller_of(task)), action_space(task)
    observations = observed(task, np.array(task.scene.starts))
    actions, (q,) = model.predict(observations)
    assert actions.dtype == space.dtype
    for observation, action, mode in zip(observations, actions, q, strict=True):
        single, (one,) = model.predict(observation)
        assert space.contains(single)
        np.testing.assert_array_equal(single, action)
        np.testing.assert_array_equal(one, [mode])


def test_the_mode_is_kept_and_picked_anew_where_an_episode_starts(circle):
    model = Sb3Policy(circle, homing_controller(circle))
    observations = observed(circle, np.array([[np.pi - 0.1], [np.pi - 0.1], [np.pi + 0.1]]))
    _, picked = model.predict(observations)
    np.testing.assert_array_equal(picked[0], [0, 0, 1])
    other = (np.array([1, 1, 0]),)
    np.testing.assert_array_equal(model.predict(observations, other)[1][0], [1, 1, 0])
    starts = np.array([True, False, True])
    np.testing.assert_array_equal(model.predict(observations, other, starts)[1][0], [0, 1, 1])
    np.testing.assert_array_equal(model.predict(observations, other, True)[1][0], [0, 0, 1])
    np.testing.assert_array_equal(other[0], [1, 1, 0])
    assert model.predict(observations, None, np.zeros(3, bool))[1][0].tolist() == [0, 0, 1]


def test_deterministic_or_not_the_answer_is_the_same(task):
    model, seen = Sb3Policy(task, policy_of(task)), observed(task, np.array(task.scene.starts))
    np.testing.assert_array_equal(
        model.predict(seen, deterministic=False)[0], model.predict(seen)[0]
    )


def test_a_measurement_inside_the_pillar_is_found(vehicle):
    z = np.array([[0.74, 0.0], [0.751, 0.0], [1.5, 0.0], [2.2, 0.1], [2.26, 0.0], [3.2, -1.0]])
    np.testing.assert_allclose(vehicle.measured(observed(vehicle, z)), z, atol=2e-6)


# ---- what cannot be used


@pytest.mark.parametrize(
    ("observation", "words"),
    [
        (np.zeros(2), r"has shape \(3,\) or \(n, 3\), got \(2,\)"),
        (np.zeros((1, 1, 3)), r"got \(1, 1, 3\)"),
        (0.5, r"got \(\)"),
        ({"seen": 1}, "is 3 numbers, got {'seen': 1}"),
        ([0.0, np.nan, 0.0], "observation nan cannot be used"),
    ],
)
def test_an_observation_that_is_none_is_refused(vehicle, observation, words):
    with pytest.raises(BadInput, match=words):
        Sb3Policy(vehicle, ideal_controller(vehicle)).predict(observation)


@pytest.mark.parametrize(
    "state", [(np.zeros(3),), np.zeros(2), (), (np.zeros(2), np.zeros(2)), (0,)]
)
def test_a_state_of_the_wrong_shape_is_refused(vehicle, state):
    seen = observed(vehicle, np.zeros((2, 2)))
    with pytest.raises(BadInput, match=r"modes q of shape \(2,\), got"):
        Sb3Policy(vehicle, ideal_controller(vehicle)).predict(seen, state)


@pytest.mark.parametrize("loop", LOOPS)
@pytest.mark.parametrize("mode", [7, 0.5, np.nan])
def test_an_unknown_mode_is_refused(task, loop, mode):
    seen = observed(task, np.array(task.scene.starts[:1]))
    with pytest.raises(BadInput, match=rf"mode {mode} is unknown: choose one of \(0,"):
        Sb3Policy(task, LOOPS[loop](task)).predict(seen, (np.array([mode]),))


def test_starts_of_the_wrong_shape_are_refused(vehicle):
    model, seen = Sb3Policy(vehicle, ideal_controller(vehicle)), np.zeros((2, 3))
    with pytest.raises(BadInput, match=r"episode_start of shape \(2,\), got \(3,\)"):
        model.predict(seen, (np.zeros(2),), np.zeros(3))


def test_a_task_that_cannot_go_back_says_so():
    cube = Cube(lambda z: z[:, 0])
    cube.observation_low = (-1.0,) * 3
    with pytest.raises(BadInput, match=r"cube does not say .* give it a measured\(observation\)"):
        Sb3Policy(cube, ChartPolicy(cube, np.zeros_like)).predict(np.zeros(3))


def test_an_input_that_is_no_level_is_refused(vehicle):
    slow = ChartPolicy(vehicle, lambda z: np.full((len(z), 1), 0.3))
    with pytest.raises(BadInput, match=r"input \[0.3\] is none of the 5 levels that vehicle takes"):
        Sb3Policy(vehicle, slow).predict(np.ones(3))
