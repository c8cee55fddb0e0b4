"""Results of the stages come back from their npz files as they were, or are named if they do not fit."""

import numpy as np
import pytest
from planted import extended
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


def results(kind, grid_set):
    both, masks = (grid_set, ~grid_set), (grid_set.mask, ~grid_set.mask)
    narrow = np.array([[0.3, 0.0]]), np.array([0.1]), np.array([[0, 1]])
    points = np.array([[0.1, 0.2], [0.3, 0.4]])
    return {
        CriticalSet: lambda: CriticalSet(points, np.array([0, 1]), 0.01, 0.3),
        Partition: lambda: Partition((0, 1), both, grid_set.mask, (2,)),
        ExtendedSets: lambda: ExtendedSets((0, 1), both, masks, 0.3, 0.1, *narrow),
        Maps: lambda: Maps(
            0.1, np.array([2, 3]), {"policy": np.arange(6, dtype=np.int8), "mine": np.ones(6)}
        ),
    }[kind]()


@pytest.mark.parametrize(
    ("kind", "names"),
    [
        (CriticalSet, "points component resolution spacing"),
        (Partition, "modes grid_counts signed_distance succeeds dropped unparted"),
        (
            ExtendedSets,
            "modes grid_counts signed_distance winning horizon eps points room between",
        ),
        (Maps, "eps grid_counts map_policy map_mine"),
    ],
)
def test_a_result_comes_back(kind, names, tmp_path, vehicle, grid_set):
    result = results(kind, grid_set)
    result.save(tmp_path / "r.npz")
    with np.load(tmp_path / "r.npz", allow_pickle=False) as file:
        assert {*file.files} == {"kind", "version", *names.split()}
    back = kind.load(tmp_path / "r.npz", vehicle)
    assert str(vars(back)) == str(vars(result))
    result.save(tmp_path / "kept.npz")
    back.save(tmp_path / "back.npz")
    assert (tmp_path / "back.npz").read_bytes() == (tmp_path / "kept.npz").read_bytes()


def test_sets_of_another_task_are_refused(tmp_path, circle, grid_set):
    Partition((0,), (grid_set,), grid_set.mask).save(tmp_path / "p.npz")
    with pytest.raises(BadArtifact, match=r"p\.npz"):
        Partition.load(tmp_path / "p.npz", circle)
    extended([grid_set]).save(tmp_path / "e.npz")
    with pytest.raises(BadArtifact, match=r"e\.npz"):
        ExtendedSets.load(tmp_path / "e.npz", circle)


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
        ({"points": np.full((3, 2), np.inf)}, "not finite"),
    ):
        artifacts.write_arrays(tmp_path / "c.npz", arrays | numbers | changed, "critical set")
        with pytest.raises(BadArtifact, match=message) as caught:
            CriticalSet.load(tmp_path / "c.npz")
        assert_one_sentence_about(caught, tmp_path / "c.npz")
    artifacts.write_arrays(tmp_path / "c.npz", arrays, "critical set")
    with pytest.raises(BadArtifact, match="it has no array 'resolution'"):
        CriticalSet.load(tmp_path / "c.npz")


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
    assert repr(extended([grid_set])) == "ExtendedSets(0: 53.8% of the chart, eps 0.1)"


@pytest.mark.parametrize(
    "change",
    [
        {"t": np.array(["a", "b"])},
        {"t": np.array([0.0, np.nan])},
        {"t": np.zeros(0)},
        {"t": np.array([0.1, 0.0])},
        {"j": np.array(["\x1b[31m", "1"])},
        {"j": np.array([0, 10**15])},
        {"j": np.array([0.0, 1.0])},
        {"z": np.zeros((3, 1))},
        {"z": np.zeros(2)},
        {"q": np.array([0.5, 0.5])},
        {"u": np.full((2, 1), "a")},
    ],
)
def test_arrays_that_make_no_arc_are_refused(change, tmp_path):
    table = np.zeros((2, 1))
    parts = {"t": np.array([0.0, 0.1]), "j": np.arange(2), "q": np.arange(2)}
    parts |= {"z": table, "measured": table, "u": table, "state": table}
    texts = {"task": "vehicle", "controller": "policy", "outcome": "reached", "noise": "none"}
    whole = HybridArc(**parts, **texts, bound=0.0)
    assert whole.columns == (1, 1, 1)
    artifacts.write_arrays(tmp_path / "a.npz", vars(whole) | change, HybridArc.KIND)
    with pytest.raises(BadArtifact, match=r"a\.npz.*make no arc"):
        HybridArc.load(tmp_path / "a.npz")
