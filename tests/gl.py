"""A mark for tests that draw: where there is no GL library they are skipped, but never in CI."""

import os

import pytest

from hyrl_mj import NoRenderer, get_task
from hyrl_mj.physics.rendering import SceneRenderer


def can_render() -> bool:
    """Whether this machine draws off-screen."""
    try:
        SceneRenderer(get_task("vehicle").model, 64, 48).close()
    except NoRenderer:
        return False
    return True


needs_gl = pytest.mark.skipif(
    "CI" not in os.environ and not can_render(), reason="no GL library on this machine"
)
