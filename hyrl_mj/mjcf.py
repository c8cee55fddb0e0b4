"""MJCF models: compiles them and reads their geometry, so that it is written down nowhere else."""

from functools import lru_cache
from pathlib import Path

import mujoco
import numpy as np

from hyrl_mj import mujoco_log
from hyrl_mj.errors import BadInput, unknown

# The version of MuJoCo that computes wrong constraint forces where the Jacobian is sparse.
WRONG_VERSION = "4.0.0"


def models_dir() -> Path:
    """Returns the folder of the MJCF files: in the installed package, else beside it in the checkout."""
    package = Path(__file__).resolve().parent
    installed = package / "models"
    return installed if installed.is_dir() else package.parent / "models"


@lru_cache
def load(path: Path) -> mujoco.MjModel:
    """Returns a compiled MJCF file. Compiled models are shared: do not write to them.

    Raises:
        BadInput: the file is missing or MuJoCo cannot compile it.
    """
    if not path.is_file():
        raise BadInput(f"there is no MJCF model at {path}")
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
    return model


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
        mujoco.mjtObj.mjOBJ_ACTUATOR: model.nu,
        mujoco.mjtObj.mjOBJ_CAMERA: model.ncam,
        mujoco.mjtObj.mjOBJ_GEOM: model.ngeom,
        mujoco.mjtObj.mjOBJ_NUMERIC: model.nnumeric,
        mujoco.mjtObj.mjOBJ_SENSOR: model.nsensor,
        mujoco.mjtObj.mjOBJ_SITE: model.nsite,
    }[kind]
    return [mujoco.mj_id2name(model, kind, i) or f"({i})" for i in range(count)]


def model_name(model: mujoco.MjModel) -> str:
    """Returns the name that the MJCF gives the model."""
    return bytes(model.names).split(b"\0", 1)[0].decode()


def site_pos(model: mujoco.MjModel, name: str) -> np.ndarray:
    """Returns the position of a site in its body's frame: (3,) [m]."""
    return model.site_pos[object_id(model, mujoco.mjtObj.mjOBJ_SITE, name)].copy()


def site_size(model: mujoco.MjModel, name: str) -> np.ndarray:
    """Returns the half sizes of a site: (3,) [m]."""
    return model.site_size[object_id(model, mujoco.mjtObj.mjOBJ_SITE, name)].copy()


def geom_pos(model: mujoco.MjModel, name: str) -> np.ndarray:
    """Returns the position of a geom in its body's frame: (3,) [m]."""
    return model.geom_pos[object_id(model, mujoco.mjtObj.mjOBJ_GEOM, name)].copy()


def geom_size(model: mujoco.MjModel, name: str) -> np.ndarray:
    """Returns the sizes of a geom, for a cylinder (radius, half height, 0): (3,) [m]."""
    return model.geom_size[object_id(model, mujoco.mjtObj.mjOBJ_GEOM, name)].copy()


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


def sample_time(model: mujoco.MjModel) -> float:
    """Returns the controller's sample time [s]: the custom numeric `sample_time`, else the timestep."""
    if "sample_time" not in names(model, mujoco.mjtObj.mjOBJ_NUMERIC):
        return float(model.opt.timestep)
    return float(numeric(model, "sample_time", 1)[0])


def wrong_physics(model: mujoco.MjModel, version: str = mujoco.__version__) -> str:
    """Returns why a version of MuJoCo simulates a model wrongly, and the remedy; "" if it does not.

    MuJoCo 4.0.0 factorises the Hessian of the Newton solver wrongly if the constraint Jacobian is sparse
    (https://github.com/google-deepmind/mujoco/releases/tag/4.0.1).
    """
    newton = model.opt.solver == mujoco.mjtSolver.mjSOL_NEWTON
    if version != WRONG_VERSION or not (
        newton and mujoco.mj_isSparse(model) and _constrained(model)
    ):
        return ""
    return (
        f"MuJoCo 4.0.0 computes wrong constraint forces for {model_name(model)}, whose Jacobian is "
        'sparse: give its MJCF <option jacobian="dense"/>, or install another version of MuJoCo'
    )


def _constrained(model: mujoco.MjModel) -> bool:
    """Returns whether a model can have constraints: contacts, limits, friction losses or equalities."""
    if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONSTRAINT:
        return False
    touching = model.geom_contype.any() and model.geom_conaffinity.any()
    limited = model.jnt_limited.any() or model.tendon_limited.any()
    rubbing = model.dof_frictionloss.any() or model.tendon_frictionloss.any()
    return bool(model.neq or model.npair or touching or limited or rubbing)
