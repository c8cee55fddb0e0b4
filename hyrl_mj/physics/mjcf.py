"""MJCF files: compiles them, and tells names, geometry, cameras and sensors of compiled models.

So that these are written nowhere else.
"""

import copy
import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from difflib import get_close_matches
from hashlib import sha256
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from hyrl_mj.errors import BadInput, has_controls, unknown
from hyrl_mj.files import trust
from hyrl_mj.physics import mujoco_log
from hyrl_mj.system import limits

# Positions (n, nq) of the joints -> positions (n, k, 3) [m] or poses (n, k, 7) of the mocap bodies.
Mocap = Callable[[np.ndarray], np.ndarray]

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


# MuJoCo's own compilers, and the latest models of `compiled_once` by their MJCF, which nobody else has.
_OWN = {name: getattr(mujoco.MjModel, name) for name in ("from_xml_path", "from_xml_string")}
_LATEST: dict[str, mujoco.MjModel] = {}


@contextmanager
def compiled_once() -> Iterator[None]:
    """In the block MuJoCo gives a copy of the model where it has compiled the same MJCF before in one.

    An environment compiles its MJCF in each of its instances, which takes twenty times as long as a copy for
    a maze. An MJCF that names other files, or comes with assets, is compiled each time.
    """
    kind: Any = mujoco.MjModel
    if any(getattr(kind, name) != own for name, own in _OWN.items()):
        yield  # they have been replaced by others, or by a block around this one
        return

    def from_xml_string(xml: str, *rest: Any, **more: Any) -> mujoco.MjModel:
        if rest or more or not isinstance(xml, str) or "file" in xml:
            return _OWN["from_xml_string"](xml, *rest, **more)
        return _copied(xml, lambda: _OWN["from_xml_string"](xml))

    def from_xml_path(filename: str, *rest: Any, **more: Any) -> mujoco.MjModel:
        xml = "file"
        with suppress(OSError, ValueError, TypeError):  # the compiler will tell
            xml = Path(filename).read_text(encoding="utf-8")
        if rest or more or "file" in xml:
            return _OWN["from_xml_path"](filename, *rest, **more)
        return _copied(xml, lambda: _OWN["from_xml_path"](filename))

    kind.from_xml_string, kind.from_xml_path = from_xml_string, from_xml_path
    try:
        yield
    finally:
        for name, own in _OWN.items():
            setattr(kind, name, own)


def _copied(xml: str, compiled: Callable[[], mujoco.MjModel]) -> mujoco.MjModel:
    """Returns a copy of the model of an MJCF, which is compiled unless it is among the latest."""
    if (model := _LATEST.get(xml)) is None:
        model = compiled()
        if len(_LATEST) >= 8:  # each may take megabytes
            _LATEST.clear()
        _LATEST[xml] = model
    return copy.copy(model)


def file_digest(path: Path) -> str:
    """Returns the SHA-256 of an MJCF file, with all that it includes and the assets that it names."""
    content = path.read_bytes()
    found = sha256(content)
    if b"file" in content and models_dir() not in path.resolve().parents:
        with suppress(mujoco.FatalError):  # the compiler will tell
            parts = sorted(map(Path, mujoco.mju_getXMLDependencies(str(path))))
            texts = b"".join(
                p.read_bytes() for p in (path, *parts) if p.suffix == ".xml" and p.is_file()
            )
            # MuJoCo does not say in which folder height fields lie.
            folders = sorted({*re.findall(rb"(?:mesh|asset)dir\s*=\s*[\"']([^\"']+)", texts)})
            for part in [p for p in parts if not p.is_file()]:
                name = os.path.relpath(part, path.parent)
                parts += [path.parent / os.fsdecode(folder) / name for folder in folders]
            for part in parts:
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


# ---- what compiled models tell


def object_id(model: mujoco.MjModel, kind: mujoco.mjtObj, name: str) -> int:
    """Returns the id of a named object.

    Raises:
        BadInput: the model has no such object; the message lists those it has.
    """
    index = mujoco.mj_name2id(model, kind, name)
    if index < 0:
        label = kind.name.removeprefix("mjOBJ_").lower()
        raise unknown(f"{label} in model {model_name(model)}", name, names(model, kind))
    return index


def names(model: mujoco.MjModel, kind: mujoco.mjtObj) -> list[str]:
    """Returns the names of all objects of one kind, in the order of their ids."""
    count = {
        mujoco.mjtObj.mjOBJ_ACTUATOR: model.nactuator,  # some have several controls
        mujoco.mjtObj.mjOBJ_BODY: model.nbody,
        mujoco.mjtObj.mjOBJ_CAMERA: model.ncam,
        mujoco.mjtObj.mjOBJ_GEOM: model.ngeom,
        mujoco.mjtObj.mjOBJ_JOINT: model.njnt,
        mujoco.mjtObj.mjOBJ_NUMERIC: model.nnumeric,
        mujoco.mjtObj.mjOBJ_SENSOR: model.nsensor,
        mujoco.mjtObj.mjOBJ_SITE: model.nsite,
    }[kind]
    return [mujoco.mj_id2name(model, kind, i) or f"({i})" for i in range(count)]


def camera_of(model: mujoco.MjModel, name: str) -> mujoco.MjvCamera:
    """Returns a camera of the MJCF.

    Where the MJCF has none of that name, "free" is MuJoCo's free camera, and "overhead" looks from above.

    Raises:
        BadInput: there is no such camera; the message lists those there are.
    """
    camera, own = mujoco.MjvCamera(), names(model, mujoco.mjtObj.mjOBJ_CAMERA)
    if name in own:
        camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        camera.fixedcamid = own.index(name)
        return camera
    if name not in ("overhead", "free"):
        known = dict.fromkeys([*own, "overhead", "free"])
        raise unknown(f"camera in model {model_name(model)}", name, known)
    mujoco.mjv_defaultFreeCamera(model, camera)
    if name == "overhead":
        camera.azimuth, camera.elevation = 90.0, -90.0
    return camera


def rests(model: mujoco.MjModel, camera: mujoco.MjvCamera) -> bool:
    """Returns whether a camera stays where it is, and does not follow a body."""
    if camera.type == mujoco.mjtCamera.mjCAMERA_FREE:
        return True
    number = camera.fixedcamid
    fixed = model.cam_mode[number] == mujoco.mjtCamLight.mjCAMLIGHT_FIXED
    return bool(fixed and model.cam_bodyid[number] == 0)


# What has a place, by the field of MuJoCo's data.
POINTS = {
    "site_xpos": mujoco.mjtObj.mjOBJ_SITE,
    "xpos": mujoco.mjtObj.mjOBJ_BODY,
    "geom_xpos": mujoco.mjtObj.mjOBJ_GEOM,
}


def points_of(model: mujoco.MjModel, name: str) -> list[tuple[str, int]]:
    """Returns where the places of all sites, bodies and geoms of a name are, as `point_of` does.

    A name as "body tip" is that of one kind.
    """
    there = {where: names(model, kind) for where, kind in POINTS.items()}
    found = [(where, of_kind.index(name)) for where, of_kind in there.items() if name in of_kind]
    kind, _, rest = name.partition(" ")
    where = {"site": "site_xpos", "body": "xpos", "geom": "geom_xpos"}.get(kind, "")
    if not found and rest in there.get(where, ()):
        return [(where, there[where].index(rest))]
    return found


def point_of(model: mujoco.MjModel, name: str) -> tuple[str, int]:
    """Returns where the place of a site, a body or a geom is in MuJoCo's data: ("site_xpos", 2).

    Where the MJCF has none of the name "tracked", that is the first body that moves.

    Raises:
        BadInput: nothing has that name; the message lists the names there are.
    """
    if found := points_of(model, name):
        return found[0]
    if name == "tracked" and model.njnt:
        return "xpos", int(model.jnt_bodyid[0])
    all_names = {where: names(model, kind) for where, kind in POINTS.items()}
    named = [n for there in all_names.values() for n in there if not n.startswith("(")]
    raise unknown(f"site, body or geom in model {model_name(model)}", name, dict.fromkeys(named))


def model_name(model: mujoco.MjModel) -> str:
    """Returns the name that the MJCF gives the model."""
    return bytes(model.names).split(b"\0", 1)[0].decode()


def site_pos(model: mujoco.MjModel, name: str) -> np.ndarray:
    """Returns the position of a site: (3,) [m], in the world if it stands still, else in its body's frame."""
    return _pos(model, "site", object_id(model, mujoco.mjtObj.mjOBJ_SITE, name))


def site_size(model: mujoco.MjModel, name: str) -> np.ndarray:
    """Returns the half sizes of a site: (3,) [m]."""
    return model.site_size[object_id(model, mujoco.mjtObj.mjOBJ_SITE, name)].copy()


def geom_pos(model: mujoco.MjModel, name: str) -> np.ndarray:
    """Returns the position of a geom: (3,) [m], in the world if it stands still, else in its body's frame."""
    return _pos(model, "geom", object_id(model, mujoco.mjtObj.mjOBJ_GEOM, name))


def _pos(model: mujoco.MjModel, kind: str, index: int) -> np.ndarray:
    """Returns the position (3,) of a "geom" or a "site", as `geom_pos` does."""
    owner, whose = model, f"{kind}_pos"
    body = getattr(model, f"{kind}_bodyid")[index]
    if body and not _move(model, body):  # it stands still on a body with a frame of its own
        owner, whose = mujoco.MjData(model), f"{kind}_xpos"
        mujoco.mj_kinematics(model, owner)
    return np.array(getattr(owner, whose)[index])


def geom_positions(model: mujoco.MjModel, ids: list[int]) -> np.ndarray:
    """Returns the positions of geoms (k,) in the world, with all joints at their references: (k, 3) [m]."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return data.geom_xpos[ids].copy()


def geoms_move(model: mujoco.MjModel, ids: list[int]) -> bool:
    """Returns whether one of the geoms (k,) can move: by a joint, or with a mocap body."""
    return bool(_move(model, model.geom_bodyid[ids]).any())


def _move(model: mujoco.MjModel, bodies: np.ndarray) -> np.ndarray:
    """Returns whether bodies (k,) can move: (k,) bool."""
    driven = model.body_mocapid[model.body_rootid[bodies]] >= 0
    return np.asarray(driven | (model.body_weldid[bodies] != 0))


def geom_size(model: mujoco.MjModel, name: str) -> np.ndarray:
    """Returns the sizes of a geom, for a cylinder (radius, half height, 0): (3,) [m]."""
    return model.geom_size[object_id(model, mujoco.mjtObj.mjOBJ_GEOM, name)].copy()


def obstacles(model: mujoco.MjModel) -> list[str]:
    """Returns the names of the obstacles: all geoms whose names begin with "obstacle"."""
    kind = mujoco.mjtObj.mjOBJ_GEOM
    return [name for name in names(model, kind) if name.startswith("obstacle")]


def numeric(model: mujoco.MjModel, name: str, size: int) -> np.ndarray:
    """Returns the values (size,) of a custom numeric.

    Raises:
        BadInput: the model has no such numeric, or one of another size.
    """
    index = object_id(model, mujoco.mjtObj.mjOBJ_NUMERIC, name)
    first, count = model.numeric_adr[index], model.numeric_size[index]
    if count != size:
        raise BadInput(
            f"numeric {name} of {model_name(model)} has {count} value(s): give it {size}"
        )
    return np.array(model.numeric_data[first : first + size])


def mocap_poses(model: mujoco.MjModel, mocap: Mocap, qpos: np.ndarray) -> np.ndarray:
    """Returns the poses (n, k, 7) of the k mocap bodies at positions qpos (n, nq) of the joints.

    A pose is a position [m] and a quaternion; bodies of which only positions are given keep their
    orientation.

    Raises:
        BadInput: a wrong shape, or a value that is not finite.
    """
    poses = np.asarray(mocap(qpos), dtype=float)
    shapes = [(len(qpos), model.nmocap, columns) for columns in (3, 7)]
    if poses.shape not in shapes:
        raise BadInput(
            f"mocap() gives shape {poses.shape}, and {model_name(model)} has {model.nmocap} mocap body(s): "
            f"give their positions, {shapes[0]}, or their poses, {shapes[1]}"
        )
    if not np.isfinite(poses).all():
        row = int(np.argwhere(~np.isfinite(poses))[0][0])
        raise BadInput(f"mocap() gives {poses[row].tolist()} at qpos {qpos[row].tolist()}")
    if poses.shape[2] == 3:
        turned = np.broadcast_to(mocap_frames(model)[:, 3:], (*poses.shape[:2], 4))
        poses = np.concatenate([poses, turned], axis=2)
    return poses


def mocap_frames(model: mujoco.MjModel) -> np.ndarray:
    """Returns the poses (k, 7) that the MJCF gives the mocap bodies."""
    bodies = np.flatnonzero(model.body_mocapid >= 0)
    bodies = bodies[np.argsort(model.body_mocapid[bodies])]
    return np.hstack([model.body_pos[bodies], model.body_quat[bodies]])


def place(
    model: mujoco.MjModel, data: mujoco.MjData, qpos: np.ndarray, mocap: Mocap | None = None
) -> None:
    """Puts all bodies where they are at positions qpos (nq,) of the joints."""
    data.qpos[:] = qpos
    if model.nmocap and mocap is not None:
        poses = mocap_poses(model, mocap, np.asarray(qpos, dtype=float)[None])[0]
        data.mocap_pos[:], data.mocap_quat[:] = poses[:, :3], poses[:, 3:]
    mujoco.mj_kinematics(model, data)


def sample_time(model: mujoco.MjModel) -> float:
    """Returns the controller's sample time [s]: the custom numeric `sample_time`, else the timestep."""
    known = names(model, mujoco.mjtObj.mjOBJ_NUMERIC)
    if "sample_time" not in known:
        for name in get_close_matches("sample_time", known, cutoff=0.8):
            raise BadInput(
                f"the numeric {name} of {model_name(model)} means nothing: the sample time of the controller "
                "is called sample_time"
            )
        return float(model.opt.timestep)
    return float(numeric(model, "sample_time", 1)[0])


def substeps(model: mujoco.MjModel) -> int:
    """Returns the number of physics steps in a sample of the controller.

    Raises:
        BadInput: a sample is no whole number of them.
    """
    time, step = sample_time(model), float(model.opt.timestep)
    if abs(time / step - round(time / step)) > 1e-6 or time / step < 0.5:
        raise BadInput(
            f"the sample time of {model_name(model)} of {time:g} s is no multiple of the physics step "
            f"{step:g} s: change one of them"
        )
    return round(time / step)


def quaternion_columns(model: mujoco.MjModel) -> list[slice]:
    """Returns the columns of qpos that are quaternions: those of free joints and of balls."""
    after = {mujoco.mjtJoint.mjJNT_FREE: 3, mujoco.mjtJoint.mjJNT_BALL: 0}
    firsts = [
        int(address) + after[mujoco.mjtJoint(kind)]
        for kind, address in zip(model.jnt_type, model.jnt_qposadr, strict=True)
        if mujoco.mjtJoint(kind) in after
    ]
    return [slice(first, first + 4) for first in firsts]


def state_columns(model: mujoco.MjModel) -> np.ndarray | None:
    """Returns the columns (s,) of a state (mjSTATE_INTEGRATION) that the sensors measure.

    Returns None unless each sensor is unmodified and measures the position or velocity of a joint, or the
    position, orientation, velocity or rates of turn of a body with a free joint.
    """
    if any(v.any() for v in (model.sensor_cutoff, model.sensor_delay, model.sensor_interval)):
        return None
    columns = [_columns_of(model, sensor) for sensor in range(model.nsensor)]
    return None if None in columns else np.array([c for some in columns if some for c in some], int)


def _columns_of(model: mujoco.MjModel, sensor: int) -> range | None:
    """Returns the columns of a state that a sensor measures, None if it measures something else."""
    kind, joint = mujoco.mjtSensor(model.sensor_type[sensor]), _measured_joint(model, sensor)
    # Whether they are velocities, and which entries of the joint they are: the first one and their number.
    entries = {
        mujoco.mjtSensor.mjSENS_JOINTPOS: (False, 0, 1),
        mujoco.mjtSensor.mjSENS_FRAMEPOS: (False, 0, 3),
        mujoco.mjtSensor.mjSENS_FRAMEQUAT: (False, 3, 4),
        mujoco.mjtSensor.mjSENS_JOINTVEL: (True, 0, 1),
        mujoco.mjtSensor.mjSENS_FRAMELINVEL: (True, 0, 3),
        mujoco.mjtSensor.mjSENS_GYRO: (True, 3, 3),
    }
    if joint is None or kind not in entries:
        return None
    velocities, first, count = entries[kind]
    of_joint = model.nq + model.jnt_dofadr[joint] if velocities else model.jnt_qposadr[joint]
    # The state begins with time, qpos and qvel.
    start = mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_TIME) + of_joint + first
    return range(start, start + count)


def _measured_joint(model: mujoco.MjModel, sensor: int) -> int | None:
    """Returns the joint that a sensor measures, or whose body, if it is free; None without such a joint."""
    kind, measured = mujoco.mjtObj(model.sensor_objtype[sensor]), int(model.sensor_objid[sensor])
    if kind == mujoco.mjtObj.mjOBJ_JOINT:
        return measured
    body = measured
    if kind == mujoco.mjtObj.mjOBJ_SITE:
        body = model.site_bodyid[measured]
        turned = (model.site_quat[measured] != [1, 0, 0, 0]).any()
        # All points of a body turn at the same rate.
        away = model.site_pos[measured].any() and (
            model.sensor_type[sensor] != mujoco.mjtSensor.mjSENS_GYRO
        )
        if turned or away:
            return None
    elif kind != mujoco.mjtObj.mjOBJ_XBODY:
        return None
    joint = int(model.body_jntadr[body])
    free = joint >= 0 and model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE
    return joint if free and model.sensor_refid[sensor] < 0 else None
