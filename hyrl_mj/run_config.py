"""The file `config.json` of a run directory: every setting, and the versions that the run began with."""

from __future__ import annotations

import platform
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from hyrl_mj import artifacts
from hyrl_mj.learning import Settings

# The packages whose versions `config.json` records.
PACKAGES = (
    "hyrl-mj", "mujoco", "gymnasium", "stable-baselines3", "torch", "numpy", "mediapy",
)  # fmt: skip


@dataclass(frozen=True)
class Config:
    """The content of `config.json`.

    Attributes:
        settings: every setting of the run.
        versions: the versions of Python and the packages when the run began.
    """

    settings: Settings
    versions: dict[str, str]

    @staticmethod
    def load(path: Path) -> Config:
        """Reads `config.json`; raises `BadArtifact` if it is damaged or of another version."""
        return artifacts.read_record(path, "run", Config, "start a new run with another --out")

    @staticmethod
    def of(settings: Settings, versions: dict[str, str] | None = None) -> Config:
        """Returns the settings with versions, by default those of now."""
        if versions is None:
            versions = {name: version(name) for name in PACKAGES}
            versions["python"] = platform.python_version()
        return Config(settings, versions)
