"""What a model remembers beside positions and velocities, and why one cannot be simulated as it is meant."""

from __future__ import annotations

import mujoco
import numpy as np

from hyrl_mj.physics import mjcf

# The version of MuJoCo that computes wrong constraint forces where the Jacobian is sparse.
WRONG_VERSION = "4.0.0"


def remembers(model: mujoco.MjModel) -> str:
    """Returns what else than positions and velocities a model carries from step to step; "" if nothing."""
    # These parts of MuJoCo's state remember nothing: `Plant.set_state` and each sample give them anew, or
    # they are solved anew from there. Nothing but callbacks writes userdata.
    anew = (
        "TIME", "QPOS", "QVEL", "WARMSTART", "CTRL", "QFRC_APPLIED", "XFRC_APPLIED", "EQ_ACTIVE",
        "MOCAP_POS", "MOCAP_QUAT", "USERDATA",
    )  # fmt: skip
    memories = {  # later versions of MuJoCo have more
        "ACT": "activations of actuators (dyntype)",
        "HISTORY": "histories of actuators or sensors (delay, nsample)",
        "PLUGIN": "states of plugins",
    }
    for bit in (1 << k for k in range(int(mujoco.mjtState.mjNSTATE))):
        name = mujoco.mjtState(bit).name.removeprefix("mjSTATE_")
        if name not in anew and mujoco.mj_stateSize(model, bit):
            return memories.get(name, f"a state {name} beside positions and velocities")
    callbacks = ("control", "passive", "act_dyn", "act_gain", "act_bias", "sensor")
    if any(getattr(mujoco, f"get_mjcb_{name}")() is not None for name in callbacks):
        return "what a callback of MuJoCo knows (mujoco.set_mjcb_...)"
    return ""


def unusable(model: mujoco.MjModel) -> str:
    """Returns why a model cannot be simulated as it is meant, and the remedy; "" if it can."""
    return wrong_physics(model) or sleeping(model) or keyed_mocap(model) or late_sensor(model)


def sleeping(model: mujoco.MjModel) -> str:
    """Returns that bodies of a model may fall asleep, and the remedy; "" if they may not."""
    if not model.opt.enableflags & getattr(mujoco.mjtEnableBit, "mjENBL_SLEEP", 0):
        return ""
    return (
        f"{mjcf.model_name(model)} lets bodies sleep, and which are asleep is no part of MuJoCo's state, so "
        'that runs go otherwise from where they are put: leave <flag sleep="enable"/> out'
    )


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
        f"MuJoCo 4.0.0 computes wrong constraint forces for {mjcf.model_name(model)}, whose Jacobian is "
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


def keyed_mocap(model: mujoco.MjModel) -> str:
    """Returns which mocap body the first keyframe places, and the remedy, as a sentence; "" if none.

    Mocap bodies stand where the MJCF puts them, or where the task's `mocap` does.
    """
    if not (model.nkey and model.nmocap):
        return ""
    placed = mjcf.mocap_frames(model)
    keyed = np.hstack([model.key_mpos[0].reshape(-1, 3), model.key_mquat[0].reshape(-1, 4)])
    apart = ~np.isclose(keyed, placed, atol=1e-9).all(axis=1)
    if not apart.any():
        return ""
    i = int(apart.argmax())
    body = mjcf.names(model, mujoco.mjtObj.mjOBJ_BODY)[int((model.body_mocapid == i).argmax())]
    return (
        f"the first keyframe of {mjcf.model_name(model)} places mocap body {body} at "
        f"{keyed[i, :3].tolist()}, and its pos is {placed[i, :3].tolist()}: give the place as the body's pos "
        "and quat, or by mocap() of the task"
    )


def late_sensor(model: mujoco.MjModel) -> str:
    """Returns which sensor holds or delays its values or has noise, and the remedy; "" if none does."""
    for i, name in enumerate(mjcf.names(model, mujoco.mjtObj.mjOBJ_SENSOR)):
        period, delay = float(model.sensor_interval[i].max()), float(model.sensor_delay[i])
        if period > 0 or delay > 0:
            does, part = (
                (f"holds its value for {period:g} s", "hold")
                if period > 0
                else (f"is {delay:g} s late", "delay")
            )
            return (
                f"sensor {name} of {mjcf.model_name(model)} {does}, and the true state is taken from the "
                "sensors: leave out its interval and delay, and say in the task what its sensors do, as "
                f"sensor = '{part} 2' for two samples"
            )
        if noise := float(model.sensor_noise[i]):
            return (
                f"sensor {name} of {mjcf.model_name(model)} has noise={noise:g}, which MuJoCo adds nowhere: "
                f"leave it out, and say in the task what its sensors do, as sensor = 'gaussian {3 * noise:g}'"
            )
    return ""


def why_not_direct(model: mujoco.MjModel) -> str:
    """Returns what stands between the controls of a model's actuators and its joints; "" if nothing does.

    Without contacts and constraints, nothing is left that changes suddenly from one place to the next.
    """
    actuators = mjcf.names(model, mujoco.mjtObj.mjOBJ_ACTUATOR)
    drives = int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)
    biases = int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE)
    for i, name in enumerate(actuators):
        if model.actuator_trntype[i] not in drives:
            return f"actuator {name} does not drive a joint"
        if (
            model.actuator_gaintype[i] != int(mujoco.mjtGain.mjGAIN_FIXED)
            or model.actuator_biastype[i] not in biases
        ):
            return f"the force of actuator {name} is not linear"
        if model.actuator_forcelimited[i]:
            return f"the forcerange of actuator {name} limits how it follows"
    if model.jnt_actfrclimited.any():
        return "an actuatorfrcrange of a joint limits how it follows"
    if model.ntendon:
        return "tendons can pull from place to place"
    if model.nplugin or getattr(model, "nflex", 0):
        return "plugins and flexible bodies can move it"
    # Older versions of MuJoCo do not have these coefficients.
    bent = ("jnt_stiffnesspoly", "dof_dampingpoly", "actuator_dampingpoly", "jnt_springyield")
    if any(np.any(getattr(model, name, 0)) for name in bent):
        return "springs or dampers that are not linear can move it"
    return ""
