"""What a model remembers beside positions and velocities, and which sensors tell of the past."""

from __future__ import annotations

import mujoco
import numpy as np

from hyrl_mj.physics import compiled


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
    return compiled.wrong_physics(model) or compiled.keyed_mocap(model) or late_sensor(model)


def late_sensor(model: mujoco.MjModel) -> str:
    """Returns which sensor holds or delays its values, and the remedy, as a sentence; "" if none does."""
    for i, name in enumerate(compiled.names(model, mujoco.mjtObj.mjOBJ_SENSOR)):
        period, delay = float(model.sensor_interval[i].max()), float(model.sensor_delay[i])
        if period > 0 or delay > 0:
            does = f"holds its value for {period:g} s" if period > 0 else f"is {delay:g} s late"
            return (
                f"sensor {name} of {compiled.model_name(model)} {does}, and the true state is taken from the "
                "sensors: leave out its interval and delay"
            )
    return ""


def why_not_direct(model: mujoco.MjModel) -> str:
    """Returns what stands between the controls of a model's actuators and its joints; "" if nothing does.

    Without contacts and constraints, nothing is left that changes suddenly from one place to the next.
    """
    actuators = compiled.names(model, mujoco.mjtObj.mjOBJ_ACTUATOR)
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
