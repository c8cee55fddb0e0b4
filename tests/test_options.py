"""Options: frozen values that Python and the command line share, and what a wrong or an old name is told."""

from dataclasses import FrozenInstanceError, fields

import pytest

import hyrl_mj
from hyrl_mj import AgentOptions, RunOptions
from hyrl_mj.errors import BadInput
from hyrl_mj.pipeline.runs import complete


def test_changes_are_made_on_top_of_the_options():
    options = RunOptions(eps=0.2, seed=3)
    assert complete(RunOptions, None, {"eps": 0.3}) == RunOptions(eps=0.3)
    assert complete(RunOptions, options, {"seed": 4}) == RunOptions(eps=0.2, seed=4)
    assert options == RunOptions(eps=0.2, seed=3)
    with pytest.raises(FrozenInstanceError):
        options.eps = 0.3


def test_an_agent_has_the_options_of_a_run_but_those_of_its_training_and_four_of_its_own():
    of_runs, of_agents = (
        {f.name: (f.default, f.default_factory) for f in fields(kind)}
        for kind in (RunOptions, AgentOptions)
    )
    assert {*of_runs} - {*of_agents} == {"algorithm", "go_on", "stage1_minutes"}
    assert {*of_agents} - {*of_runs} == {"activation", "stochastic", "vecnormalize", "n_stack"}
    for name in {*of_runs} & {*of_agents}:
        assert of_runs[name] == of_agents[name]


@pytest.mark.parametrize(
    ("options", "changes", "parts"),
    [
        (None, {"sed": 3}, ["unknown option 'sed': choose one of", "Did you mean 'seed'?"]),
        (0.2, {}, ["options 0.2 cannot be used: give", "Options(...)"]),
        (RunOptions, {"activation": "tanh"}, ["unknown option 'activation'"]),
        (None, {"preset": "quick"}, ["unknown preset 'quick'", "fast, paper, smoke"]),
        (None, {"eps": "much"}, ["noise bound 'much'", "give a finite number"]),
    ],
)
def test_a_wrong_option_is_one_sentence_and_leaves_nothing(
    options, changes, parts, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    cases = [(hyrl_mj.run, ("vehicle",))]
    if options is not RunOptions:
        cases += [(work, ("vehicle", "a.zip")) for work in (hyrl_mj.robustify, hyrl_mj.diagnose)]
    for work, arguments in cases:
        with pytest.raises(BadInput) as refused:
            work(*arguments, RunOptions() if options is RunOptions else options, **changes)
        assert [part for part in parts if part not in str(refused.value)] == []
    assert not any(tmp_path.iterdir())
