"""MuJoCo: models, the plants that step them in batches, and the renderer."""

from hyrl_mj.physics import mjcf

__all__ = ["memory", "mjcf", "mujoco_log", "plant", "rendering"]
