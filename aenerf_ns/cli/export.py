"""``aenerf export-trajectory``, ``-cameras``, ``-frames``, ``-mesh`` and ``-video``: a trained run for other tools."""

from __future__ import annotations

import shlex
import shutil
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from aenerf_ns.cli.console import say
from aenerf_ns.cli.ranges import RATES, require_range
from aenerf_ns.cli.trained_run import RunCommand, open_run
from aenerf_ns.errors import DataError
from aenerf_ns.files.output_paths import creating, require_absent, require_writable

_MESH_SUFFIXES = (".ply", ".glb", ".obj")
# More than anybody needs. They would fill the memory.
_MAX_POINTS, _MAX_VIEWS = 10_000_000, 10_000


@dataclass
class ExportTrajectory(RunCommand):
    """Write the poses of a trained run in TUM format: t tx ty tz qx qy qz qw, in seconds, camera-to-world, OpenCV axes,
    in the world and the units of the recording."""

    output: Path
    """Text file to write."""
    poses: Literal["corrected", "estimated", "ground-truth"] = "corrected"
    """corrected: after the run's pose correction. estimated: as given to the run. ground-truth: the true poses, within
    the run's time window."""
    rate: float | None = None
    """Poses a second of the run's time window; by default at the times of the given or the true poses."""

    def main(self) -> None:
        """Load the run and write its poses."""
        if self.rate is not None:
            require_range("rate", self.rate, *RATES)
        require_writable(self.output)
        _, run, _ = open_run(self.load_config, self.data, test_mode="inference")
        import torch

        from aenerf_ns.camera.trajectory import Trajectory
        from aenerf_ns.export.times import times_at_rate
        from aenerf_ns.files.tum_trajectory import write_tum_trajectory

        correction = run.model.camera_optimizer
        trajectory = estimated = correction.trajectory
        if self.poses == "ground-truth":
            true = run.scene.ground_truth
            if true is None:
                raise DataError(run.data, "it has no true poses", "export corrected or estimated ones")
            trajectory = true.to(run.device).crop(estimated.start, estimated.end)
        times = trajectory.times
        if self.rate is not None:
            times = times_at_rate(run.scene.window, self.rate).to(run.device)
            # The true poses may not cover all of it.
            times = times[(times >= trajectory.start) & (times <= trajectory.end)]
            if len(times) < 2:
                raise DataError("--rate", f"{self.rate:g} poses a second give no two poses", "give a higher one")
        source = correction if self.poses == "corrected" else trajectory
        with torch.no_grad():
            poses = source.pose(trajectory.seconds(times))
        written = Trajectory(times.cpu(), run.scene.to_recording(poses))
        with creating(self.output) as file:
            write_tum_trajectory(file, written)
        say(f"{self.output}: {len(written)} {self.poses} poses.")


@dataclass
class ExportCameras(RunCommand):
    """Write the cameras of a recording's images, at the corrected poses of a trained run, so that a trainer of splats
    or NeRFs starts from them: a COLMAP model (sparse/0), transforms.json, and points of the scene. All are in the world
    and the units of the recording. The images are linked."""

    output: Path
    """Folder to create."""
    copy: bool = False
    """Copy the images in place of linking them."""
    num_points: int = 20_000
    """The most points of the scene to write, of those that the run renders. Trainers of splats begin with them."""

    def main(self) -> None:
        """Load the run and write cameras, points and images."""
        require_absent(self.output)
        require_range("num-points", self.num_points, 1, _MAX_POINTS)
        _, run, _ = open_run(self.load_config, self.data, test_mode="inference")
        from aenerf_ns.export.camera_model_files import IMAGE_FOLDER, write_cameras
        from aenerf_ns.export.rendering import observe_points, place_views

        placed = place_views(run)
        images = [image for image, _ in placed]
        points = observe_points(run, images, self.num_points)
        with creating(self.output) as folder:
            for image, file in placed:
                target = folder / IMAGE_FOLDER / image.name
                target.parent.mkdir(parents=True, exist_ok=True)
                # Some disks hold no links.
                with suppress(OSError):
                    if not self.copy:
                        target.symlink_to(file.resolve())
                        continue
                shutil.copyfile(file, target)
            write_cameras(folder, images, points)
        data = shlex.quote(str(self.output))
        say(
            f"{self.output}: {len(images)} images with cameras, {len(points.positions)} points. Train on them with:\n"
            f"  ns-train splatfacto --data {data} nerfstudio-data --load-3D-points True\n"
            f"  ns-train nerfacto --data {data} colmap --colmap-path sparse/0"
        )


@dataclass
class ExportFrames(RunCommand):
    """Render frames and depths from the corrected poses at chosen times, and write them with their times and their
    cameras as export-cameras does, in the world and the units of the recording."""

    output: Path
    """Folder to create."""
    rate: float | None = None
    """Frames a second of the recording; 10 by default."""
    times: tuple[str, ...] = ()
    """Times of the frames in seconds, on the clock of the events, in place of a rate."""
    num_points: int = 20_000
    """The most points of the scene to write."""

    def main(self) -> None:
        """Load the run, render and write."""
        require_absent(self.output)
        require_range("num-points", self.num_points, 1, _MAX_POINTS)
        if self.rate is not None:
            if self.times:
                raise DataError("aenerf export-frames", "--rate and --times are given", "leave out one of the two")
            require_range("rate", self.rate, *RATES)
        _, run, _ = open_run(self.load_config, self.data, test_mode="inference")
        from aenerf_ns.export.frames import FARTHEST, export_frames
        from aenerf_ns.export.times import times_at_rate, times_from_seconds

        if self.times:
            times = times_from_seconds(run.scene.window, self.times)
        else:
            times = times_at_rate(run.scene.window, 10.0 if self.rate is None else self.rate)
        with creating(self.output) as folder:
            far_share = export_frames(run, folder, times, self.num_points)
        say(f"{self.output}: {len(times)} frames with depths, times and cameras.")
        if far_share > 0:
            # As of poses in millimeters.
            say(f"{far_share:.1%} of the pixels are over {FARTHEST:g} units of the recording away: their depth is 0.")


@dataclass
class ExportMesh(RunCommand):
    """Fuse the depths that a trained run renders along its corrected trajectory in a truncated signed distance field,
    and write the surface as a colored mesh, in the world and the units of the recording."""

    output: Path
    """Mesh file to write: .ply, .glb or .obj."""
    resolution: int = 256
    """Voxels along the longest side of the box: the scene's box where the dataset states one, else the box of what the
    views see."""
    num_views: int = 60
    """Views, evenly spread over the time of the run."""

    def main(self) -> None:
        """Load the run, extract the mesh and write it."""
        if self.output.suffix.lower() not in _MESH_SUFFIXES:
            raise DataError(self.output, "not a mesh file", "choose another --output, ending with .ply, .glb or .obj")
        require_writable(self.output)
        require_range("resolution", self.resolution, 8, 2048)
        # A surface counts where two views see it.
        require_range("num-views", self.num_views, 2, _MAX_VIEWS)
        _, run, _ = open_run(self.load_config, self.data, test_mode="inference")
        from aenerf_ns.export.mesh import extract_mesh

        # Vertex colors of glTF are linear, those of the others sRGB.
        is_linear = self.output.suffix.lower() == ".glb"
        mesh = extract_mesh(run, self.num_views, self.resolution, "linear" if is_linear else "srgb")
        with creating(self.output) as file:
            mesh.export(file)
        sides = " x ".join(f"{side:.3g}" for side in mesh.extents)
        say(f"{self.output}: {len(mesh.faces)} triangles, {sides} units of the recording.")


@dataclass
class ExportVideo(RunCommand):
    """Write a video along the corrected trajectory of a trained run. Beside each other it shows the recorded events,
    the events that the rendering triggers, the rendering, its depth, and the last image that was taken on the
    trajectory, where there are images."""

    output: Path
    """Video file to write, ending with .mp4."""
    rate: float = 50.0
    """Frames a second of the recording. A frame shows the events since the frame before."""
    frame_rate: float = 25.0
    """Frames a second of the video: with the defaults, it shows everything at half the speed."""

    def main(self) -> None:
        """Load the run, render and write the video."""
        if self.output.suffix.lower() != ".mp4":
            raise DataError(self.output, "only videos of the kind .mp4 are written", "end the --output with .mp4")
        require_range("rate", self.rate, *RATES)
        require_range("frame-rate", self.frame_rate, 0.1, 1000)
        require_writable(self.output)
        _, run, _ = open_run(self.load_config, self.data, test_mode="inference")
        from aenerf_ns.cli.video_file import write_video
        from aenerf_ns.export.times import times_at_rate
        from aenerf_ns.export.video import render_panels

        run.scene.event_file.require()
        times = times_at_rate(run.scene.window, self.rate)
        if len(times) < 2:
            raise DataError("--rate", f"{self.rate:g} frames a second give no two frames", "give a higher one")
        with creating(self.output) as file:
            num_frames = write_video(file, render_panels(run, times), self.frame_rate)
        say(f"{self.output}: {num_frames} frames.")
