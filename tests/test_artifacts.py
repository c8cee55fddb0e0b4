"""Artifacts come back as they were, are replaced whole or not at all, and named if damaged."""

import json
import pickle
import zipfile

import numpy as np
import pytest
from memory import Peak
from planted import Payload
from sentences import assert_one_sentence_about

from hyrl_mj import BadArtifact
from hyrl_mj.files import artifacts

ARRAYS = {"a": np.arange(500.0).reshape(50, 10), "name": np.array("word"), "flag": np.array([True])}
CONTENT = {"x": 1.5, "items": [1, 2, 3]}


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
    return artifacts.read_json(path, what, dict) if kind == "json" else artifacts.read_tensors(path)


@pytest.fixture(params=["npz", "json", "safetensors"])
def kind(request):
    return request.param


@pytest.fixture
def path(kind, tmp_path):
    path = tmp_path / "folder" / f"file.{kind}"
    write(kind, path)
    return path


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


# ---- damage


def test_a_missing_file_names_the_cure(kind, tmp_path):
    with pytest.raises(BadArtifact, match="run the stage that writes it") as caught:
        read(kind, tmp_path / f"no.{kind}")
    assert_one_sentence_about(caught, tmp_path / f"no.{kind}")


@pytest.mark.parametrize("share", [0.0, 0.3, 0.95])
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


@pytest.mark.parametrize("text", ["3", "[1]", "{}", "{", '{"kind": "thing"}'])
def test_json_that_is_not_ours(tmp_path, text):
    path = tmp_path / "a.json"
    path.write_text(text)
    with pytest.raises(BadArtifact) as caught:
        artifacts.read_json(path, "thing", dict)
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
    (tmp_path / "a.json").write_text(json.dumps({"kind": "thing", "version": 99}))
    np.savez(tmp_path / "a.npz", kind=np.array("thing"), version=np.array(99))
    for ending in ("json", "npz"):
        with pytest.raises(BadArtifact, match=r"version 99.*reads version 2") as caught:
            read(ending, path := tmp_path / f"a.{ending}")
        assert_one_sentence_about(caught, path)


@pytest.mark.parametrize("ending", ["json", "npz"])
def test_another_kind_is_named(ending, tmp_path):
    write(ending, tmp_path / f"a.{ending}")
    with pytest.raises(BadArtifact, match=r"'thing', not 'other thing'"):
        read(ending, tmp_path / f"a.{ending}", "other thing")


def test_a_pickle_in_an_npz_is_refused_and_not_run(tmp_path):
    path, crater = tmp_path / "a.npz", tmp_path / "crater"
    bomb = np.array([Payload(crater)], dtype=object)
    np.savez(path, kind=np.array("thing"), version=np.array(1), a=bomb)
    with pytest.raises(BadArtifact):
        artifacts.read_arrays(path, "thing")
    assert not crater.exists()


@pytest.mark.parametrize("ending", ["json", "npz", "safetensors"])
def test_a_pickle_under_another_name_is_refused_and_not_run(ending, tmp_path):
    path, crater = tmp_path / f"a.{ending}", tmp_path / "crater"
    path.write_bytes(pickle.dumps(Payload(crater)))
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


@pytest.mark.parametrize("kind", ["json", "npz"])
def test_a_failed_write_leaves_the_old_file(kind, path):
    before = path.read_bytes()
    writer = artifacts.write_json if kind == "json" else artifacts.write_arrays
    with pytest.raises((ValueError, TypeError)):
        writer(path, {"x": np.array([object()])}, "thing")
    assert path.read_bytes() == before
    assert [p.name for p in path.parent.iterdir()] == [path.name]


def test_arrays_that_unpack_to_more_than_their_limit_are_refused(tmp_path):
    artifacts.write_arrays(tmp_path / "a.npz", {"x": np.zeros(2**18)}, "kind")
    with pytest.raises(BadArtifact, match="unpacks to more than"):
        artifacts.read_arrays(tmp_path / "a.npz", "kind", 2**20)
    artifacts.write_arrays(tmp_path / "a.npz", {"x": np.zeros(2**16), "y": np.ones(3)}, "kind")
    found = artifacts.read_arrays(tmp_path / "a.npz", "kind", 2**20)
    assert {name: array.shape for name, array in found.items()} == {"x": (2**16,), "y": (3,)}


@pytest.mark.slow
def test_the_largest_arrays_are_in_memory_once(tmp_path):
    content = {"kind": "kind", "version": artifacts.VERSION, "x": np.zeros(2**23)}  # 64 MiB
    np.savez(tmp_path / "a.npz", **content)
    with Peak() as peak:
        found = artifacts.read_arrays(tmp_path / "a.npz", "kind")
    assert len(found["x"]) == 2**23
    assert peak.megabytes < 80


@pytest.mark.parametrize("packing", [zipfile.ZIP_LZMA, zipfile.ZIP_BZIP2])
def test_an_npz_packed_in_a_way_that_python_unpacks_without_a_limit_is_refused(packing, tmp_path):
    with zipfile.ZipFile(tmp_path / "a.npz", "w", packing) as file:
        file.writestr("a.npy", bytes(2**20))
    with pytest.raises(BadArtifact, match=r"a\.npz: its a\.npy is packed in a way"):
        artifacts.read_arrays(tmp_path / "a.npz", "thing")
