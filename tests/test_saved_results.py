"""Results of the stages come back from their npz files as they were, or are named if they do not fit."""

import numpy as np
import pytest
from sentences import assert_one_sentence_about

from hyrl_mj import BadArtifact, BadInput, CriticalSet
from hyrl_mj.files import artifacts
from hyrl_mj.judging.game import Maps
from hyrl_mj.sets import Grid, GridSet
from hyrl_mj.simulation import HybridArc
from hyrl_mj.stages.extended_sets import ExtendedSets
from hyrl_mj.stages.partition import Partition


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
    narrow = np.array([[0.3, 0.0]]), np.array([0.1]), np.array([[0, 1]])
    sets = ExtendedSets((0, 1), (grid_set, ~grid_set), masks, 0.3, 0.1, *narrow)
    sets.save(tmp_path / "e.npz")
    back = ExtendedSets.load(tmp_path / "e.npz", vehicle)
    assert (back.modes, back.horizon, back.eps) == ((0, 1), 0.3, 0.1)
    np.testing.assert_array_equal(back.between, [[0, 1]])
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


@pytest.mark.parametrize(
    "change",
    [
        {"t": np.array(["a", "b"])},
        {"t": np.array([0.0, np.nan])},
        {"t": np.zeros(0)},
        {"z": np.zeros((3, 1))},
        {"z": np.zeros(2)},
        {"q": np.array([0.5, 0.5])},
        {"u": np.full((2, 1), "a")},
    ],
)
def test_arrays_that_make_no_arc_are_refused(change, tmp_path):
    table = np.zeros((2, 1))
    parts = {"t": np.zeros(2), "j": np.zeros(2, int), "q": np.zeros(2, int)}
    parts |= {"z": table, "measured": table, "u": table, "state": table}
    texts = {"task": "vehicle", "controller": "policy", "outcome": "reached", "noise": "none"}
    whole = HybridArc(**parts, **texts, bound=0.0)
    assert whole.columns == (1, 1, 1)
    artifacts.write_arrays(tmp_path / "a.npz", vars(whole) | change, HybridArc.KIND)
    with pytest.raises(BadArtifact, match=r"a\.npz.*make no arc"):
        HybridArc.load(tmp_path / "a.npz")


def test_a_critical_set_that_is_not_finite_is_refused(tmp_path):
    points = {"points": np.array([[np.inf, 0.0]]), "component": np.array([0])}
    content = points | {"resolution": 0.1, "spacing": 0.1}
    artifacts.write_arrays(tmp_path / "c.npz", content, CriticalSet.KIND)
    with pytest.raises(BadArtifact, match="not finite"):
        CriticalSet.load(tmp_path / "c.npz")
