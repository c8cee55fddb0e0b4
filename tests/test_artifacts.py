"""Artifacts come back as they were, are replaced whole or not at all, and named if damaged."""

import json
import os
import pickle
from dataclasses import asdict, dataclass, replace

import numpy as np
import pytest

import hyrl_mj
from hyrl_mj import BadArtifact, BadInput, CriticalSet, artifacts
from hyrl_mj.game import Maps
from hyrl_mj.learning import preset
from hyrl_mj.run_directory import Config
from hyrl_mj.sets import Grid, GridSet
from hyrl_mj.stages.extended_sets import ExtendedSets
from hyrl_mj.stages.partition import Partition

ARRAYS = {"a": np.arange(500.0).reshape(50, 10), "name": np.array("word"), "flag": np.array([True])}
CONTENT = {"x": 1.5, "items": [1, 2, 3]}


class Bomb:
    """What must never go off: unpickling this would make a file."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


def write(kind, path):
    if kind == "npz":
        artifacts.write_arrays(path, ARRAYS, "thing")
    elif kind == "json":
        artifacts.write_json(path, CONTENT, "thing")
    else:
        artifacts.write_tensors(path, {"a": np.float32(ARRAYS["a"])})


def read(kind, path, what="thing"):
    if kind == "npz":
        return artifacts.read_arrays(path, what)
    return artifacts.read_json(path, what) if kind == "json" else artifacts.read_tensors(path)


@pytest.fixture(params=["npz", "json", "safetensors"])
def kind(request):
    return request.param


@pytest.fixture
def path(kind, tmp_path):
    path = tmp_path / "folder" / f"file.{kind}"
    write(kind, path)
    return path


def assert_one_sentence_about(error, path):
    text = str(error.value)
    assert str(path) in text
    assert "\n" not in text
    assert len(text) < 500


# ---- there and back


def test_arrays_come_back(tmp_path):
    write("npz", tmp_path / "a.npz")
    back = read("npz", tmp_path / "a.npz")
    assert back.keys() == ARRAYS.keys()
    for name, values in ARRAYS.items():
        np.testing.assert_array_equal(back[name], values)
        assert back[name].dtype == values.dtype


def test_json_comes_back(tmp_path):
    write("json", tmp_path / "a.json")
    assert read("json", tmp_path / "a.json") == CONTENT


def test_tensors_come_back_whatever_their_layout(tmp_path):
    transposed = np.arange(6, dtype=np.float32).reshape(2, 3).T
    artifacts.write_tensors(tmp_path / "a.safetensors", {"t": transposed})
    np.testing.assert_array_equal(read("safetensors", tmp_path / "a.safetensors")["t"], transposed)


def test_nothing_else_is_left_in_the_folder(path):
    assert [p.name for p in path.parent.iterdir()] == [path.name]


# ---- damage


def test_a_missing_file_names_the_cure(kind, tmp_path):
    with pytest.raises(BadArtifact, match="run the stage that writes it") as caught:
        read(kind, tmp_path / f"no.{kind}")
    assert_one_sentence_about(caught, tmp_path / f"no.{kind}")


@pytest.mark.parametrize("share", [0.0, 0.01, 0.3, 0.9, 0.95])
def test_a_truncated_file_is_a_bad_artifact(kind, path, share):
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(BadArtifact) as caught:
        read(kind, path)
    assert_one_sentence_about(caught, path)


def test_noise_in_a_file_is_a_bad_artifact_or_harmless(kind, path):
    whole, rng = path.read_bytes(), np.random.default_rng(0)
    for place in rng.integers(0, len(whole), 200):
        damaged = bytearray(whole)
        damaged[place] ^= 0xFF
        path.write_bytes(damaged)
        try:
            read(kind, path)
        except BadArtifact:
            pass
        except Exception as error:
            pytest.fail(f"byte {place}: {type(error).__name__}: {error}")


JSONS = ["3", "null", '"word"', "[]", "[1]", "{}", "{", '{"kind": "thing"}']


@pytest.mark.parametrize("text", JSONS)
def test_json_that_is_not_ours(tmp_path, text):
    path = tmp_path / "a.json"
    path.write_text(text)
    with pytest.raises(BadArtifact) as caught:
        artifacts.read_json(path, "thing")
    assert_one_sentence_about(caught, path)


def test_an_npz_that_is_not_ours(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, a=np.zeros(3))
    with pytest.raises(BadArtifact):
        artifacts.read_arrays(path, "thing")
    np.save(tmp_path / "b.npy", np.zeros(3))
    (tmp_path / "b.npy").rename(path)
    with pytest.raises(BadArtifact):
        artifacts.read_arrays(path, "thing")


def test_another_version_is_named(tmp_path):
    path = tmp_path / "a.json"
    path.write_text(json.dumps({"kind": "thing", "version": 99}))
    with pytest.raises(BadArtifact, match=r"version 99.*reads version 1") as caught:
        artifacts.read_json(path, "thing")
    assert_one_sentence_about(caught, path)
    np.savez(tmp_path / "a.npz", kind=np.array("thing"), version=np.array(99))
    with pytest.raises(BadArtifact, match="version 99"):
        artifacts.read_arrays(tmp_path / "a.npz", "thing")


@pytest.mark.parametrize("ending", ["json", "npz"])
def test_another_kind_is_named(ending, tmp_path):
    write(ending, tmp_path / f"a.{ending}")
    with pytest.raises(BadArtifact, match=r"'thing', not 'other thing'"):
        read(ending, tmp_path / f"a.{ending}", "other thing")


def test_a_pickle_in_an_npz_is_refused_and_not_run(tmp_path):
    path, crater = tmp_path / "a.npz", tmp_path / "crater"
    bomb = np.array([Bomb(crater)], dtype=object)
    np.savez(path, kind=np.array("thing"), version=np.array(1), a=bomb)
    with pytest.raises(BadArtifact):
        artifacts.read_arrays(path, "thing")
    assert not crater.exists()


@pytest.mark.parametrize("ending", ["json", "npz", "safetensors"])
def test_a_pickle_under_another_name_is_refused_and_not_run(ending, tmp_path):
    path, crater = tmp_path / f"a.{ending}", tmp_path / "crater"
    path.write_bytes(pickle.dumps(Bomb(crater)))
    with pytest.raises(BadArtifact):
        read(ending, path)
    assert not crater.exists()


# ---- writing


def test_an_interrupted_write_leaves_the_old_file(path):
    before = path.read_bytes()

    def interrupted():
        with artifacts.replacing(path) as temporary:
            temporary.write_bytes(before[:10])
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert path.read_bytes() == before
    assert [p.name for p in path.parent.iterdir()] == [path.name]


def test_a_failed_write_leaves_the_old_file(tmp_path):
    write("json", tmp_path / "a.json")
    before = (tmp_path / "a.json").read_bytes()
    with pytest.raises(TypeError):
        artifacts.write_json(tmp_path / "a.json", {"x": object()}, "thing")
    assert (tmp_path / "a.json").read_bytes() == before
    write("npz", tmp_path / "a.npz")
    before = (tmp_path / "a.npz").read_bytes()
    with pytest.raises((ValueError, TypeError)):
        artifacts.write_arrays(tmp_path / "a.npz", {"x": np.array([object()])}, "thing")
    assert (tmp_path / "a.npz").read_bytes() == before
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.json", "a.npz"]


# ---- the stages' artifacts


@pytest.fixture
def grid_set(vehicle):
    grid = Grid.with_cells(vehicle.chart, 12)
    return GridSet.from_mask(grid, grid.nodes[:, 1] >= 0)


def test_a_critical_set_comes_back(tmp_path):
    critical = CriticalSet(np.array([[0.1, 0.2], [0.3, 0.4]]), np.array([0, 1]), 0.01, 0.3)
    critical.save(tmp_path / "c.npz")
    back = CriticalSet.load(tmp_path / "c.npz")
    np.testing.assert_array_equal(back.points, critical.points)
    np.testing.assert_array_equal(back.component, critical.component)
    assert (back.resolution, back.spacing, back.pieces) == (0.01, 0.3, 2)


def test_a_partition_comes_back(tmp_path, vehicle, grid_set):
    whole = Partition((0, 1), (grid_set, ~grid_set), grid_set.mask)
    whole.save(tmp_path / "p.npz")
    back = Partition.load(tmp_path / "p.npz", vehicle)
    assert back.modes == (0, 1)
    assert back.grid.counts == whole.grid.counts
    np.testing.assert_array_equal(back.parts[1].values, whole.parts[1].values)
    np.testing.assert_array_equal(back.succeeds, whole.succeeds)


def test_extended_sets_come_back(tmp_path, vehicle, grid_set):
    masks = grid_set.mask, ~grid_set.mask
    narrow, room = np.array([[0.3, 0.0]]), np.array([0.1])
    sets = ExtendedSets((0, 1), (grid_set, ~grid_set), masks, 0.3, 0.1, narrow, room)
    sets.save(tmp_path / "e.npz")
    back = ExtendedSets.load(tmp_path / "e.npz", vehicle)
    assert (back.modes, back.horizon, back.noise) == ((0, 1), 0.3, 0.1)
    for loaded, kept in zip(back.sets, sets.sets, strict=True):
        np.testing.assert_array_equal(loaded.values, kept.values)
    for loaded, kept in zip(back.winning, sets.winning, strict=True):
        np.testing.assert_array_equal(loaded, kept)


def test_sets_of_another_task_are_refused(tmp_path, circle, grid_set):
    Partition((0,), (grid_set,), grid_set.mask).save(tmp_path / "p.npz")
    with pytest.raises(BadArtifact, match=r"p\.npz"):
        Partition.load(tmp_path / "p.npz", circle)
    nowhere = np.empty((0, 2)), np.empty(0)
    ExtendedSets((0,), (grid_set,), (grid_set.mask,), 0.3, 0.1, *nowhere).save(tmp_path / "e.npz")
    with pytest.raises(BadArtifact, match=r"e\.npz"):
        ExtendedSets.load(tmp_path / "e.npz", circle)


def test_one_artifact_is_not_another(tmp_path, vehicle, grid_set):
    Partition((0,), (grid_set,), grid_set.mask).save(tmp_path / "p.npz")
    with pytest.raises(BadArtifact, match="'partition', not 'extended sets'"):
        ExtendedSets.load(tmp_path / "p.npz", vehicle)
    with pytest.raises(BadArtifact, match="'partition', not 'critical set'"):
        CriticalSet.load(tmp_path / "p.npz")


def test_sets_that_do_not_fit_their_grid_are_refused(tmp_path, vehicle, grid_set):
    arrays = {
        "modes": np.array([0]),
        "grid_counts": np.array([5, 5]),
        "signed_distance": grid_set.values[None],
        "succeeds": grid_set.mask,
    }
    artifacts.write_arrays(tmp_path / "p.npz", arrays, "partition")
    with pytest.raises(BadArtifact, match=r"p\.npz"):
        Partition.load(tmp_path / "p.npz", vehicle)


def test_arrays_of_another_shape_or_name_are_named(tmp_path):
    arrays = {"points": np.zeros((3, 2)), "component": np.zeros(3, dtype=int)}
    numbers = {"resolution": np.array(0.1), "spacing": np.array(0.2)}
    for changed, message in (
        ({"resolution": np.zeros(2)}, "its resolution cannot be used"),
        ({"resolution": np.array("far")}, "its resolution cannot be used"),
        ({"points": np.array(1.0)}, "its points cannot be used"),
        ({"component": np.zeros(2, dtype=int)}, "one component"),
    ):
        artifacts.write_arrays(tmp_path / "c.npz", arrays | numbers | changed, "critical set")
        with pytest.raises(BadArtifact, match=message) as caught:
            CriticalSet.load(tmp_path / "c.npz")
        assert_one_sentence_about(caught, tmp_path / "c.npz")
    artifacts.write_arrays(tmp_path / "c.npz", arrays, "critical set")
    with pytest.raises(BadArtifact, match="it has no array 'resolution'"):
        CriticalSet.load(tmp_path / "c.npz")


def test_maps_come_back(tmp_path):
    maps = Maps(0.1, np.array([2, 3]), {"policy": np.arange(6, dtype=np.int8), "mine": np.ones(6)})
    maps.save(tmp_path / "m.npz")
    with np.load(tmp_path / "m.npz", allow_pickle=False) as file:
        assert set(file.files) == {
            "kind",
            "version",
            "eps",
            "grid_counts",
            "map_policy",
            "map_mine",
        }
    back = Maps.load(tmp_path / "m.npz")
    assert back.eps == 0.1
    assert back.map.keys() == maps.map.keys()
    for name, classes in maps.map.items():
        np.testing.assert_array_equal(back.map[name], classes)


def test_results_that_do_not_fit_together_are_refused(grid_set):
    with pytest.raises(BadInput, match="one component"):
        CriticalSet(np.zeros((3, 2)), np.zeros(2, dtype=int), 0.1, 0.2)
    with pytest.raises(BadInput, match="one for each mode"):
        Partition((0, 1), (grid_set,), grid_set.mask)
    with pytest.raises(BadInput, match="one grid"):
        Partition((0,), (grid_set,), np.ones(3, dtype=bool))


def test_results_describe_themselves_in_a_line(grid_set):
    critical = CriticalSet(np.zeros((3, 2)), np.zeros(3, dtype=int), 0.1, 0.2)
    assert repr(critical) == "CriticalSet(1 piece, 3 points, resolution 0.1)"
    assert repr(grid_set) == "GridSet(53.8% of 13 x 13 nodes)"
    partition = Partition((0, 1), (grid_set, ~grid_set), grid_set.mask)
    assert repr(partition) == "Partition(0: 53.8%, 1: 46.2% of 13 x 13 nodes)"
    nowhere = np.empty((0, 2)), np.empty(0)
    sets = ExtendedSets((0,), (grid_set,), (grid_set.mask,), 0.3, 0.1, *nowhere)
    assert repr(sets) == "ExtendedSets(0: 53.8% of the chart, eps 0.1)"


# ---- records


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
    assert list(content) == ["kind", "version", "settings", "versions"]
    content["settings"]["stage6"]["samples"] = "many"
    (tmp_path / "config.json").write_text(json.dumps(content))
    with pytest.raises(BadArtifact, match=r"settings\.stage6\.samples cannot be used"):
        hyrl_mj.load_run(tmp_path)
    content["settings"]["stage6"]["samples"] = 10
    content["settings"]["seed"] = -1
    (tmp_path / "config.json").write_text(json.dumps(content))
    with pytest.raises(BadArtifact, match="seed -1 cannot be used"):
        hyrl_mj.load_run(tmp_path)
