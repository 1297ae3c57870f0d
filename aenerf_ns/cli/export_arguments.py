"""The arguments of the commands that show a trained run or hand it on, and what can be judged of them at once.

As in ``arguments.py``, nothing here imports torch or the framework.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from aenerf_ns.cli.arguments import require_rate, told
from aenerf_ns.cli.operands import RunConfig
from aenerf_ns.errors import DataError
from aenerf_ns.files.output_paths import require_new, require_writable

_MESH_FILES = (".ply", ".glb", ".obj")


# More than anybody needs. They would fill the memory.
_MOST_POINTS, _MOST_VIEWS = 10_000_000, 10_000


def _require_some(command: str, name: str, count: int, most: int) -> None:
    if not 1 <= count <= most:
        raise DataError(command, f"{told(count)} {name}", f"give from 1 to {most:,}")


@dataclass
class ExportCamerasArguments:
    """Write the cameras of a recording's images, at the corrected poses of a trained run, so that a trainer of splats
    or NeRFs starts from them: a COLMAP model (sparse/0), transforms.json, and points of the scene. All are in the world
    and the units of the recording. The images are linked."""

    load_config: RunConfig
    output: Path
    """Folder to create."""
    copy: bool = False
    """Copy the images in place of linking them."""
    num_points: int = 20_000
    """The most points of the scene to write, of those that the run renders. Trainers of splats begin with them."""

    def judge(self) -> None:
        """Raise a DataError if the output is in the way, or no points are asked for."""
        require_new(self.output)
        _require_some("aenerf export-cameras", "points", self.num_points, _MOST_POINTS)


@dataclass
class ExportFramesArguments:
    """Render frames and depths from the corrected poses at chosen times, and write them with their times and their
    cameras as export-cameras does, in the world and the units of the recording."""

    load_config: RunConfig
    output: Path
    """Folder to create."""
    rate: float | None = None
    """Frames a second of the recording; 10 by default."""
    times: tuple[float, ...] = ()
    """Times of the frames in seconds, on the clock of the events, in place of a rate."""
    num_points: int = 20_000
    """The most points of the scene to write."""

    def judge(self) -> None:
        """Raise a DataError if the output is in the way, times are given twice, or no points are asked for."""
        require_new(self.output)
        _require_some("aenerf export-frames", "points", self.num_points, _MOST_POINTS)
        if self.times and self.rate is not None:
            raise DataError("aenerf export-frames", "--rate and --times are given", "leave out one of the two")
        if self.rate is not None:
            require_rate("aenerf export-frames", self.rate)


@dataclass
class ExportMeshArguments:
    """Fuse the depths that a trained run renders along its corrected trajectory in a truncated signed distance field,
    and write the surface as a coloured mesh, in the world and the units of the recording."""

    load_config: RunConfig
    output: Path
    """Mesh file to write: .ply, .glb or .obj."""
    resolution: int = 256
    """Voxels along the longest side of the box: the scene's box where the dataset states one, else the box of what the
    views see."""
    num_views: int = 60
    """Views, evenly spread over the time of the run."""

    def judge(self) -> None:
        """Raise a DataError if the output is no mesh file or cannot be written, or the resolution is impossible."""
        if self.output.suffix not in _MESH_FILES:
            raise DataError(self.output, "not a mesh file", "choose another --output, ending with .ply, .glb or .obj")
        require_writable(self.output, "--output")
        if not 8 <= self.resolution <= 2048:
            raise DataError("aenerf export-mesh", f"a resolution of {self.resolution}", "give one from 8 to 2048")
        _require_some("aenerf export-mesh", "views", self.num_views, _MOST_VIEWS)


@dataclass
class ExportVideoArguments:
    """Write a video along the corrected trajectory of a trained run. Beside each other it shows the recorded events,
    the events that the rendering triggers, the rendering, its depth, and the last image that was taken on the
    trajectory, where there are images."""

    load_config: RunConfig
    output: Path
    """Video file to write, ending with .mp4."""
    rate: float = 50.0
    """Frames a second of the recording. A frame shows the events since the frame before."""
    frame_rate: float = 25.0
    """Frames a second of the video: with the defaults, it shows everything at half the speed."""

    def judge(self) -> None:
        """Raise a DataError if the output cannot be written, or the frame rate is impossible."""
        if self.output.suffix.lower() != ".mp4":
            raise DataError(self.output, "only videos of the kind .mp4 are written", "end the --output with .mp4")
        if not 0.1 <= self.frame_rate <= 1000:
            raise DataError("aenerf export-video", f"a frame rate of {self.frame_rate}", "give one from 0.1 to 1000")
        require_rate("aenerf export-video", self.rate)
        require_writable(self.output, "--output")


@dataclass
class ReportArguments:
    """Measure trained runs and write report.html, one page that opens without a network, with views.csv and
    report.json beside it. Several runs are compared view by view."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN [RUN ...]")]
    """The runs: each by its config.yml or its folder."""
    output: Path = Path("report")
    """Folder to write to. Files of an earlier report there are replaced."""
    allow_different_protocols: bool = False
    """Compare runs although they were measured differently. The page then says how."""

    def judge(self) -> None:
        """Raise a DataError if no run is given, or the page cannot be written."""
        if not self.runs:
            raise DataError("aenerf report", "no run is given", "name the folder or the config.yml of one or more")
        require_writable(self.output / "report.html", "--output")
