"""Records come back from JSON with their types, and a wrong field is named."""

import json
from dataclasses import asdict, dataclass, replace

import pytest
from scored import SPACING, replays, score
from sentences import assert_one_sentence_about

from hyrl_mj import BadArtifact
from hyrl_mj.files import artifacts
from hyrl_mj.judging.game.result import (
    LIMIT,
    Curve,
    EpisodeCount,
    GameResult,
    Profile,
    Robustness,
    WinningShares,
)
from hyrl_mj.learning import preset
from hyrl_mj.runs.directory import Config


@dataclass(frozen=True)
class Leaf:
    size: float
    words: tuple[str, ...] = ()


@dataclass(frozen=True)
class Stone:
    weight: float
    colour: str
    rough: bool


@dataclass(frozen=True)
class Tree:
    name: str
    rings: int
    held: Leaf | Stone
    leaves: dict[str, tuple[Leaf, ...]]
    height: float | None = None


TREE = Tree("oak", 3, Leaf(0.1), {"low": (Leaf(1.5, ("a", "b")), Leaf(2.0))})


@pytest.mark.parametrize("held", [Leaf(0.1, ("c",)), Stone(1.0, "grey", True)])
def test_a_record_comes_back(tmp_path, held):
    tree = replace(TREE, held=held)
    artifacts.write_json(tmp_path / "t.json", tree, "tree")
    assert artifacts.read_record(tmp_path / "t.json", "tree", Tree) == tree


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (("name",), None, "its name cannot be used"),
        (("rings",), "3", "its rings cannot be used .*integer"),
        (("rings",), 3.5, "its rings cannot be used"),
        (("held", "size"), "far", "its held.Leaf.size cannot be used"),
        (("held", "sise"), 1.0, "it has an unknown held.Leaf.sise"),
        (("leaves", "low", 1, "size"), [], "its leaves.low.1.size cannot be used"),
        (("leaves",), 3, "its leaves cannot be used"),
        (("extra",), 1, "it has an unknown extra"),
    ],
)
def test_a_wrong_field_of_a_record_is_named(tmp_path, path, value, message):
    content = json.loads(json.dumps(asdict(TREE)))
    inner = content
    for step in path[:-1]:
        inner = inner[step]
    inner[path[-1]] = value
    artifacts.write_json(tmp_path / "t.json", content, "tree")
    with pytest.raises(BadArtifact, match=message) as caught:
        artifacts.read_record(tmp_path / "t.json", "tree", Tree, "plant it again")
    assert_one_sentence_about(caught, tmp_path / "t.json")
    assert str(caught.value).endswith(": plant it again")


@pytest.mark.parametrize("missing", ["rings", "held", "leaves"])
def test_a_missing_field_of_a_record_is_named(missing):
    content = {name: value for name, value in asdict(TREE).items() if name != missing}
    with pytest.raises(BadArtifact, match=f"it has no {missing}"):
        artifacts.parsed(content, Tree)
    with pytest.raises(BadArtifact, match=r"it has no held\.Stone\.rough"):
        artifacts.parsed(asdict(TREE) | {"held": {"weight": 1.0, "colour": "grey"}}, Tree)


def test_a_config_is_what_was_set(tmp_path, circle):
    config = Config(preset(circle, "smoke", seed=3), {"python": "3.11"})
    artifacts.write_json(tmp_path / "config.json", config, "run")
    assert Config.load(tmp_path / "config.json") == config
    content = json.loads((tmp_path / "config.json").read_text())
    assert list(content) == ["kind", "version", "settings", "versions", "sha256"]


# ---- robustness.json


GAME = GameResult(
    everywhere=False,
    lattice=SPACING,
    scores={
        "policy": (score(0.1, 0.98, 0.92, 0.9, proved=0.91),),
        LIMIT: (score(0.1, 0.98, 1.0, 0.97, excursion=0.1),),
    },
    margin={"policy": None},
    proved_margin={"policy": None},
    why_not_proved={},
    miss_without_noise={"policy": 0.025},
    curve=Curve(
        (0.0, 0.1),
        (1.0, 0.98),
        {"policy": WinningShares((1.0, 0.9), (1.0, 0.9), (), (), (3.0, None))},
    ),
    profile=Profile(((0.0, 0.1),), {"policy": (None,)}),
    replays=(replays("policy", lost=2),),
)
COUNT = EpisodeCount(
    "uniform", 0.1, False, "policy", "near M*", 4, {"crashed": 3, "reached": 1}, 0.25, (0.1, 0.7)
)
ROBUSTNESS = Robustness(0.1, False, GAME, (COUNT,), seed=2)


@pytest.mark.parametrize("robustness", [ROBUSTNESS, Robustness(0.1, True, None, (COUNT,), 0)])
def test_a_result_comes_back_with_its_types(tmp_path, robustness):
    robustness.save(tmp_path / "r.json")
    assert Robustness.load(tmp_path / "r.json") == robustness


def test_scores_margins_and_episodes_are_where_readers_of_the_file_expect_them(tmp_path):
    ROBUSTNESS.save(tmp_path / "r.json")
    content = json.loads((tmp_path / "r.json").read_text())
    game = content["game"]
    names = ["eps", "winnable", "won", "won_any", "time", "time_any", "excursion", "open"]
    names += ["proved", "proved_any", "proved_time", "proved_time_any"]
    assert list(game["scores"]["policy"][0]) == [*names, "not_broken", "not_broken_any"]
    assert game["margin"] == {"policy": None}
    assert game["miss_without_noise"] == {"policy": 0.025}
    assert content["episodes"] == [asdict(COUNT) | {"interval": [0.1, 0.7]}]
    assert (content["eps"], content["everywhere"], content["seed"]) == (0.1, False, 2)


def test_replays_are_read_as_they_were_and_damage_is_named(tmp_path):
    path = tmp_path / "r.json"
    wins = GAME.curve.wins | {LIMIT: WinningShares((1.0, 1.0), (1.0, 1.0), (), (), (3.0, 3.0))}
    profile = replace(GAME.profile, eps=dict.fromkeys(("policy", LIMIT), (None,)))
    game = replace(GAME, curve=replace(GAME.curve, wins=wins), profile=profile)
    replace(ROBUSTNESS, game=game).save(path)
    assert Robustness.load(path, ("policy",)).game == game
    content = json.loads(json.dumps(asdict(replace(ROBUSTNESS, game=game))))
    (whole,) = content["game"]["replays"]
    of_policy, field = "its game is not one of policy", r"game\.replays\.0\.{}.*robustness RUN"
    for change, told in (
        ({"lost": {"none": 2}}, of_policy),
        ({"lost": {"none": 401, "uniform": 0}}, of_policy),
        ({"starts": {}, "lost": {}}, of_policy),
        ({"judged": 1}, of_policy),
        ({"judged": 1_001}, of_policy),
        ({"first": None}, of_policy),
        ({"of": "hoped"}, of_policy),
        ({"controller": "hyrl"}, of_policy),
        (None, of_policy),  # twice the same
        ({"judged": "all"}, field.format("judged")),
        ({"first": {"start": [0.1]}}, field.format("first")),
    ):
        content["game"]["replays"] = [whole | change] if change else [whole, whole]
        artifacts.write_json(path, content, "robustness")
        with pytest.raises(BadArtifact, match=told) as caught:
            Robustness.load(path, ("policy",))
        assert_one_sentence_about(caught, path)


def test_a_file_of_another_version_ends_in_one_sentence(tmp_path):
    content = json.loads(json.dumps(asdict(ROBUSTNESS)))
    curve, profile = content["game"]["curve"], content["game"]["profile"]
    curve |= curve.pop("wins")
    profile |= profile.pop("eps")
    artifacts.write_json(tmp_path / "r.json", content, "robustness")
    with pytest.raises(BadArtifact, match=r"r\.json: it has no game\.curve\.wins.*robustness RUN"):
        Robustness.load(tmp_path / "r.json")


def test_results_describe_themselves_in_a_line():
    assert repr(ROBUSTNESS) == (
        "Robustness(eps 0.1, GameResult(not broken at eps 0.1: policy 92.00%), 4 episodes)"
    )
    told = repr(GAME.scores["policy"][0])
    assert told.startswith(
        "Score(eps=0.1, winnable=0.98, won=0.92, won_any=0.9, time=3, time_any=3"
    )
    assert "excursion=None, open=1, proved=0.91" in told
    assert (GAME.controllers, GAME.lasting, COUNT.lost) == (("policy",), True, 3)
