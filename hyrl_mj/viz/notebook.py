"""A run in Python and in notebooks: its figures, replays and tables, and new simulations, as methods."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from hyrl_mj.errors import BadInput, unknown
from hyrl_mj.policies import AnyPolicy
from hyrl_mj.runs import directory
from hyrl_mj.simulation import AnyNoise
from hyrl_mj.tasks import Task
from hyrl_mj.viz.options import ReplayOptions
from hyrl_mj.viz.tables import robustness_rows

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

# What `dir` lists: the rest is for the stages.
ATTRIBUTES = (
    "path", "settings", "versions", "task", "agent", "policy", "controller", "controllers", "critical_set",
    "partition", "extended_sets", "mode_policies", "arrivals", "retraining", "robustness", "verdict", "arcs",
    "lost", "simulate", "plot", "replay", "to_dataframe",
)  # fmt: skip


class Replay:
    """A replay that a notebook shows as a video.

    Args:
        render: writes it to a path, as `render_replay`.
        path: an mp4 of it, if there is one.

    Attributes:
        content: of the mp4.
    """

    def __init__(self, render: Callable[[Path], None], path: Path | None = None):
        self._render = render
        with TemporaryDirectory() as folder:
            if path is None:
                render(path := Path(folder) / "replay.mp4")
            self.content = path.read_bytes()

    def __repr__(self) -> str:
        return (
            f"Replay({len(self.content):,} bytes of mp4: a notebook shows it, save(PATH) writes it)"
        )

    def _repr_html_(self) -> str:
        source = f"data:video/mp4;base64,{b64encode(self.content).decode()}"
        return f'<video controls loop style="max-width: 100%" src="{source}"></video>'

    def save(self, path: str | Path) -> None:
        """Writes it to an mp4 or a gif, with the last frame as a PNG of the same name, or to a PNG alone.

        Raises:
            BadInput: the path has another suffix, or cannot be written.
        """
        if not isinstance(path, str | Path):
            raise BadInput(f"{path!r:.80} is no file: give its path, as replay.mp4")
        self._render(Path(path))


class Run(directory.Run):
    """A run directory, whose files are read when needed; `dir` lists what it has.

    Attributes:
        path: the directory.
        settings: every setting of the run.
    """

    @classmethod
    def of(cls, run: directory.Run) -> Run:
        """Returns a run with these methods, which knows what the given one has read."""
        shown = cls(run.path, run.settings, run.function)
        vars(shown).update(vars(run))
        return shown

    def __dir__(self) -> list[str]:
        return [*ATTRIBUTES]

    if not TYPE_CHECKING:  # which knows the attributes by itself

        def __getattr__(self, name: str) -> Any:
            if hasattr(type(self), name):  # a property that could not find something else: say what
                return object.__getattribute__(self, name)
            raise AttributeError(unknown("attribute of a run", name, ATTRIBUTES))

    def plot(self, figure: str = "overview") -> Figure:
        """Draws a figure of the run.

        Args:
            figure: overview, policy, extended_sets, robustness_map, robustness_curve or runs.

        Raises:
            BadInput: there is no such figure, or the chart cannot be drawn so.
            BadArtifact: a stage that it shows has not run.
        """
        from hyrl_mj.viz.figures import FIGURES, Shown

        if figure not in [*FIGURES]:
            raise unknown("figure", figure, FIGURES)
        return FIGURES[figure].draw(Shown(self))

    def simulate(
        self,
        z0: ArrayLike,
        noise: str | AnyNoise = "alternating",
        eps: float | None = None,
        q0: int | None = None,
        horizon: float | None = None,
        seed: int = 0,
    ) -> dict[str, Any]:
        """Simulates policy and hybrid controller from the same starts under the same kind of noise.

        Args:
            z0: one start (d,), or n starts (n, d), in the chart.
            noise: a kind, as "uniform"; "worst" or "attack" for the signal that is strongest against each
                controller; or a `Noise` or `Sensor` with bounds of its own.
            eps: bound of the noise, by default the run's.
            q0: the start mode, by default the controller picks it.
            horizon: time to simulate [s], by default the task's.
            seed: of the noise.

        Returns:
            The `HybridArc` of "policy" and of "hyrl", or for several starts a list of them.

        Raises:
            BadInput: a value that cannot be used, or a worst case that cannot be played.
        """
        from hyrl_mj.runs.arcs import noisy_arcs

        starts = self.task.chart.check(z0, self.task.name)
        found = noisy_arcs(self, starts, noise, eps, (q0,), horizon, seed).values()
        runs = zip(("policy", "hyrl"), found, strict=True)
        return {who: arcs[0] if np.ndim(z0) < 2 else arcs for who, arcs in runs}

    def replay(
        self,
        starts: str | ArrayLike = "critical",
        noise: str | AnyNoise | None = None,
        eps: float | None = None,
        *,
        layout: str = "side-by-side",
        camera: str | None = None,
        size: tuple[int, int] = (1280, 720),
        fps: int = 30,
        slow_motion: float = 1.0,
    ) -> Replay:
        """Renders policy and hybrid controller under the same noise, as a video that a notebook shows.

        Without arguments that is the video of the run directory, if it is there.

        Args:
            starts: "critical", "paper" or "latest", as of `hyrl-mj replay`, or starts (n, d) in the chart.
            noise: as of `simulate`; by default that of the arcs on disk, and alternating from given starts.
            eps: bound of the noise, by default the run's.
            layout: side-by-side, or overlay (both controllers in one scene).
            camera: a camera of the MJCF, by default the scene's.
            size: width and height [pixels], even numbers.
            fps: frames per second.
            slow_motion: how many times slower the video is around jumps.

        Raises:
            BadInput: a value that cannot be used.
            NoRenderer: there is no GL library or no video encoder.
        """
        from hyrl_mj.viz.replay import check_replay, render_replay
        from hyrl_mj.viz.shows import replay_floor, replay_shows

        options = ReplayOptions(layout, camera, size, fps, slow_motion)
        check_replay(self.task, Path("replay.mp4"), options)
        shows = replay_shows(self, starts, noise, eps)

        def render(path: Path) -> None:
            render_replay(self.task, shows, path, options, floor=replay_floor(self))

        own = self.path / "replay.mp4"
        usual = isinstance(starts, str) and starts == "critical" and noise is eps is None
        usual = usual and options == ReplayOptions()
        return Replay(render, own if usual and self.manifest.has(own) else None)

    def to_dataframe(self) -> DataFrame:
        """Returns what noise can do as a DataFrame of pandas, as `robustness_rows`.

        Raises:
            BadInput: pandas is not installed, or the run has not been examined.
        """
        try:
            from pandas import DataFrame
        except ImportError:
            raise BadInput("a DataFrame takes pandas: pip install pandas") from None
        return DataFrame(robustness_rows(self.robustness))


def load_run(
    path: str | Path, policy: AnyPolicy | None = None, task: str | Path | Task | None = None
) -> Run:
    """Opens a run directory. No code runs but that of installed packages.

    Args:
        path: the directory.
        policy: the agent of the run, if it is Python code, which no file can hold.
        task: the Python file that defines the task, if the task is the user's and this machine has not run
            it before. The file is executed.

    Raises:
        BadArtifact: the directory holds no run, or a link.
        BadInput: the task is in a file that must be named first.
    """
    return Run.of(directory.load_run(path, policy, task))
