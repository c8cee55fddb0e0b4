"""The manifest of a run directory believes what stages recorded, and nothing else; one writer at a time."""

import re
import subprocess
import sys
import threading

import pytest

import hyrl_mj
from hyrl_mj import BadArtifact, BadInput
from hyrl_mj.files import artifacts, manifest
from hyrl_mj.files.manifest import (
    FILES,
    LOCK,
    NAME,
    Manifest,
    check_contents,
    check_may_hold,
    locked,
)

SETTINGS = dict.fromkeys(FILES, "these")
ENTRY = {"settings": "these", "code": "", "version": "0.1.0"}  # of a stage in a manifest


@pytest.fixture
def folder(tmp_path):
    """A run directory of three stages: the second reads the first's file, the third the second's."""
    write(tmp_path, "train", "policy.json", "a")
    write(tmp_path, "critical-set", "critical_set.npz", "b", "policy.json")
    write(tmp_path, "partition", "partition.npz", "c", "critical_set.npz")
    return tmp_path


def put(path, text):
    with artifacts.replacing(path) as temporary:
        temporary.write_text(text)


def write(folder, stage, name, text, *inputs, settings=SETTINGS, code=""):
    manifest = Manifest(folder, settings, code)
    with manifest.stage(stage):
        for source in inputs:
            manifest.checked(folder / source)
        put(folder / name, text)


def done(folder, settings=SETTINGS, code=""):
    return [s for s in FILES if Manifest(folder, settings, code).is_done(s)]


def refuses(folder, name, sentence):
    with pytest.raises(BadArtifact, match=sentence):
        Manifest(folder, SETTINGS).checked(folder / name)


def test_a_stage_is_done_when_its_files_are_those_that_it_wrote(folder):
    assert done(folder) == ["train", "critical-set", "partition"]
    assert Manifest(folder, SETTINGS).checked(folder / "partition.npz") == folder / "partition.npz"


@pytest.mark.parametrize(
    ("harm", "sentence"),
    [
        (lambda path: path.unlink(), "is missing"),
        (lambda path: path.write_text("x"), "was changed after it was written"),
    ],
)
def test_a_damaged_file_is_named_with_its_stage(harm, sentence, folder):
    harm(folder / "critical_set.npz")
    assert done(folder) == ["train", "partition"], "the partition was made from the file as it was"
    told = rf"critical_set.npz {sentence}.*hyrl-mj critical-set"
    refuses(folder, "critical_set.npz", told)


def test_who_asks_a_diagnosis_for_more_is_told_how_to_go_on(folder):
    write(folder, "diagnose", "diagnosis.html", "d", "partition.npz")
    refuses(folder, "extended_sets.npz", "extended_sets.npz is missing.*hyrl-mj robustify")
    (folder / "diagnosis.html").unlink()
    refuses(folder, "diagnosis.html", "diagnosis.html is missing: run the stage diagnose")
    write(folder, "extended-sets", "extended_sets.npz", "e", "partition.npz")
    refuses(folder, "replay.mp4", "replay.mp4 is missing.*hyrl-mj replay")


def test_another_input_makes_all_that_follows_out_of_date(folder):
    before = (folder / NAME).read_bytes()
    write(folder, "train", "policy.json", "other")
    assert done(folder) == ["train"]
    refuses(folder, "partition.npz", "partition.npz is older than what it was made from")
    write(folder, "train", "policy.json", "a")
    assert done(folder) == ["train", "critical-set", "partition"], "contents count, not times"
    assert (folder / NAME).read_bytes() == before, "nor does the order of the stages"


def test_other_settings_or_code_make_a_stage_undone(folder):
    assert done(folder, SETTINGS | {"critical-set": "those"}) == ["train"]
    assert done(folder, code="a changed robot") == []


def test_another_version_runs_every_stage_again_and_can_read_what_is_there(folder, monkeypatch):
    monkeypatch.setattr(manifest, "version", lambda name: "0.0.9")
    assert done(folder) == []
    others = Manifest(folder, SETTINGS).other_versions
    assert others(["train"]) == [hyrl_mj.__version__]
    assert others(["simulate --start"]) == [], "which no run makes again"
    assert Manifest(folder, SETTINGS).checked(folder / "partition.npz") == folder / "partition.npz"
    write(folder, "train", "policy.json", "a")
    assert done(folder) == ["train"]


def test_a_stage_that_breaks_off_is_not_believed(folder):
    def break_off():
        with Manifest(folder, SETTINGS).stage("train"):
            put(folder / "policy.json", "half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        break_off()
    assert done(folder) == []
    refuses(folder, "policy.json", "policy.json is of a stage that did not finish")


def test_a_stage_that_fails_before_it_writes_changes_nothing(folder):
    before = (folder / NAME).read_bytes()
    with pytest.raises(RuntimeError), Manifest(folder, SETTINGS).stage("train"):
        raise RuntimeError
    assert (folder / NAME).read_bytes() == before
    assert done(folder) == ["train", "critical-set", "partition"]


def test_a_file_that_a_stage_did_without_makes_it_out_of_date_once_it_is_there(folder):
    manifest = Manifest(folder, SETTINGS)
    with manifest.stage("report"):
        assert not manifest.has(folder / "replay.mp4")
        assert manifest.has(folder / "partition.npz")
        put(folder / "report.html", "no video")
    assert "report" in done(folder)
    write(folder, "replay", "replay.mp4", "video")
    assert "report" not in done(folder)


@pytest.mark.parametrize(
    ("stage", "name", "removable"),
    [
        ("extended-sets", "split.npz", False),
        ("retrain", "mode_0_part.json", False),
        ("replay", "replay.mp4", True),
    ],
)
def test_a_removed_file_is_not_taken_for_one_that_was_never_made(folder, stage, name, removable):
    write(folder, stage, name, "content")
    (folder / name).unlink()
    manifest = Manifest(folder, SETTINGS)
    if removable:
        assert not manifest.has(folder / name)
        return
    with pytest.raises(BadArtifact, match=f"{name} is missing: "):
        manifest.has(folder / name)


def test_files_of_an_earlier_run_go_and_others_stay(folder):
    write(folder, "retrain", "mode_0.json", "x")
    for name in ("mode_7.json", "figures/mode_mine.png", "arcs/mode_7.json"):
        put(folder / name, "left")
    write(folder, "retrain", "mode_1.json", "x")
    left = {p.relative_to(folder).as_posix() for p in folder.rglob("*mode*")}
    assert left == {"mode_1.json", "mode_7.json", "figures/mode_mine.png", "arcs/mode_7.json"}
    write(folder, "figures", "figures/overview.png", "x")
    assert (folder / "figures" / "mode_mine.png").exists()


@pytest.mark.parametrize("name", ["../victim.json", "config.json"])
def test_a_manifest_that_names_other_files_is_refused(name, folder):
    entry = ENTRY | {"inputs": {}, "outputs": {name: "0"}}
    artifacts.write_json(folder / NAME, {"stages": {"train": entry}}, "manifest")
    with pytest.raises(BadArtifact, match=re.escape(f"no stage 'train' writes {name!r}")):
        done(folder)


def test_inputs_in_a_circle_end(folder):
    inputs = {"policy.json": "0", "partition.npz": "1"}
    entry = ENTRY | {"inputs": inputs, "outputs": {"policy.json": "0"}}
    artifacts.write_json(folder / NAME, {"stages": {"train": entry}}, "manifest")
    assert done(folder) == []


# ---- writers


def test_a_second_process_is_told_who_works_there(tmp_path):
    code = f"""
import pathlib, sys
from hyrl_mj.files.manifest import locked
with locked(pathlib.Path({str(tmp_path)!r})):
    print("locked", flush=True)
    sys.stdin.read()
"""
    with subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout.readline() == "locked\n"
        with (
            pytest.raises(BadInput, match=rf"process {other.pid}, since 20\d\d-"),
            locked(tmp_path),
        ):
            pass
        other.kill()
    with locked(tmp_path), locked(tmp_path):
        pass


def test_a_second_thread_is_refused_too(tmp_path):
    said = []

    def work():
        try:
            with locked(tmp_path):
                said.append("worked")
        except BadInput as error:
            said.append(str(error))

    with locked(tmp_path):
        thread = threading.Thread(target=work)
        thread.start()
        thread.join()
    assert len(said) == 1
    assert "is working on" in said[0]


def test_what_a_killed_writer_has_left_goes_and_nothing_else(tmp_path):
    left = tmp_path / ".policy.0123456789ab.partial.json"
    mine = tmp_path / ".policy.partial.json"
    for path in (left, mine):
        path.write_text("half")
    with locked(tmp_path):
        pass
    assert sorted(path.name for path in tmp_path.iterdir()) == [LOCK, mine.name]


def test_a_folder_of_a_writer_that_was_killed_at_once_may_hold_a_run(tmp_path):
    for name in (LOCK, ".config.0123456789ab.partial.json"):
        check_may_hold(tmp_path, "config.json", "a run directory")
        (tmp_path / name).write_text("half")
    check_may_hold(tmp_path, "config.json", "a run directory")
    (tmp_path / "notes.txt").write_text("mine")
    for path in (tmp_path, tmp_path / LOCK):
        with pytest.raises(BadInput, match="is not a run directory: choose another --out"):
            check_may_hold(path, "config.json", "a run directory")


# ---- links


@pytest.mark.parametrize("name", ["arcs", "figures/runs.png", ".lock"])
def test_a_link_in_a_run_directory_is_refused(name, folder, tmp_path_factory):
    victim = tmp_path_factory.mktemp("victim")
    (folder / name).parent.mkdir(exist_ok=True)
    (folder / name).unlink(missing_ok=True)
    (folder / name).symlink_to(victim)
    with pytest.raises(BadArtifact, match=re.escape(f"{folder / name} is a link")):
        check_contents(folder)


def test_a_lock_that_is_a_second_name_of_a_file_is_refused(tmp_path):
    (tmp_path / "victim").write_text("mine")
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / LOCK).hardlink_to(tmp_path / "victim")
    with pytest.raises(BadArtifact, match=r"\.lock is a link"), locked(tmp_path / "run"):
        pass
    assert (tmp_path / "victim").read_text() == "mine"


def test_folders_far_within_each_other_are_refused(tmp_path):
    (tmp_path / "/".join("d" * 8)).mkdir(parents=True)
    check_contents(tmp_path)
    (tmp_path / "/".join("d" * 9)).mkdir()
    with pytest.raises(BadArtifact, match="more than 8 folders within each other"):
        check_contents(tmp_path)


# ---- sizes


def test_a_huge_file_is_not_read(folder):
    with (folder / "critical_set.npz").open("wb") as file:
        file.truncate(2**40)
    refuses(folder, "critical_set.npz", r"critical_set.npz is larger than \d+ MiB")
    with (folder / NAME).open("wb") as file:
        file.truncate(2**40)
    with pytest.raises(BadArtifact, match=r"manifest.json is larger than any manifest: remove it"):
        Manifest(folder, SETTINGS).is_done("train")


# ---- readers beside writers


@pytest.mark.parametrize("text", ["a", "other"])
def test_a_reader_beside_a_writer_calls_no_file_damaged(text, folder, monkeypatch):
    usual = manifest.digest

    def written_meanwhile(*paths):
        """A stage runs between the look into the manifest and the look into the file."""
        monkeypatch.setattr(manifest, "digest", usual)
        write(folder, "train", "policy.json", text)
        return usual(*paths)

    monkeypatch.setattr(manifest, "digest", written_meanwhile)
    path = folder / "policy.json"
    assert Manifest(folder, SETTINGS).checked(path) == path


def test_a_file_that_nothing_vouches_for_is_not_believed(folder):
    refuses(folder, "arcs/notes.npz", "notes.npz is no file that a run writes")
