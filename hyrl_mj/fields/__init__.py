"""Fields: a controller that passes any number of posts, with two policies that were trained on one."""

from hyrl_mj.fields.controller import FocusController, decoded, encoded

__all__ = ["FocusController", "decoded", "encoded"]
