"""Every algorithm trains, gives a plain network and a whole run; what cannot be used is refused first."""

import json
import sys
from dataclasses import replace

import numpy as np
import pytest
from command_line import call
from planted import few_noises, spare
from sentences import assert_has_ended

import hyrl_mj
from hyrl_mj import BadInput
from hyrl_mj.gym_export.core import BatchedEnv
from hyrl_mj.learning.presets import preset
from hyrl_mj.learning.settings import PRESETS
from hyrl_mj.learning.training import build, check_foreign, evaluate, export, threads, train
from hyrl_mj.policies import ALGORITHMS, algorithms

# What can have the inputs of which task.
CAN = [
    (name, task)
    for name, algorithm in ALGORITHMS.items()
    for task, levels in (("unit_circle", False), ("vehicle", True))
    if algorithm.takes(levels)
]
# Samples after which every network has been updated.
FEW = {"ppo": 4_096, "a2c": 4_096, "dqn": 2_500, "sac": 1_200, "td3": 1_200, "ddpg": 1_200}
# A module of the user's with algorithms of all kinds.
MODULE = '''
import torch
from gymnasium.spaces import Box
from stable_baselines3 import DQN, PPO, SAC, TD3
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy


class Derived(PPO):
    """PPO under another name."""


class Any(PPO):
    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)


class Fewer(PPO):
    def __init__(self, policy, env, learning_rate=1e-3, gamma=0.9, seed=None, device="cpu",
                 policy_kwargs=None, n_steps=8):
        super().__init__(policy, env, learning_rate, n_steps, gamma=gamma, seed=seed, device=device,
                         policy_kwargs=policy_kwargs, batch_size=64)


class Similar(OffPolicyAlgorithm):
    """SAC that is not derived from it."""
    policy_aliases = SAC.policy_aliases

    def __init__(self, policy, env, learning_rate, buffer_size, learning_starts, batch_size, tau,
                 gamma, train_freq, gradient_steps, ent_coef, policy_kwargs, seed, device):
        super().__init__(policy, env, learning_rate, buffer_size, learning_starts, batch_size, tau,
                         gamma, train_freq, gradient_steps, policy_kwargs=policy_kwargs, seed=seed,
                         device=device, supported_action_spaces=(Box,), support_multi_env=True)
        self.ent_coef_tensor = torch.tensor(ent_coef)
        self._setup_model()

    def _setup_model(self):
        super()._setup_model()
        self.actor, self.critic = self.policy.actor, self.policy.critic
        self.critic_target = self.policy.critic_target

    def train(self, gradient_steps, batch_size):
        self.ent_coef_optimizer = self.log_ent_coef = None
        self.target_update_interval = 1
        self.batch_norm_stats = self.batch_norm_stats_target = []
        SAC.train(self, gradient_steps, batch_size)


class DerivedTD3(TD3):
    pass


class DerivedDQN(DQN):
    pass


class Broken(PPO):
    def __init__(self, *args, **kwargs):
        raise RuntimeError("not today")


class Other(ActorCriticPolicy):
    def _get_action_dist_from_latent(self, latent_pi):
        return super()._get_action_dist_from_latent(1 - latent_pi)


class Twisted(PPO):
    policy_aliases = {"MlpPolicy": Other}


class Normalised(ActorCriticPolicy):
    def _build(self, lr_schedule):
        super()._build(lr_schedule)
        layers = list(self.mlp_extractor.policy_net)
        layers[3] = torch.nn.Sequential(torch.nn.BatchNorm1d(64), layers[3])
        self.mlp_extractor.policy_net = torch.nn.Sequential(*layers)


class Norm(PPO):
    policy_aliases = {"MlpPolicy": Normalised}


class Blind(ActorCriticPolicy):
    def _build(self, lr_schedule):
        super()._build(lr_schedule)
        self.action_net = torch.nn.Sequential(self.action_net)


class Renamed(PPO):
    policy_aliases = {"MlpPolicy": Blind}


NOT_A_CLASS = 3
'''


@pytest.fixture(scope="module")
def mine(tmp_path_factory):
    """The name of a module with algorithms, which can be imported."""
    folder = tmp_path_factory.mktemp("mine")
    (folder / "my_algorithms.py").write_text(MODULE)
    (folder / "my_broken_module.py").write_text("import nowhere_to_be_found\n")
    sys.path.insert(0, str(folder))
    yield "my_algorithms"
    sys.path.remove(str(folder))


def quick(task, algorithm, known=None):
    """Smoke settings of an algorithm with few samples, as many as for the known one of SB3."""
    stage1 = preset(task, "smoke", algorithm=algorithm).stage1
    return replace(stage1, samples=FEW[known or algorithm])


# ---- the algorithms of SB3


@pytest.fixture(scope="module", params=CAN, ids="-".join)
def learned(request):
    """A task, a model of SB3 that has been trained a little, and its policies before and after."""
    algorithm, name = request.param
    task = hyrl_mj.get_task(name)
    settings = quick(task, algorithm)
    model = build(task, settings, seed=0)
    before = export(model, task)
    with threads(1):
        model.learn(settings.samples)
    return task, model, before, export(model, task)


@pytest.mark.slow
def test_it_trains_a_policy_that_answers_as_sb3_does(learned):
    task, model, before, policy = learned
    assert policy.algorithm == before.algorithm == type(model).__name__.lower()
    core = BatchedEnv(task, 500)
    core.seed(1)
    observation = core.reset()
    assert np.abs(policy.outputs(observation) - before.outputs(observation)).max() > 1e-3
    actions, _ = model.predict(observation, deterministic=True)
    np.testing.assert_allclose(policy.inputs(observation), core.inputs(actions), atol=1e-5)


@pytest.mark.slow
def test_actors_and_critics_respect_the_mirror(learned):
    task, model, _, policy = learned
    rng = np.random.default_rng(0)
    o = rng.uniform(task.observation_low, task.observation_high, (200, len(task.observation_low)))
    there = policy.inputs(o * task.mirror.observation) * task.mirror.inputs
    close = np.abs(there - policy.inputs(o)).max(axis=1) < 1e-4
    assert close.mean() > 0.99, "levels that are worth the same are chosen by their order"
    for part in ("critic", "critic_target"):
        if hasattr(model, part):
            a = rng.uniform(-1, 1, (200, len(task.inputs)))
            straight = values(getattr(model, part), o, a)
            turned = o * task.mirror.observation, a * task.mirror.inputs
            np.testing.assert_allclose(
                values(getattr(model, part), *turned), straight, rtol=1e-4, atol=1e-4
            )


def values(critic, o, a):
    """What all networks of an SB3 critic say, (critics, n)."""
    import torch

    with torch.no_grad():
        return np.hstack(
            [v.numpy() for v in critic(torch.tensor(o).float(), torch.tensor(a).float())]
        )


@pytest.mark.first(1)
@pytest.mark.parametrize(
    "algorithm",
    # One that learns from its latest samples, and one that keeps all of them.
    [
        "ppo",
        "sac",
        *(pytest.param(name, marks=pytest.mark.long) for name in ("a2c", "td3", "ddpg")),
    ],
)
@pytest.mark.slow
def test_the_smoke_preset_learns_the_circle(algorithm, circle, monkeypatch):
    spare(monkeypatch, checkpoints=3)
    settings = preset(circle, "smoke", algorithm=algorithm).stage1
    settings = replace(settings, samples=settings.samples // 2)
    before = evaluate(circle, export(build(circle, settings, 0), circle))[1]
    assert evaluate(circle, train(circle, settings, 0))[1] > before + 10


@pytest.mark.slow
def test_every_preset_has_every_algorithm_or_says_so():
    for algorithm, name in CAN:
        task = hyrl_mj.get_task(name)
        for which in PRESETS:
            if which == "paper" and algorithm not in ("ppo", "dqn"):
                with pytest.raises(BadInput, match=f"'paper' has no {algorithm}"):
                    preset(task, which, algorithm=algorithm)
                continue
            settings = preset(task, which, algorithm=algorithm)
            assert settings.stage1.algorithm == algorithm
            own = preset(hyrl_mj.get_task(name), which)
            if which != "paper":
                assert settings.stage6 == own.stage6
            if which != "smoke":  # which differs from fast in its samples alone
                build(task, settings.stage1, 0)


def test_a_mode_goes_on_only_from_a_policy_of_its_own_algorithm(vehicle):
    assert preset(vehicle, "paper").stage6.warm_start
    assert not preset(vehicle, "paper", algorithm="ppo").stage6.warm_start


# ---- refusals


@pytest.mark.parametrize(
    ("algorithm", "task", "says"),
    [
        ("dqn", "unit_circle", "dqn needs levels of the input, unit_circle has none: choose one of ppo"),
        ("sac", "vehicle", "sac takes no levels of the input, vehicle has 5: choose one of ppo, a2c, dqn"),
        ("td3", "vehicle", "td3 takes no levels"),
        ("ddpg", "vehicle", "ddpg takes no levels"),
        ("DQN", "vehicle", "unknown algorithm 'DQN'"),
        ("tqc", "unit_circle", "unknown algorithm 'tqc'"),
        ("nowhere_at_all:PPO", "unit_circle", "nowhere_at_all:PPO cannot be imported: ModuleNotFound"),
        ("my_broken_module:PPO", "unit_circle", "cannot be imported: ModuleNotFound"),
        ("my_algorithms:Nothing", "unit_circle", "cannot be imported: AttributeError"),
        ("my_algorithms:", "unit_circle", "cannot be imported"),
        (":PPO", "unit_circle", "cannot be imported: ValueError"),
        ("my_algorithms:NOT_A_CLASS", "unit_circle", "is no algorithm of SB3's kind"),
        ("pathlib:Path", "unit_circle", "is no algorithm of SB3's kind"),
        ("my_algorithms:Broken", "unit_circle", "cannot train unit_circle: RuntimeError: not today"),
        ("my_algorithms:DerivedDQN", "unit_circle", "DerivedDQN needs levels of the input"),
        ("my_algorithms:DerivedTD3", "vehicle", "DerivedTD3 takes no levels of the input"),
        ("my_algorithms:Similar", "vehicle", "cannot train vehicle"),
        ("my_algorithms:Twisted", "unit_circle", "what it answers is not what its weights say"),
        ("my_algorithms:Norm", "unit_circle", "only plain multilayer perceptrons can"),
        ("my_algorithms:Renamed", "unit_circle", "only plain multilayer perceptrons can"),
    ],
)  # fmt: skip
def test_what_cannot_be_used_is_one_sentence_before_any_training(
    algorithm, task, says, mine, tmp_path
):
    done = call("run", task, "--algorithm", algorithm, cwd=tmp_path)
    assert done.returncode == 2
    assert says in done.stderr
    assert done.stderr.count("\n") == 1
    assert not any(tmp_path.iterdir()), "nothing may be left behind"


# ---- algorithms from elsewhere


@pytest.mark.first(2)
@pytest.mark.parametrize(
    ("kind", "task", "known"),
    [
        ("Derived", "unit_circle", "ppo"),
        ("Any", "unit_circle", "ppo"),
        ("Fewer", "vehicle", "ppo"),
        ("Similar", "unit_circle", "sac"),
        ("DerivedTD3", "unit_circle", "td3"),
        ("DerivedDQN", "vehicle", "dqn"),
    ],
)
@pytest.mark.slow
def test_a_class_of_the_users_trains_with_the_settings_of_its_relative(
    kind, task, known, mine, quickly_judged
):
    name = f"{mine}:{kind}"
    task = hyrl_mj.get_task(task)
    settings = replace(quick(task, name, known), samples=2_048)
    assert settings.algorithm == name
    assert algorithms.title(name) == kind.upper()
    ours = preset(task, "smoke", algorithm=known).stage1
    assert settings.options.items() <= ours.options.items()
    assert set(settings.options) == ({"n_steps"} if kind == "Fewer" else set(ours.options))
    check_foreign(task, settings)
    # Rehearsal, which takes most of the time, is tested on its own.
    assert train(task, replace(settings, rehearse=0.0), 0).algorithm == known


def test_a_module_in_the_current_folder_is_found(tmp_path, monkeypatch):
    (tmp_path / "beside_me.py").write_text("from stable_baselines3 import A2C as Mine\n")
    monkeypatch.chdir(tmp_path)
    before = list(sys.path)
    algorithms.check("beside_me:Mine", "any", None)
    assert algorithms.sb3_class("beside_me:Mine").__name__ == "A2C"
    assert sys.path == before


# ---- whole runs


WHOLE = ("run", "unit_circle", "--preset", "smoke", "--out")


def make_sac_run(folder):
    """Makes the run of the manual's page about algorithms."""
    with pytest.MonkeyPatch.context() as patch:
        few_noises(patch)
        done = call(*WHOLE, folder / "run", "--algorithm", "sac")
    assert_has_ended(done)
    (folder / "said").write_text(done.stdout)


@pytest.mark.slow
def test_a_whole_run_names_its_algorithm_and_keeps_to_it(small_runs, made_once):
    folder = made_once("circle_sac", make_sac_run)
    out = folder / "run"
    assert "policy (SAC)" in (folder / "said").read_text()
    settings = json.loads((out / "config.json").read_text())["settings"]
    assert settings["stage1"]["algorithm"] == "sac"
    assert settings["stage6"]["algorithm"] == "ppo"
    page = (out / "report.html").read_text()
    assert "SAC, 1,500 samples" in page
    assert "--algorithm sac" in page
    run = hyrl_mj.load_run(out)
    assert run.settings.stage1.algorithm == run.policy.algorithm == "sac"
    assert run.policy_title == "RL policy (SAC)"
    assert run.task.learning.algorithm == "ppo", "the task keeps its default"
    assert "train: done before" in call(*WHOLE, out, "--algorithm", "sac").stdout
    for others in ((), ("--algorithm", "td3")):
        refused = call(*WHOLE, out, *others)
        assert refused.returncode == 2
        other = others[-1] if others else "ppo"
        assert f"policy: training with sac there, training with {other} given" in refused.stderr


def test_short_episodes_are_for_tasks_that_start_everywhere(circle, monkeypatch):
    assert preset(circle).stage1.episode == 20
    monkeypatch.setattr(circle, "start_high", (3.0,))
    assert preset(circle).stage1.episode is None
