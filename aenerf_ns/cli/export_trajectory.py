"""``aenerf export-trajectory``: the poses of a trained run as a file, in the world of the recording."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from nerfstudio.utils.rich_utils import CONSOLE

from aenerf_ns.camera.trajectory import Trajectory
from aenerf_ns.cli.operands import RunConfig
from aenerf_ns.cli.trained_run import open_run
from aenerf_ns.errors import DataError
from aenerf_ns.files.tum_trajectory import write_tum_trajectory


@dataclass
class ExportTrajectory:
    """Write the poses of a trained run in TUM format: t tx ty tz qx qy qz qw, in seconds, camera-to-world, OpenCV axes,
    in the world and the units of the recording."""

    load_config: RunConfig
    output: Path
    """Text file to write."""
    poses: Literal["corrected", "estimated", "ground-truth"] = "corrected"
    """corrected: after the run's pose correction. estimated: as given to the run. ground-truth: the true poses, within
    the run's time window."""
    rate: float | None = None
    """Poses a second; by default at the times of the given poses."""

    def main(self) -> None:
        """Load the run and write its poses."""
        if self.rate is not None and not 0 < self.rate <= 1e9:
            raise DataError("aenerf export-trajectory", f"a rate of {self.rate}", "give one above 0 and up to 1e9")
        _, pipeline, _ = open_run(self.load_config, test_mode="inference")
        correction = pipeline.model.camera_optimizer
        estimated = correction.trajectory
        trajectory = estimated
        if self.poses == "ground-truth":
            trajectory = pipeline.datamanager.train_dataset.scene.ground_truth
            if trajectory is None:
                raise DataError(
                    pipeline.datamanager.get_datapath(), "it has no true poses", "export corrected or estimated ones"
                )
            trajectory = trajectory.to(pipeline.device).between(estimated.start, estimated.end)
        times = trajectory.times
        if self.rate is not None:
            times = torch.arange(trajectory.start, trajectory.end + 1, round(1e9 / self.rate), device=times.device)
        source = correction if self.poses == "corrected" else trajectory
        with torch.no_grad():
            poses = source.pose(trajectory.seconds(times))
        written = Trajectory(times.cpu(), pipeline.in_recording(poses))
        self.output.parent.mkdir(parents=True, exist_ok=True)
        write_tum_trajectory(self.output, written)
        CONSOLE.print(f"{self.output}: {len(written)} {self.poses} poses.")
