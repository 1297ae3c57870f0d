"""``aenerf export-trajectory``: the poses of a trained run, in the recording's world, for other tools."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.utils.eval_utils import eval_setup
from nerfstudio.utils.rich_utils import CONSOLE

from aenerf_ns.dataparsers.tum_trajectory import write_tum_trajectory
from aenerf_ns.errors import DataError
from aenerf_ns.trajectory.trajectory import OPENCV_TO_OPENGL, Trajectory, homogeneous


@dataclass
class ExportTrajectory:
    """Write the poses of a trained run in TUM format: t tx ty tz qx qy qz qw, in seconds, camera-to-world, OpenCV axes,
    in the world and the units of the recording."""

    load_config: Path
    """config.yml of the run."""
    output: Path
    """Text file to write."""
    poses: Literal["corrected", "estimated"] = "corrected"
    """After the run's pose correction, or as they were given (within the run's time window)."""
    rate: float | None = None
    """Poses a second; by default at the times of the estimated poses."""

    def main(self) -> None:
        """Loads the run and writes its poses."""
        if self.rate is not None and not 0 < self.rate < float("inf"):
            raise DataError("aenerf export-trajectory", f"a rate of {self.rate}", "it must be positive")
        if not self.load_config.is_file():
            raise DataError(self.load_config, "there is no such file", "give the config.yml of a trained run")
        _, pipeline, _, _ = eval_setup(self.load_config, test_mode="inference")
        correction = pipeline.model.camera_optimizer
        trajectory: Trajectory = correction.trajectory
        times = trajectory.times
        if self.rate is not None:
            times = torch.arange(trajectory.start, trajectory.end + 1, round(1e9 / self.rate), device=times.device)
        seconds = trajectory.seconds(times)
        with torch.no_grad():
            poses = (correction if self.poses == "corrected" else trajectory).pose(seconds)
        written = Trajectory(times.cpu(), _in_world(poses.cpu(), pipeline.datamanager.train_dataparser_outputs))
        write_tum_trajectory(self.output, written)
        CONSOLE.print(f"{self.output}: {len(written)} {self.poses} poses.")


def _in_world(poses: torch.Tensor, outputs: DataparserOutputs) -> torch.Tensor:
    """(N, 4, 4) poses with OpenCV axes in the recording's world of (N, 3, 4) ones with OpenGL axes in the scene's."""
    poses = homogeneous(poses)
    poses[:, :3, 3] /= outputs.dataparser_scale
    to_scene = homogeneous(outputs.dataparser_transform.double())
    return torch.linalg.inv(to_scene) @ poses @ OPENCV_TO_OPENGL
