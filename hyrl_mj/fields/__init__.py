"""Fields: a controller that passes any number of posts, with two policies that were trained on one."""

from hyrl_mj.fields.controller import (
    FocusController,
    acting_policy,
    controllers,
    exported_controller,
    for_posts,
)
from hyrl_mj.fields.drives import (
    DriveOptions,
    Drives,
    changes,
    drive,
    ending,
    least_clearance,
    noise_cautions,
)
from hyrl_mj.fields.driving import Bounds, Driving
from hyrl_mj.fields.files import read_field
from hyrl_mj.fields.focus import decoded, encoded
from hyrl_mj.fields.survey import cautions, check_passable

__all__ = [
    "Bounds",
    "DriveOptions",
    "Drives",
    "Driving",
    "FocusController",
    "acting_policy",
    "cautions",
    "changes",
    "check_passable",
    "controllers",
    "decoded",
    "drive",
    "encoded",
    "ending",
    "exported_controller",
    "for_posts",
    "least_clearance",
    "noise_cautions",
    "read_field",
]
