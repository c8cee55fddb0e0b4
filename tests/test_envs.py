"""The environments keep the conventions of Gymnasium and SB3, and all play the same episodes."""

import copy
import os
import pickle
import subprocess
import sys
import warnings
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from command_line import python
from gl import needs_gl
from gymnasium.utils.env_checker import check_env as gymnasium_check
from stable_baselines3.common.env_checker import check_env as sb3_check

import hyrl_mj
from hyrl_mj import BadInput, Noise
from hyrl_mj.gym_export.core import BatchedEnv, Domain
from hyrl_mj.gym_export.gym_env import TaskEnv
from hyrl_mj.gym_export.sb3_env import TaskVecEnv
from hyrl_mj.policies import PolicyController

LEFT, AHEAD, RIGHT = 4, 2, 0
IDS = {"unit_circle": "hyrl_mj/UnitCircle-v0", "vehicle": "hyrl_mj/ObstacleAvoidance-v0"}


def make(name, **kwargs):
    return gym.make(IDS[name], **kwargs)


def make_vec(name, num_envs, **kwargs):
    return gym.make_vec(IDS[name], num_envs, vectorization_mode="vector_entry_point", **kwargs)


def vehicle_outcome(z, action):
    """Play one action from z to the end: the last step."""
    env = make("vehicle")
    env.reset(seed=0, options={"z": z})
    while True:
        observation, reward, terminated, truncated, info = env.step(action)
        if terminated or truncated:
            return observation, reward, terminated, truncated, info
        assert "outcome" not in info


def test_what_gymnasium_can_make_are_the_tasks_of_the_package_as_they_are():
    code = (
        "import hyrl_mj, gymnasium, sys\n"
        "own = {n: s for n, s in gymnasium.registry.items() if n.startswith('hyrl_mj/')}\n"
        "assert 'hyrl_mj.tasks' not in sys.modules\n"
        "assert len(own) == len(hyrl_mj.task_names()) > 10\n"
        "assert own == {n: gymnasium.registry[n] for n in own}, 'the tasks have registered others'\n"
    )
    done = python(code)
    assert done.returncode == 0, done.stderr


@needs_gl  # Gymnasium's checker renders
@pytest.mark.parametrize("check", [gymnasium_check, sb3_check])
def test_the_checkers_of_both_libraries_are_content(task, check):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check(make(task.name).unwrapped)


def test_make_knows_the_sample_time_and_the_limit(task):
    env = make(task.name)
    assert env.unwrapped.metadata["render_fps"] == 20
    assert env.spec.max_episode_steps == task.max_steps
    assert env.unwrapped.observation_space == env.observation_space


def test_spaces(circle):
    assert make("vehicle").action_space == gym.spaces.Discrete(5)
    assert make("unit_circle").action_space == gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
    vec = make_vec("vehicle", 3)
    assert vec.observation_space.shape == (3, 3)
    assert vec.action_space == gym.spaces.MultiDiscrete([5, 5, 5])


# ---- seeds


def record_single(name, seed, steps=100):
    env = make(name)
    env.action_space.seed(seed)
    observation, _ = env.reset(seed=seed)
    log = [observation]
    for _ in range(steps):
        observation, reward, terminated, truncated, _ = env.step(env.action_space.sample())
        log += [observation, np.array([reward, terminated, truncated])]
        if terminated or truncated:
            log.append(env.reset()[0])
    return np.concatenate(log)


def record_vector(name, seed, threads):
    env = make_vec(name, 32, threads=threads, noise=Noise("uniform", 0.1))
    env.action_space.seed(seed)
    log = [env.reset(seed=seed)[0].ravel()]
    for _ in range(200):
        log += [np.ravel(part) for part in env.step(env.action_space.sample())[:4]]
    return np.concatenate(log)


def test_a_seed_repeats_episodes_bit_for_bit(task):
    np.testing.assert_array_equal(record_single(task.name, 3), record_single(task.name, 3))
    assert not np.array_equal(record_single(task.name, 3)[:3], record_single(task.name, 4)[:3])


@pytest.mark.slow
def test_a_seed_repeats_vector_episodes_at_any_number_of_threads(task):
    first = record_vector(task.name, 3, threads=1)
    np.testing.assert_array_equal(first, record_vector(task.name, 3, threads=1))
    np.testing.assert_array_equal(first, record_vector(task.name, 3, threads=2))


def test_a_later_reset_without_seed_goes_on_with_other_starts(task):
    env = make_vec(task.name, 4)
    first, _ = env.reset(seed=1)
    assert not np.array_equal(env.reset()[0], first)


@pytest.mark.slow
def test_the_vector_env_plays_the_episodes_of_the_single_env(task):
    starts = np.array(task.scene.starts)
    vec = make_vec(task.name, len(starts))
    vec.action_space.seed(0)
    singles = [make(task.name) for _ in starts]
    observations, infos = vec.reset(options={"z": starts})
    np.testing.assert_allclose(infos["z"], starts, atol=1e-12)
    running = np.ones(len(starts), dtype=bool)
    for env, z, observation in zip(singles, starts, observations, strict=True):
        np.testing.assert_array_equal(env.reset(options={"z": z})[0], observation)
    for _ in range(task.max_steps):
        actions = vec.action_space.sample()
        observations, rewards, terminated, truncated, infos = vec.step(actions)
        for i in np.flatnonzero(running):
            observation, reward, *ends, info = singles[i].step(actions[i])
            ended = terminated[i] or truncated[i]
            seen = infos["final_obs"][i] if ended else observations[i]
            np.testing.assert_array_equal(observation, seen)
            assert (reward, *ends) == (rewards[i], terminated[i], truncated[i])
            if ended:
                assert info["outcome"] == infos["final_info"]["outcome"][i]
                running[i] = False
    assert not running.any()


# ---- how episodes end


@pytest.mark.parametrize(
    ("start", "action", "outcome", "end"),
    [
        ([0.0, 0.0], AHEAD, "crashed", [0.75, 0.0]),
        ([0.0, 0.51], LEFT, "out_of_bounds", [1.0, 1.51]),
        ([0.2, 1.0], AHEAD, "reached", [3.05, 1.0]),
    ],
)
def test_a_crash_leaving_the_arena_and_crossing_the_line_terminate(start, action, outcome, end):
    _, _, terminated, truncated, info = vehicle_outcome(start, action)
    assert (terminated, truncated, info["outcome"]) == (True, False, outcome)
    assert info["z"] == pytest.approx(end, abs=1e-6)


def test_the_end_of_time_truncates():
    env = make("unit_circle")
    env.reset(options={"z": [np.pi]})
    steps = [env.step(np.zeros(1, np.float32)) for _ in range(150)]
    assert [step[3] for step in steps] == [False] * 149 + [True]
    assert not any(step[2] for step in steps)
    assert steps[-1][4]["outcome"] == "stalled"
    env.reset(options={"z": [1.0]})
    steps = [env.step(np.full(1, -1.0 if k < 20 else 0.0, np.float32)) for k in range(150)]
    assert steps[-1][4]["outcome"] == "reached"


def test_sixty_samples_from_the_start_line_are_the_time_limit():
    *_, terminated, truncated, info = vehicle_outcome([0.0, 1.0], AHEAD)
    assert (terminated, truncated, info["outcome"]) == (False, True, "reached")
    assert info["z"][0] == pytest.approx(3.0, abs=1e-6)


def test_the_return_is_that_of_the_formula():
    env = make("unit_circle")
    env.reset(options={"z": [np.pi]})
    rewards = [env.step(np.array([1.0], np.float32))[1] for _ in range(10)]
    expected = [-(np.pi - 0.05 * k) / np.pi for k in range(1, 11)]
    np.testing.assert_allclose(rewards, expected, atol=1e-7)


def test_a_start_is_followed_to_the_bit_and_a_bad_one_refused(task):
    env = make(task.name)
    z = np.array(task.scene.starts[0])
    np.testing.assert_array_equal(env.reset(options={"z": z})[1]["z"], z)
    with pytest.raises(BadInput, match=task.name):
        env.reset(options={"z": np.full(task.chart.dimension, np.nan)})


def test_a_nan_action_never_reaches_mujoco():
    env = make("unit_circle").unwrapped
    env.reset(seed=0)
    before = env.core.plant.state
    with pytest.raises(BadInput, match="nan"):
        env.step(np.array([np.nan], np.float32))
    np.testing.assert_array_equal(env.core.plant.state, before)


@pytest.mark.parametrize("action", [-1, 5, 1.7])
def test_an_action_that_is_no_level_is_refused(action):
    env = make("vehicle").unwrapped
    env.reset(seed=0)
    with pytest.raises(BadInput, match=str(action)):
        env.step(action)


@pytest.mark.parametrize("name", IDS)
def test_the_loop_of_a_controller_is_that_of_simulate(name):
    task = hyrl_mj.get_task(name)

    def one_way(observation):
        n = len(observation)
        return np.full(n, LEFT) if task.input_levels is not None else np.ones((n, 1))

    policy, z = hyrl_mj.from_callable(one_way, task), task.starts(1, np.random.default_rng(0))
    controller, env = PolicyController(policy), make(name)
    _, info = env.reset(options={"z": z[0]})
    q, path = controller.initial_mode(info["measured"]), [info["z"]]
    while "outcome" not in info:
        u, q = controller.step(q, info["measured"])
        *_, info = env.step(u[0])
        path.append(info["z"])
    arc = hyrl_mj.simulate(task, policy, z[0])
    np.testing.assert_array_equal(np.array(path), arc.z)

    envs = make_vec(name, 3, noise=Noise("uniform", 0.1))
    _, infos = envs.reset(seed=0)
    u, _ = controller.step(np.zeros(3, dtype=int), infos["measured"])
    seen, *_, infos = envs.step(u)
    np.testing.assert_array_equal(seen, task.observation(infos["measured"]).astype(np.float32))


def test_actions_beyond_the_limits_are_clipped():
    env = make("unit_circle").unwrapped
    env.reset(options={"z": [1.0]})
    assert env.step(np.array([9.0], np.float32))[4]["z"] == pytest.approx([1.05], abs=1e-6)


# ---- autoreset


def test_a_vector_episode_starts_anew_in_the_same_step():
    env = make_vec("vehicle", 2)
    env.reset(seed=0, options={"z": [[0.6, 0.0], [0.0, 1.0]]})
    for _ in range(3):
        observations, _, terminated, _, infos = env.step(np.array([AHEAD, AHEAD]))
    np.testing.assert_array_equal(terminated, [True, False])
    np.testing.assert_array_equal(infos["_final_obs"], [True, False])
    np.testing.assert_allclose(infos["final_obs"][0], [0.0, 2.25, 0.0], atol=1e-6)
    assert infos["final_obs"][1] is None
    assert infos["final_info"]["outcome"][0] == "crashed"
    np.testing.assert_allclose(infos["final_info"]["z"][0], [0.75, 0.0], atol=1e-6)
    assert 0 <= infos["z"][0, 0] <= 0.5
    fresh = env.unwrapped.core.task.observation(infos["z"])
    np.testing.assert_allclose(observations, fresh, atol=1e-6)


def test_observations_are_not_overwritten_by_later_steps(task):
    env = make_vec(task.name, 4)
    first, _ = env.reset(seed=0)
    kept = first.copy()
    env.step(env.action_space.sample())
    np.testing.assert_array_equal(first, kept)


def test_an_episode_with_its_own_limit():
    env = make_vec("unit_circle", 2, max_episode_steps=7)
    env.reset(seed=0)
    ends = [env.step(np.zeros((2, 1), np.float32))[3].all() for _ in range(14)]
    assert ends == ([False] * 6 + [True]) * 2


# ---- SB3


def sb3(task, n, **kwargs):
    env = TaskVecEnv(BatchedEnv(task, n, **kwargs))
    env.seed(0)
    return env


def test_sb3_gets_terminal_observation_and_episode(vehicle):
    env = sb3(vehicle, 3)
    env.reset()
    env.core.reset(z=np.array([[0.6, 0.0], [2.9, 1.0], [0.0, 1.0]]))
    for _ in range(3):
        observation, reward, done, infos = env.step(np.array([AHEAD] * 3))
    np.testing.assert_array_equal(done, [True, True, False])
    assert [info.get("outcome") for info in infos] == ["crashed", "reached", None]
    np.testing.assert_allclose(infos[0]["terminal_observation"], [0.0, 2.25, 0.0], atol=1e-6)
    assert [info.get("TimeLimit.truncated") for info in infos] == [False, False, None]
    assert infos[0]["episode"]["l"] == 3
    path = np.array([[0.65, 0.0], [0.7, 0.0], [0.75, 0.0]])
    earned = vehicle.reward(path, np.zeros((3, 1))).sum()
    assert infos[0]["episode"]["r"] == pytest.approx(earned, abs=1e-6)
    assert infos[2] == {}
    assert reward.shape == (3,)
    np.testing.assert_allclose(observation, vehicle.observation(env.core.z), atol=1e-6)


def test_sb3_is_told_that_time_was_up(circle):
    env = sb3(circle, 2, max_steps=5)
    env.reset()
    for _ in range(5):
        _, _, done, infos = env.step(np.zeros((2, 1)))
    assert done.all()
    assert all(info["TimeLimit.truncated"] and info["episode"]["l"] == 5 for info in infos)
    _, _, done, infos = env.step(np.zeros((2, 1)))
    assert not done.any()


def test_sb3_starts_where_its_options_say_once(task):
    env, z = TaskVecEnv(BatchedEnv(task, 2)), np.array(task.scene.starts[:2])
    env.seed(0)

    def first_seen(z):
        return task.observation(z).astype(np.float32)

    env.set_options([{"z": start} for start in z])
    np.testing.assert_array_equal(env.reset(), first_seen(z))
    assert not np.array_equal(env.reset(), first_seen(z))
    env.set_options({"z": z[0]})
    np.testing.assert_array_equal(env.reset(), first_seen(z[[0, 0]]))


def test_starts_that_do_not_fit_are_refused(vehicle):
    env = TaskVecEnv(BatchedEnv(vehicle, 2))
    for options in ([{"z": [0.0, 0.1]}, {}], {"z": [0.0]}, {"z": [9.0, 0.0]}):
        env.set_options(options)
        with pytest.raises(BadInput, match="vehicle"):
            env.reset()
    env.set_options([{"z": [0.0, 0.1]}] * 3)
    with pytest.raises(BadInput, match=r"2 episode\(s\) need as many starts, got 3"):
        env.reset()


# ---- noise and domain


def test_noise_is_on_the_observation_only(vehicle):
    env = BatchedEnv(vehicle, 2, noise=Noise("alternating", 0.1))
    start = np.array([[0.0, 0.5], [0.2, -0.5]])
    np.testing.assert_allclose(env.reset(z=start)[:, 2], [0.6, -0.4], atol=1e-6)
    result = env.step(np.zeros((2, 1)))
    np.testing.assert_allclose(result.observation[:, 2], [0.4, -0.6], atol=1e-6)
    after = start + np.array([0.05, 0.0])
    np.testing.assert_allclose(env.z, after, atol=1e-6)
    np.testing.assert_allclose(result.reward, vehicle.reward(after, np.zeros((2, 1))), atol=1e-6)
    # x is measured without noise: the clearance is that of (x, y + noise)
    noisy = vehicle.observation(after + np.array([0.0, -0.1]))
    np.testing.assert_allclose(result.observation, noisy, atol=1e-6)


def test_leaving_the_domain_ends_an_episode_with_its_own_reward(circle):
    domain = Domain(
        starts=lambda n, rng: np.full((n, 1), 1.0),
        contains=lambda z: np.abs(z[:, 0] - 1.0) < 0.12,
        exit_reward=-30.0,
    )
    env = BatchedEnv(circle, 2, domain=domain)
    env.reset()
    u = np.array([[1.0], [0.0]])
    results = [env.step(u) for _ in range(3)]
    ends = np.array([r.terminated for r in results])
    np.testing.assert_array_equal(ends, [[False, False], [False, False], [True, False]])
    assert results[2].reward[0] == -30.0
    assert results[2].reward[1] == pytest.approx(-1 / np.pi)


# ---- copies


def played(env, steps=30):
    """Plays the same actions on any environment, and returns what it saw."""
    env.action_space.seed(0)
    seen = [env.step(env.action_space.sample()) for _ in range(steps)]
    return np.concatenate([np.ravel(part) for step in seen for part in step[:4]])


@pytest.mark.parametrize(
    "copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))], ids=["copy", "pickle"]
)
@pytest.mark.parametrize("build", [make, partial(make_vec, num_envs=3)], ids=["one", "many"])
def test_a_copy_plays_on_as_the_original(task, build, copied):
    env = build(task.name, noise=Noise("uniform", 0.1)).unwrapped
    env.reset(seed=5)
    played(env, 10)
    twin = copied(env)
    np.testing.assert_array_equal(played(twin), played(env))


def test_a_copy_for_sb3_plays_on_as_the_original(vehicle):
    env = sb3(vehicle, 3)
    env.reset()
    twin = pickle.loads(pickle.dumps(env))
    for _ in range(70):
        for a, b in zip(env.step([LEFT] * 3)[:3], twin.step([LEFT] * 3)[:3], strict=True):
            np.testing.assert_array_equal(a, b)


@pytest.mark.slow
def test_a_copy_of_a_task_from_a_file_finds_it_again(puck):
    assert type(pickle.loads(pickle.dumps(puck))) is type(puck)
    code = "import pickle, sys; print(pickle.load(sys.stdin.buffer).name)"
    child = subprocess.run(
        [sys.executable, "-c", code], input=pickle.dumps(puck), capture_output=True, check=True
    )
    assert child.stdout.decode().strip() == puck.name


# ---- what cannot be used


@pytest.mark.parametrize("options", [[1], "z", 5, {"Z": [0.0, 0.0]}, {1: 2}])
def test_options_that_are_no_start_are_refused(options, vehicle):
    for env in (make("vehicle"), make_vec("vehicle", 2)):
        with pytest.raises(BadInput, match="option"):
            env.reset(options=options)
    with pytest.raises(BadInput, match="option"):
        sb3(vehicle, 2).set_options(options)


@pytest.mark.parametrize("action", [[], None, "left", [[1], [1, 2]], 1j, True, [[0.0]], 10**30])
def test_an_action_of_another_kind_is_refused(action):
    for name in IDS:
        env = make(name).unwrapped
        env.reset(seed=0)
        before = env.core.plant.state
        with pytest.raises(BadInput, match=f"cannot be used: {name} takes|cannot be used: give"):
            env.step(action)
        np.testing.assert_array_equal(env.core.plant.state, before)


@pytest.mark.parametrize("actions", [[], 1, [1], [1, 1, 1], [[1, 1]], [0.5, 0.5], ["a", "b"]])
def test_actions_of_another_number_are_refused(actions, vehicle):
    for env in (make_vec("vehicle", 2), sb3(vehicle, 2)):
        env.reset()
        with pytest.raises(BadInput, match=r"actions? |input has shape"):
            env.step(np.array(actions))


@pytest.mark.parametrize("n", [1.5, 0, -1, True, "2", None, 10**12])
def test_a_number_of_episodes_that_is_none_is_refused(n, vehicle):
    with pytest.raises(BadInput, match=r"the number of episodes side by side .* an integer from 1"):
        make_vec("vehicle", n)
    with pytest.raises(BadInput, match="the number of episodes side by side"):
        BatchedEnv(vehicle, n)


def test_other_values_that_are_out_of_range_are_refused(vehicle):
    for options in ({"max_steps": 0}, {"max_steps": 1.5}, {"threads": -1}, {"threads": "all"}):
        with pytest.raises(BadInput, match="cannot be used: give an integer"):
            BatchedEnv(vehicle, 2, **options)
    with pytest.raises(BadInput, match="seed -1"):
        BatchedEnv(vehicle, 2).seed(-1)
    with pytest.raises(BadInput, match="unknown camera in model vehicle 'nowhere'"):
        make("vehicle", camera="nowhere")
    with pytest.raises(BadInput, match="'vehicle' cannot be used: give a BatchedEnv"):
        TaskVecEnv("vehicle")


def test_many_episodes_draw_no_pictures(vehicle):
    with pytest.raises(BadInput, match="render_mode 'rgb_array' cannot be used with many episodes"):
        make_vec("vehicle", 2, render_mode="rgb_array")
    assert make_vec("vehicle", 2, render_mode=None).render() is None
    assert sb3(vehicle, 2).get_images() == [None, None]


# ---- pictures


@pytest.mark.slow
@needs_gl
def test_a_copy_draws_its_own_pictures():
    env = make("vehicle", render_mode="rgb_array").unwrapped
    env.reset(options={"z": [0.0, 0.5]})
    picture = env.render()
    twin = copy.deepcopy(env)
    env.close()
    np.testing.assert_array_equal(twin.render(), picture)
    twin.close()


@needs_gl
def test_only_the_thread_of_the_first_picture_draws():
    env = make("vehicle", render_mode="rgb_array").unwrapped
    env.reset(seed=0)
    picture = env.render()
    with ThreadPoolExecutor(1) as other:
        with pytest.raises(BadInput, match="only be drawn by the thread that drew the first one"):
            other.submit(env.render).result(timeout=30)
        with pytest.raises(BadInput, match="only be drawn by the thread"):
            other.submit(env.close).result(timeout=30)
    np.testing.assert_array_equal(env.render(), picture)
    env.close()


FORKED = """
import os, signal, sys, gymnasium, hyrl_mj

env = gymnasium.make("hyrl_mj/ObstacleAvoidance-v0", render_mode="rgb_array")
env.reset(seed=0)
if sys.argv[1] == "after":
    env.render()
child = os.fork()
if not child:
    signal.alarm(30)
    try:
        print(env.render().shape, flush=True)
    except hyrl_mj.NoRenderer as error:
        print(error, flush=True)
    env.close()
    sys.exit(0)  # deletes all that there is
print("ended with", os.waitpid(child, 0)[1])
print(env.render().shape)
"""


@needs_gl
@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
@pytest.mark.parametrize(
    ("when", "says"), [("before", "(480, 640, 3)"), ("after", "was forked from")]
)
def test_a_forked_process_draws_or_says_why_not(when, says):
    path = str(Path(hyrl_mj.__file__).parents[1])
    done = python(FORKED, when, env={**os.environ, "PYTHONPATH": path})
    first, *rest = done.stdout.splitlines()
    assert says in first, done.stderr
    assert rest == ["ended with 0", "(480, 640, 3)"], done.stderr


@needs_gl
def test_rgb_array_shows_the_scene(task):
    env = make(task.name, render_mode="rgb_array")
    env.reset(options={"z": task.scene.starts[0]})
    picture = env.render()
    assert picture.shape == (480, 640, 3)
    assert picture.dtype == np.uint8
    assert picture.std() > 10
    action = 1.0 if task.learning.levels is None else LEFT
    for _ in range(10):
        env.step(np.array([action], np.float32) if task.learning.levels is None else action)
    assert (env.render() != picture).any(axis=2).sum() > 50, "the robot has moved"
    env.close()


def test_a_picture_is_drawn_in_the_mode_of_pictures_alone():
    assert make("vehicle").unwrapped.render() is None
    with pytest.raises(BadInput, match="'ansi' is unknown: use None or 'rgb_array'"):
        TaskEnv("vehicle", render_mode="ansi")
