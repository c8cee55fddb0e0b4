"""Comparisons: the alternatives do what they say, and all of them are made, tuned and judged alike."""

import shutil
import sys
from copy import copy
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
import torch
from command_line import call
from planted import FEW_CELLS, few_noises, played_before, without_videos

import hyrl_mj
from hyrl_mj import BadInput
from hyrl_mj.alternatives import Alternative, Candidate, Given, Unfit, base, register, registered
from hyrl_mj.alternatives.adversary import LearnedNoise, train_adversary
from hyrl_mj.alternatives.filters import KalmanFilter, MovingAverage
from hyrl_mj.alternatives.held import HeldInputs, HeldLevels
from hyrl_mj.alternatives.mixture import COMPONENTS, Mixture, MixtureController, MixturePolicy
from hyrl_mj.alternatives.smooth import PairedBuffer, SmoothPolicy
from hyrl_mj.alternatives.timer import TimerSupervisor, returns
from hyrl_mj.alternatives.training import environment, learned
from hyrl_mj.files import artifacts
from hyrl_mj.judging import ModeResult, examination
from hyrl_mj.judging.game import ReplayCount
from hyrl_mj.learning.training import export
from hyrl_mj.pipeline import comparing, steps, sweeping
from hyrl_mj.policies import PolicyController, from_callable
from hyrl_mj.runs.compared import Compared, Row
from hyrl_mj.sets import Grid
from hyrl_mj.simulation import LoopSettings, closed_loop
from hyrl_mj.stages import retraining
from hyrl_mj.tasks import Outcome
from hyrl_mj.viz.compared_page import write_page
from hyrl_mj.viz.compared_tables import print_compared, ranked, result_table, sentences, tried_table

RUNS = {"preset": "smoke", "set": FEW_CELLS}


@pytest.fixture(scope="module")
def given(planted_circle):
    """What alternatives may use of the planted run, with hardly any samples."""

    few = copy(planted_circle[0].task)
    few.effort = replace(few.effort, checkpoints=1)

    class Little(Given):
        samples, task = 2_048, few

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(base, "TRIED", 8)
        yield Little(planted_circle[0], 0)


@pytest.fixture(scope="module")
def seeking(vehicle):
    """A policy on the vehicle's levels: away from the axis, the more the nearer."""
    return from_callable(lambda o: np.where(o[:, 2] > 0, 4, 0), vehicle)


# ---- held inputs


def test_an_input_on_levels_is_held_for_its_samples(vehicle, seeking):
    held = HeldLevels(vehicle, seeking, 3)
    assert held.modes == tuple(range(1 + 5 * 2))
    above, below = vehicle.at(np.array([[1.0, 0.5]])), vehicle.at(np.array([[1.0, -0.5]]))
    q = held.initial_mode(above)
    applied = []
    for measured in (above, below, below, below, above):
        u, q = held.step(q, measured)
        assert q[0] in held.modes
        applied.append(u[0, 0])
    one, other = seeking.act(above)[0, 0], seeking.act(below)[0, 0]
    assert one != other
    assert applied == [one, one, one, other, other]


def test_inputs_held_for_one_sample_are_those_of_the_policy(vehicle, seeking):
    z = vehicle.chart.draw(50, np.random.default_rng(0))
    held = HeldLevels(vehicle, seeking, 1)
    u, q = held.step(np.zeros(50, int), vehicle.at(z))
    np.testing.assert_array_equal(u, seeking.act(vehicle.at(z)))
    assert not q.any()


def test_a_continuous_input_is_held_in_the_memory(circle):
    policy = from_callable(lambda o: o[:, :1], circle)
    held, memory = HeldInputs(circle, policy, 2), np.zeros((1, 2))
    applied = []
    for theta in (0.1, 0.2, 0.3, 0.4):
        u, memory = held.act_after(memory, np.array([[theta]]))
        applied.append(u[0])
    expected = [policy.act(np.array([[theta]]))[0] for theta in (0.1, 0.1, 0.3, 0.3)]
    np.testing.assert_array_equal(applied, expected)


# ---- filters


class Noting:
    """A policy that notes what it is asked."""

    def __init__(self, task):
        self.task, self.asked = task, []

    def act(self, measured):
        self.asked.append(measured.copy())
        return np.zeros((len(measured), len(self.task.inputs)))


def test_a_moving_average_is_the_mean_of_the_last_points(vehicle):
    noting = Noting(vehicle)
    average = MovingAverage(vehicle, noting, 3)
    z = np.array([[0.2, 0.1], [0.3, 0.4], [0.4, -0.2], [0.5, 0.3]])
    memory = average.start(1)
    for one in z:
        _, memory = average.act_after(memory, vehicle.at(one[None]))
    expected = [z[:1].mean(axis=0), z[:2].mean(axis=0), z[:3].mean(axis=0), z[1:].mean(axis=0)]
    np.testing.assert_allclose([vehicle.z(m)[0] for m in noting.asked], expected, atol=1e-12)


def test_a_moving_average_goes_over_the_seam_of_the_circle(circle):
    noting = Noting(circle)
    average = MovingAverage(circle, noting, 2)
    memory = average.start(1)
    for theta in (3.1, -3.1):
        _, memory = average.act_after(memory, np.array([[theta]]))
    assert np.cos(noting.asked[-1][0, 0]) == pytest.approx(-1, abs=1e-6)


def test_a_kalman_filter_without_drift_averages_all_measurements(vehicle):
    """The model is exact: the error of the estimate is the mean of the errors of all measurements."""
    noting = Noting(vehicle)
    kalman = KalmanFilter(vehicle, noting, 0.0)
    plant, errors = vehicle.placed(np.array([[0.2, 0.3]])), [0.1, -0.04, 0.06, 0.02]
    memory = kalman.start(1)
    for k, error in enumerate(errors):
        true = vehicle.z(plant.measurement)
        measured = vehicle.at(true + np.array([[0.0, error]]))
        u, memory = kalman.act_after(memory, measured)
        estimate = vehicle.z(noting.asked[-1])
        np.testing.assert_allclose(estimate - true, [[0, np.mean(errors[: k + 1])]], atol=1e-9)
        plant.step(u)
    assert len(kalman._plants) == 1


def test_filters_close_loops(vehicle, seeking):
    z = vehicle.starts(6, np.random.default_rng(0))
    for policy in (MovingAverage(vehicle, seeking, 3), KalmanFilter(vehicle, seeking, 0.1)):
        run = closed_loop(vehicle, PolicyController(policy), z, settings=LoopSettings(quiet=True))
        assert (run.outcome != Outcome.RUNNING).all()


# ---- memory


def test_recurrent_says_what_is_missing(given, monkeypatch):
    monkeypatch.setitem(sys.modules, "sb3_contrib", None)
    with pytest.raises(Unfit, match="pip install sb3-contrib"):
        next(registered()["recurrent"].candidates(given))


# ---- smooth


def test_the_next_observation_is_that_of_the_same_episode():
    box = gym.spaces.Box(-1, 1, (1,), np.float32)
    buffer = PairedBuffer(4, box, box, "cpu", n_envs=2)
    begins = np.array([[1, 1], [0, 0], [1, 0], [0, 0]])
    for k in range(4):
        obs, zero = np.array([[k], [10 + k]], np.float32), torch.zeros(2)
        buffer.add(obs, np.zeros((2, 1)), np.zeros(2), begins[k], zero, zero)
    pairs = {tuple(row) for row in next(buffer.get(8)).observations.numpy().tolist()}
    first = {(0, 1), (1, 1), (2, 3), (3, 3)}  # a new episode begins at 2
    assert pairs == first | {(10, 11), (11, 12), (12, 13), (13, 13)}


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["CAPS", "Lipschitz"])
def test_a_heavy_penalty_makes_the_policy_flat(given, kind):
    steep = {}
    for weight in (0.0, 1e4):
        model = learned(
            given,
            environment(given),
            lambda model: PolicyController(export(model, given.task)),
            policy=SmoothPolicy,
            kind=kind,
            weight=weight,
            deviation=0.1,
            options={"ent_coef": 1e-3, "rollout_buffer_class": PairedBuffer},
        )
        u = export(model, given.task).act(np.linspace(-3, 3, 200)[:, None])
        steep[weight] = np.abs(np.diff(u[:, 0])).max()
    assert steep[1e4] < steep[0.0] / 2


@pytest.mark.slow
def test_a_training_that_breaks_off_is_one_sentence(given, monkeypatch):
    def broken(self):
        raise ValueError("the parameter loc holds nan")

    monkeypatch.setattr("stable_baselines3.PPO.train", broken)
    with pytest.raises(BadInput, match=r"its training broke off after .* samples .*holds nan"):
        learned(
            given, environment(given), lambda model: PolicyController(export(model, given.task))
        )


# ---- mixture


@pytest.mark.parametrize("levels", [False, True])
def test_the_probability_of_a_mixture_is_the_sum_over_its_components(levels):
    size, rng = 2, torch.Generator().manual_seed(0)
    mixture = Mixture(size, levels)
    outputs = torch.randn(3, COMPONENTS * (1 + size), generator=rng)
    mixture.proba_distribution(outputs=outputs, log_std=torch.zeros(size))
    gate, parts = mixture.parts(outputs)
    x = torch.tensor([0, 1, 0]) if levels else torch.randn(3, size, generator=rng)
    each = []
    for k in range(COMPONENTS):
        if levels:
            one = torch.distributions.Categorical(logits=parts[:, k]).log_prob(x)
        else:
            one = torch.distributions.Normal(parts[:, k], 1.0).log_prob(x).sum(dim=1)
        each.append(gate.softmax(dim=1)[:, k] * one.exp())
    np.testing.assert_allclose(mixture.log_prob(x).exp(), sum(each), rtol=1e-5)
    best = gate.argmax(dim=1)
    chosen = parts[torch.arange(3), best]
    np.testing.assert_array_equal(mixture.mode(), chosen.argmax(dim=1) if levels else chosen)


@pytest.mark.slow
def test_the_component_of_the_first_measurement_is_held(given):
    model = learned(
        given,
        environment(given),
        lambda model: MixtureController(given.task, model.policy, False),
        policy=MixturePolicy,
    )
    held = MixtureController(given.task, model.policy, True)
    z = np.linspace(-3, 3, 40)[:, None]
    q = held.initial_mode(z)
    gate, parts = model.policy.outputs(given.task.observation(z))
    np.testing.assert_array_equal(q, gate.argmax(axis=1))
    u, after = held.step(1 - q, z)
    np.testing.assert_array_equal(after, 1 - q)
    other = parts[np.arange(40), 1 - q].astype(float)
    np.testing.assert_allclose(u, np.clip(other, *given.task.input_limits))


# ---- timer


def test_the_supervisor_keeps_a_policy_for_its_time(circle):
    grid = Grid.with_cells(circle.chart, 8)
    one, other = (
        from_callable(lambda o, v=v: np.full((len(o), 1), v), circle) for v in (0.5, -0.5)
    )
    theta = grid.nodes[:, 0]
    values = np.stack([np.sin(theta), -np.sin(theta)])
    timer = TimerSupervisor(circle, (one, other), grid, values, 2, 0.0)
    right, left = np.array([[1.0]]), np.array([[-1.0]])
    q, acts = timer.initial_mode(right), []
    for measured in (left, left, left, right, right, right, right):
        u, q = timer.step(q, measured)
        acts.append(u[0, 0])
    assert acts == [0.5, 0.5, -0.5, -0.5, -0.5, 0.5, 0.5]
    slow = replace(timer, better=1.0)
    assert slow.step(np.array([0]), left)[0][0, 0] == 0.5


def test_the_value_of_a_failure_is_the_worst_reward_for_ever(vehicle):
    into = from_callable(lambda o: np.full(len(o), 2), vehicle)
    at = np.array([[0.9, 0.0]])
    run = closed_loop(vehicle, PolicyController(into), at)
    assert run.outcome[0] == Outcome.CRASHED
    value = returns(vehicle, into, at, 0.9)[0]
    assert value < 0.9 ** run.length[0] * vehicle.worst_reward / 0.1 + 1e-9


# ---- adversary


@pytest.mark.slow
def test_learned_noise_keeps_its_bound(given):
    noise = train_adversary(given, given.run.policy, 2_048, 0)
    assert isinstance(noise, LearnedNoise)
    z = given.task.starts(64, np.random.default_rng(0))
    settings = LoopSettings(record=True, quiet=True)
    run = closed_loop(given.task, given.run.controllers["policy"], z, noise, settings=settings)
    size = np.abs(run.measured - run.true[:-1])
    assert 0 < np.nanmax(size) <= given.eps + 1e-9


# ---- what is given


def test_an_alternative_gets_the_samples_of_the_whole_run(planted_circle):
    run = planted_circle[0]
    s, attempts = run.settings, sum(mode.attempts for mode in run.retraining.modes)
    given = Given(run, 0)
    assert given.samples == s.stage1.samples + s.stage6.samples * attempts
    assert given.training().samples == given.samples
    assert given.training().algorithm == s.stage1.algorithm


@pytest.mark.slow
def test_an_alternative_is_paid_as_stage_1_was_and_takes_no_more_samples(
    planted_circle, monkeypatch
):
    run = planted_circle[0].anew()
    vars(run)["arrivals"] = replace(planted_circle[0].arrivals, trainings=2, shaped=True)
    given = Given(run, 0)
    (policy,) = registered()["policy"].candidates(given)
    assert policy.samples == given.first == 2 * run.settings.stage1.samples
    assert given.training().shaped
    assert given.training("ppo").shaped
    assert environment(given).core.domain.pay is not None
    asked = []

    def retrained(ground, settings, seed, warm_start):
        asked.append((ground.shaped, settings.samples * settings.attempts <= given.samples))
        return run.policy, ModeResult(0, 1.0, 1)

    monkeypatch.setattr(retraining, "retrain", retrained)
    monkeypatch.setitem(vars(run), "settings", replace(run.settings, stage6=replace(
        run.settings.stage6, attempts=50)))  # fmt: skip
    assert len([*registered()["retraining"].candidates(given)]) == 1
    assert asked == [(True, True)]


def test_hysteresis_alone_goes_on_beyond_the_decision_of_the_policy(given):
    (candidate,) = registered()["hysteresis"].candidates(given)
    ahead, beyond = np.array([[np.pi - 0.5]]), np.array([[np.pi + 0.05]])
    q = candidate.acts.initial_mode(ahead)
    u, after = candidate.acts.step(q, beyond)
    assert after == q
    assert (
        np.sign(u) == np.sign(given.run.policy.act(ahead)) != np.sign(given.run.policy.act(beyond))
    )


# ---- the comparison


@pytest.fixture(scope="module")
def folder(planted_circle, tmp_path_factory):
    """A comparison of the planted circle, of which some rows are made."""
    run, _ = planted_circle
    folder = tmp_path_factory.mktemp("compare") / "circle"
    folder.mkdir()
    shutil.copytree(run.path, folder / "hyrl-0")
    settings = run.settings
    fresh = Compared(settings.task, settings.eps, "smoke", FEW_CELLS, True)
    fresh.save(folder)
    return folder


@pytest.fixture(scope="module")
def small():
    """Comparisons with little noise and no video."""
    with pytest.MonkeyPatch.context() as patch:
        few_noises(patch)
        without_videos(patch)
        patch.setattr(comparing, "CHOICE_STARTS", 16)
        patch.setattr(comparing, "CHOICE_ROUNDS", 1)
        patch.setattr(comparing, "EPISODES", 64)
        little = replace(steps.SPARING, episodes=20, attack_starts=12, attack_rounds=1)
        patch.setattr(steps, "SPARING", little)
        yield


@pytest.fixture(scope="module")
def result(folder, small):
    said = []
    found = hyrl_mj.compare("unit_circle", out=folder, only=("held",), say=said.append, **RUNS)
    return found, said


@pytest.mark.slow
def test_rows_are_made_tuned_and_judged_alike(result, folder, planted_circle):
    found, said = result
    assert len({row.figures["attacked"] for row in found.rows}) == 1
    assert [row.name for row in found.rows] == ["policy", "hyrl", "held"]
    assert all(row.state == "done" for row in found.rows)
    rows = {row.name: row for row in found.rows}
    assert {*rows["hyrl"].figures} >= {"worst", "lost_quiet", "miss", "variation", "won", "proved"}
    # Of what remembers there is no game.
    assert "won" not in rows["held"].figures
    assert {*rows["held"].tried} == {f"{k} samples" for k in (2, 3, 5, 8)}
    assert rows["held"].tried[rows["held"].sentence] == max(rows["held"].tried.values())
    # By the game, as in the run's own examination.
    game = planted_circle[0].robustness.game
    assert rows["hyrl"].figures["won"] == game.scores["hyrl"][-1].not_broken
    assert rows["hyrl"].figures["proved"] == game.scores["hyrl"][-1].proved
    # Nothing is won where a replay has lost what the game calls won.
    assert game.scores["policy"][-1].not_broken == 1
    assert game.replays_of("policy").failures
    assert not {"won", "proved"} & {*rows["policy"].figures}
    assert any(text.startswith("held: ") for text in said)
    assert Compared.load(folder) == found


@pytest.mark.slow
def test_what_is_done_is_not_done_again(result, folder, monkeypatch):
    monkeypatch.setattr(comparing, "judged", None)
    said = []
    again = hyrl_mj.compare("unit_circle", out=folder, only=("held",), say=said.append, **RUNS)
    assert again == result[0]
    assert said == ["seed 0: done before"]


@pytest.mark.slow
def test_rows_of_other_code_are_made_again(result, circle):
    found, said = result[0], []
    assert comparing._without_outdated(found, circle, said.append) == found
    held = found.row("held", 0)
    edited = replace(held, code=held.code[:64] + 64 * "0")
    strange = replace(held, name="not imported here")  # may be what it was
    changed = found.with_row(edited).with_row(strange)
    assert comparing._without_outdated(changed, circle, said.append).names == (
        *(name for name in found.names if name != "held"),
        "not imported here",
    )
    (sentence,) = said
    assert sentence.startswith("held: left out, because their code or that of the task has changed")
    task = copy(circle)
    vars(task)["code"] = "another"
    assert comparing._without_outdated(changed, task, len).rows == ()


def never(monkeypatch, mistake=None):
    """Registers, in this test alone, an alternative that ends in a mistake after its first setting."""
    monkeypatch.setattr(base, "_KNOWN", dict(base._KNOWN))

    @register
    class Never(Alternative):
        name = title = "never"

        def candidates(self, given):
            if mistake is None:
                return
            yield Candidate("first", given.run.controllers["policy"])
            raise mistake


@pytest.mark.parametrize(
    ("mistake", "says"),
    [
        (BadInput("nothing fits it"), "nothing fits it"),
        (ValueError("nothing fits it"), "it raises ValueError: nothing fits it"),
        (None, "yields no setting"),
    ],
)
def test_an_alternative_that_makes_a_mistake_is_unfit(mistake, says, planted_circle, monkeypatch):
    never(monkeypatch, mistake)
    row = comparing.judged(planted_circle[0], "never", seed=0)
    assert row.state == "unfit"
    assert says in row.sentence


@pytest.mark.parametrize("labels", [range(21), "aa"])
def test_settings_that_no_comparison_holds_are_none(labels, planted_circle, monkeypatch):
    class Many(Alternative):
        name, title = "many", "Many " * 50

        def candidates(self, given):
            for label in labels:
                yield Candidate(f"{label}", given.run.controllers["policy"])

    monkeypatch.setattr(base, "_KNOWN", {**base._KNOWN, "many": Many()})
    row = comparing.judged(planted_circle[0], "many", seed=0)
    assert (row.state, row.why_not) == ("unfit", None)
    assert "let it yield fewer, each with a short label of its own" in row.sentence
    task = planted_circle[0].task
    for file in (None, "<stdin>"):  # of a notebook, and where code is piped into Python
        monkeypatch.setattr(sys.modules[__name__], "__file__", file)
        assert comparing._code(task, "many") != comparing._code(task, "many")


@pytest.mark.slow
def test_what_did_not_fit_is_tried_again(result, folder, small, monkeypatch):
    never(monkeypatch, Unfit("nothing fits it"))
    said = []
    for _ in range(2):  # what did not fit may fit now, as where a package was missing
        found = hyrl_mj.compare("unit_circle", out=folder, only=("never",), say=said.append, **RUNS)
    assert said.count("never: nothing fits it") == 2
    assert any("nothing fits it" in sentence for sentence in sentences(found))


def test_a_name_is_that_of_one_alternative():
    with pytest.raises(BadInput, match=r"'hyrl' is already hyrl_mj\.alternatives\.ablation\.Hyrl"):
        register(type("Mine", (Alternative,), {"name": "hyrl", "candidates": None}))


def test_an_alternative_cannot_change_the_run_of_the_others(planted_circle, monkeypatch):
    run = planted_circle[0]
    before = run.policy.layers[0][0].copy()

    class Writes(Alternative):
        name = title = "writes"

        def candidates(self, given):
            given.run.policy.layers[0][0][:] = 0
            raise Unfit("done")

    monkeypatch.setattr(base, "_KNOWN", {**base._KNOWN, "writes": Writes()})
    assert comparing.judged(run, "writes", seed=0).sentence == "done"
    np.testing.assert_array_equal(run.policy.layers[0][0], before)


@pytest.mark.slow
def test_no_controller_is_attacked_from_starts_of_its_own(planted_circle, small, monkeypatch):
    """Which are winnable is known only where the game is played, and by HyRL's split."""
    run = planted_circle[0]
    played_before(monkeypatch, run)

    def begun(task, regions, *_):
        raise BadInput(f"winnable: {regions.winnable}")

    monkeypatch.setattr(examination, "attack_starts", begun)
    with pytest.raises(BadInput, match="winnable: None"):
        comparing.figures_of(run, run.controllers["hyrl"], 0)


@pytest.mark.parametrize("lost", [0, 3])
def test_what_a_replay_refutes_is_not_won(planted_circle, lost):
    result = planted_circle[0].robustness
    played = ReplayCount("one", 0.1, False, "proved", {"none": 9}, {"none": lost}, 1, None)
    game = replace(result.game, scores={"one": result.game.scores["hyrl"]}, replays=(played,))
    found = comparing._shares(replace(result, game=game, attacks=(), comparisons=()))
    assert ("won" in found) == ("proved" in found) == (not lost)


def test_sensors_that_a_task_declares_are_compared_and_not_swept(circle, tmp_path, monkeypatch):
    task, asked = copy(circle), []
    task.sensor = "uniform 0.05 + bias 0.05 + delay 1"
    for module in (comparing, sweeping):
        monkeypatch.setattr(module, "usable_task", lambda task: task)

    def made(task, options, say):
        asked.append(options)
        raise BadInput("enough")

    monkeypatch.setattr(comparing, "run", made)
    with pytest.raises(BadInput, match="enough"):
        hyrl_mj.compare(task, out=tmp_path / "compare")
    assert comparing.settings_of(task, asked[0]).sensor == task.sensor
    with pytest.raises(BadInput, match=r"declares what its sensors do .*give --eps"):
        hyrl_mj.sweep([task], out=tmp_path / "sweep")


@pytest.mark.slow
def test_the_page_shows_the_figure_and_the_table(result, folder):
    page = (folder / "compare.html").read_text()
    assert "data:image/png" in page
    for text in ("inputs held", "How each alternative was tuned"):
        assert text in page
    assert (folder / "compare.png").stat().st_size > 5_000


@pytest.mark.slow
def test_wrong_values_are_a_sentence_each(result, folder, tmp_path):
    with pytest.raises(BadInput, match="alternative 'helt'"):
        hyrl_mj.compare("unit_circle", only=("helt",), out=folder)
    with pytest.raises(BadInput, match="at least one seed"):
        hyrl_mj.compare("unit_circle", seeds=(), out=folder)
    with pytest.raises(BadInput, match=r"holds a comparison of unit_circle with eps 0\.1"):
        hyrl_mj.compare("unit_circle", eps=0.2, out=folder)
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(BadInput, match="not the folder of a comparison"):
        hyrl_mj.compare("unit_circle", out=tmp_path)
    code, _, error = call("compare", "unit_circle", "--only", "helt", "--out", str(folder))
    assert code == 2
    assert error.count("\n") == 1


@pytest.mark.slow
def test_a_comparison_that_ended_before_its_first_row_is_resumed(tmp_path, monkeypatch):
    def ended(*arguments, **options):
        (tmp_path / "compare" / "hyrl-0").mkdir(exist_ok=True)
        raise KeyboardInterrupt

    monkeypatch.setattr(comparing, "run", ended)
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            hyrl_mj.compare("unit_circle", out=tmp_path / "compare", say=len)


def many(**more):
    return tuple(Row(f"{i}", "Many", 0, "done", **more) for i in range(51))


@pytest.mark.parametrize(
    "rows",
    [
        many(),
        2 * (Row("held", "Held", 0),),
        (Row("held", "H" * 101, 0),),
        (Row("held", "Held", 0, sentence="a" * 2_000),),
        (Row("held", "Held", -1),),
        (Row("held", "Held", 0, samples=10**400),),
        (Row("held", "Held", 0, figures={"worst": np.inf}),),
        (Row("held", "Held", 0, figures={"worst": np.nan}),),
        (Row("held", "Held", 0, tried=dict.fromkeys(map(str, range(21)), 0.5)),),
    ],
)
def test_a_comparison_that_nobody_makes_is_refused(rows, tmp_path):
    Compared("unit_circle", 0.1, "fast", {}, True, rows).save(tmp_path)
    with pytest.raises(artifacts.BadArtifact, match=r"compare\.json has"):
        Compared.load(tmp_path)


def test_a_json_file_has_a_limit_of_parts(tmp_path):
    Compared("unit_circle", 0.1, "fast", {"a": [[]] * 20_000}, True).save(tmp_path)
    with pytest.raises(artifacts.BadArtifact, match="more than 10,000 parts"):
        Compared.load(tmp_path)


# ---- tables


def test_where_nothing_fits_the_reasons_are_left(capsys, tmp_path):
    unfit = Row("recurrent", "RecurrentPPO", 0, "unfit", "it lacks sb3-contrib")
    found = Compared("unit_circle", 0.1, "fast", {}, True, (unfit,))
    print_compared(found)
    write_page(found, tmp_path)
    told = "RecurrentPPO, seed 0: it lacks sb3-contrib."
    assert told in capsys.readouterr().out
    assert told in (tmp_path / "compare.html").read_text()


def row(name, seed, worst, **more):
    figures = {"worst": worst, "lost_quiet": 0.0, "miss": 0.1, "variation": 1.0, "late": 0.0}
    return Row(name, name.title(), seed, "done", "as made", figures=figures | more)


@pytest.fixture
def three():
    rows = [row("policy", s, 0.5) for s in range(3)]
    rows += [row("hyrl", s, w, won=1.0) for s, w in enumerate((0.9, 0.95, 1.0))]
    rows += [row("stack", s, w) for s, w in enumerate((0.95, 1.0, 1.0))]
    rows += [Row("table", "Table", 0, "unfit", "the chart has 5 dimensions")]
    return Compared("vehicle", 0.1, "fast", {}, True, tuple(rows))


def test_an_alternative_that_wins_stands_first(three):
    assert ranked(three) == ["stack", "hyrl", "policy"]
    first, second = sentences(three)
    assert "The best alternative is Stack" in first
    assert "3.33 percentage points less" in first
    assert "95% interval -5.00 to +0.00" in first
    assert second == "Table, seed 0: the chart has 5 dimensions."
    table = result_table(three)
    assert table.rows[0][0] == "Stack"
    assert "98.33% (95.00% to all tried)" in table.rows[0]
    assert tried_table(three) is None


def test_of_alternatives_without_a_seed_in_common_nothing_is_said(three):
    apart = replace(
        three, rows=tuple(replace(r, seed=r.seed + 3 * (r.name == "stack")) for r in three.rows)
    )
    assert [*sentences(apart)] == ["Table, seed 0: the chart has 5 dimensions."]
    # A file of a stranger's may leave a figure out.
    bare = replace(three, rows=tuple(replace(r, figures={}) for r in three.rows))
    assert [*sentences(bare)] == ["Table, seed 0: the chart has 5 dimensions."]


def test_without_three_seeds_there_is_no_interval(three):
    few = replace(three, rows=tuple(r for r in three.rows if r.seed < 2))
    assert few.difference("stack").interval is None


def test_seeds_that_an_alternative_lacks_are_told(three):
    """What is said of two is of the seeds that both have."""
    one = [row for row in three.rows if row.name != "stack" or row.seed == 0]
    refuted = row("policy", 1, 0.5, won=1.0)
    found = replace(three, rows=tuple(one)).with_row(refuted)
    sentence = next(sentences(found))
    assert "wins from 95.00% of the starts under attack; HyRL wins from 90.00%, 5.00" in sentence
    assert sentence.endswith("in 1 of 3 seeds.")
    cells = {row[0]: row for row in result_table(found).rows}
    assert "Stack, 1 of 3 seeds" in cells
    assert "all tried, none in 2 of 3 seeds" in cells["Policy"]


def test_what_lacks_the_hard_seeds_is_no_better_for_it(three):
    rows = [row("hyrl", 0, 1.0), row("hyrl", 1, 0.5), row("stack", 0, 0.99), row("noise", 1, 0.6)]
    found = replace(three, rows=tuple(rows))
    assert ranked(found) == ["noise", "hyrl", "stack"]


def test_a_tie_is_one_and_starts_that_were_tried_have_an_error():
    rows = [row(name, s, 0.9, attacked=100.0) for name in ("hyrl", "stack") for s in range(3)]
    found = Compared("vehicle", 0.1, "fast", {}, True, tuple(rows))
    assert ranked(found) == ["stack", "hyrl"]
    (sentence,) = sentences(found)
    assert "as many (95% interval -" in sentence
    low, high = found.difference("stack").interval
    off = 1.96 * (2 * 0.9 * 0.1 / 300) ** 0.5
    assert (low, high) == pytest.approx((-off, off), abs=0.01)
