"""Mistakes in an MJCF: each makes the model impossible, or lets its physics break down."""

from attacks.mistaken_tasks import Mistakes

SERVO = '<velocity name="lateral" joint="y" kv="12" ctrlrange="-1 1"/>'
OPTION = '<option timestep="0.01" integrator="implicitfast" gravity="0 0 0"/>'
SAMPLE = '<numeric name="sample_time" data="0.05"/>'
BALL = 'size="0.1 0.05" mass="1"'
KEY = '<key name="start" qpos="0 0" ctrl="1 0"/>'
SENSOR_X, SENSOR_Y = '<jointpos name="x" joint="x"/>', '<jointpos name="y" joint="y"/>'
TOUCH = '<contact name="touching" geom1="puck" data="found"/>'
JOINT = '<joint name="y" type="slide" axis="0 1 0"/>'


def changed(where: str, text: str, old: str, *values: str) -> Mistakes:
    """Returns the mistakes of other values in an element."""
    return {f"{where} {value or 'removed'}": (text, text.replace(old, value)) for value in values}


MODELS: Mistakes = {
    "cut in half": ("</worldbody>", ""),
    "no XML": ("<mujoco model", "mujoco model"),
    "another root": ("mujoco", "robot"),
    "of another file": ("<worldbody>", '<include file="/etc/passwd"/><worldbody>'),
    "of a file that is missing": ("<worldbody>", '<include file="arm.xml"/><worldbody>'),
    "of itself": ("<worldbody>", '<include file="puck.xml"/><worldbody>'),
    "an entity that grows": (
        "<mujoco model",
        '<!DOCTYPE m [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;">]><mujoco model',
    ),
    "a mesh that is missing": ("<asset>", '<asset><mesh name="m" file="arm.stl"/>'),
    "a plugin of nobody": ("<worldbody>", '<extension><plugin plugin="evil.so"/></extension><worldbody>'),
    "memory of 1000 GB": ("<custom>", '<size memory="1000G"/><custom>'),
    **changed(
        "timestep", OPTION, 'timestep="0.01"', 'timestep="0"', 'timestep="-0.01"', 'timestep="nan"',
        'timestep="1e-9"', 'timestep="10"', 'timestep="0.03"', 'timestep="a"',
    ),
    **changed(
        "gravity", OPTION, 'gravity="0 0 0"', 'gravity="1e30 0 0"', 'gravity="nan 0 0"',
        'gravity="inf 0 0"', 'gravity="0 1e6 0"',
    ),
    **changed(
        "sample_time", SAMPLE, 'data="0.05"', 'data="0"', 'data="-0.05"', 'data="nan"',
        'data="0.055"', 'data="1000"', 'data="1e9"', 'data="0.05 0.05"', "",
    ),
    **changed(
        "servo", SERVO, 'kv="12"', 'kv="1e9"', 'kv="1e300"', 'kv="-12"', 'kv="-1e6"', 'kv="nan"',
        'kv="0"',
    ),
    **changed(
        "servo", SERVO, 'ctrlrange="-1 1"', 'ctrlrange="1 -1"', 'ctrlrange="0 0"', "",
        'ctrlrange="-1e300 1e300"', 'ctrlrange="nan 1"', 'ctrlrange="-1e9 1e9"',
        'ctrllimited="false"',
    ),
    **changed("servo", SERVO, 'joint="y"', 'joint="nobody"', 'joint="x"', ""),
    "no servo": (SERVO, ""),
    "an explosive servo": (
        SERVO, '<position name="lateral" joint="y" kp="1e12" ctrlrange="-1 1"/>'
    ),
    "an unstable motor": (SERVO, '<motor name="lateral" joint="y" gear="1e12" ctrlrange="-1 1"/>'),
    "no actuators": ("actuator>", "custom>"),
    **changed(
        "puck", BALL, 'mass="1"', 'mass="0"', 'mass="-1"', 'mass="1e-300"', 'mass="nan"', 'mass="1e300"'
    ),
    **changed("puck", BALL, 'size="0.1 0.05"', 'size="0 0"', 'size="nan 1"', 'size="1e30 1"', 'size="-1 1"'),
    **changed("joint", JOINT, 'axis="0 1 0"', 'axis="0 0 0"', 'axis="nan 0 0"'),
    "a spring that breaks down": (JOINT, JOINT.replace("/>", ' stiffness="1e15"/>')),
    "a spring that pushes": (JOINT, JOINT.replace("/>", ' stiffness="-1e9"/>')),
    "a damper that pushes": (JOINT, JOINT.replace("/>", ' damping="-1e6"/>')),
    "no joint": (JOINT, ""),
    "two joints of one name": (JOINT, JOINT + JOINT),
    "a joint that turns": (JOINT, JOINT.replace("slide", "ball")),
    "no sensor of x": (SENSOR_X, ""),
    "no sensor of touch": (TOUCH, ""),
    "a sensor of nothing": (TOUCH, TOUCH.replace("puck", "nobody")),
    "sensors in another order": (
        f"{SENSOR_X}\n    {SENSOR_Y}", f"{SENSOR_Y}\n    {SENSOR_X}"
    ),
    "a sensor too many": (TOUCH, f'{TOUCH}<jointvel name="vx" joint="x"/>'),
    "no sensors": ("sensor>", "custom>"),
    "no obstacle": ('name="obstacle"', 'name="pillar"'),
    "no puck": ('name="puck"', 'name="ball"'),
    "an obstacle everywhere": ('size="0.5 0.1"', 'size="50 0.1"'),
    **changed("keyframe", KEY, 'qpos="0 0"', 'qpos="nan 0"', 'qpos="0"', 'qpos="0 0 0"'),
    **changed("keyframe", KEY, 'ctrl="1 0"', 'ctrl="nan 0"', 'ctrl="1"', 'ctrl="1e300 0"', 'ctrl="inf 0"'),
}  # fmt: skip
