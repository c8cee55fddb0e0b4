"""MJCF files: compiles them, and gives all that `compiled` reads from compiled models."""

from contextlib import suppress
from hashlib import sha256
from pathlib import Path

import mujoco

from hyrl_mj.errors import BadInput, has_controls
from hyrl_mj.files import trust
from hyrl_mj.physics import mujoco_log
from hyrl_mj.physics.compiled import *  # noqa: F403 - task files find it here
from hyrl_mj.system import limits

# The models that were compiled, each with the digest of its files at that time.
_LOADED: dict[tuple[Path, str], mujoco.MjModel] = {}
# The files that were tried in a process with limits, each with the digest of its own content.
_TRIED: set[tuple[Path, str]] = set()


def models_dir() -> Path:
    """Returns the folder of the MJCF files: in the installed package, else beside it in the checkout."""
    package = Path(__file__).resolve().parents[1]
    installed = package / "models"
    return installed if installed.is_dir() else package.parent / "models"


def load(path: Path) -> mujoco.MjModel:
    """Returns a compiled MJCF file. Compiled models are shared: do not write to them.

    One that is not of this package is compiled and stepped in a process with limits first. A file that has
    changed, or of which another one has that it includes, is compiled again.

    Raises:
        BadInput: the file is missing, MuJoCo cannot compile it, or it takes too much time or memory.
    """
    if not path.is_file():
        raise BadInput(f"there is no MJCF model at {path}")
    if any("\ud800" <= c <= "\udfff" for c in str(path)):  # a byte that Python could not read
        raise BadInput(
            f"the name of {path} is not in UTF-8, or the locale is another one: rename the folder or the "
            "file, or set the locale, as with export LC_ALL=C.UTF-8"
        )
    main = path, sha256(path.read_bytes()).hexdigest()
    if new := models_dir() not in path.resolve().parents and main not in _TRIED:
        _try(path.absolute())
        _TRIED.add(main)
    key = path, file_digest(path)
    if key not in _LOADED:
        if main in _TRIED and not new:  # what it names has changed
            _try(path.absolute())
        _LOADED[key] = _compiled(path)
    return _LOADED[key]


def file_digest(path: Path) -> str:
    """Returns the SHA-256 of an MJCF file, with all that it includes and the assets that it names."""
    content = path.read_bytes()
    found = sha256(content)
    if b"file" in content and models_dir() not in path.resolve().parents:
        with suppress(mujoco.FatalError):  # the compiler will tell
            for part in sorted(map(Path, mujoco.mju_getXMLDependencies(str(path)))):
                if part.is_file():
                    found.update(sha256(part.read_bytes()).digest())
    return found.hexdigest()


def origin(model: mujoco.MjModel) -> tuple[Path, str] | None:
    """Returns the file of a model that `load` compiled and its `file_digest` then; None of another model."""
    return next((key for key, loaded in _LOADED.items() if loaded is model), None)


def _compiled(path: Path) -> mujoco.MjModel:
    mujoco_log.install()
    try:
        with mujoco_log.kept() as warnings:
            model = mujoco.MjModel.from_xml_path(str(path))
            reason = next((text for text in warnings.values() if "NaN" in text), None)
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise BadInput(f"MuJoCo cannot compile {path}: {reason}") from error
    if reason:
        raise BadInput(f"{path} cannot be used: {reason}")
    check_names(model, str(path))
    return model


def check_names(model: mujoco.MjModel, what: str) -> None:
    """Raises `BadInput` if a name in a model has characters that control a terminal."""
    for name in model.names.split(b"\0"):
        if has_controls(text := name.decode(errors="replace")):
            raise BadInput(
                f"{what} has an object {text[:80]!r}: give names of characters that can be printed"
            )


def _try(path: Path) -> None:
    """Compiles and steps a file in a process with limits, unless that was done before.

    What was done is remembered of a file that names no others, which may change.
    """
    if trust.is_known(path):
        return
    try:
        found = limits.tried(Path(__file__).with_name("mjcf_trial.py"), b"", str(path))
    except limits.Ended as ended:
        raise BadInput(
            f"{path} cannot be used: {ended} where it is compiled and stepped twice; make it simpler"
        ) from None
    if "problem" in found:
        raise BadInput(f"MuJoCo cannot compile {path}: {found['problem']}")
    if b"file" not in path.read_bytes():
        trust.remember(path)
