"""``aenerf export-trajectory``: the poses of a trained run as a file, in the world of the recording."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from nerfstudio.utils.rich_utils import CONSOLE

from aenerf_ns.camera.trajectory import Trajectory
from aenerf_ns.cli.arguments import ExportTrajectoryArguments
from aenerf_ns.cli.trained_run import open_run
from aenerf_ns.errors import DataError
from aenerf_ns.files.output_paths import created
from aenerf_ns.files.tum_trajectory import write_tum_trajectory


@dataclass
class ExportTrajectory(ExportTrajectoryArguments):
    __doc__ = ExportTrajectoryArguments.__doc__

    def main(self) -> None:
        """Load the run and write its poses."""
        self.judge()
        # Imported lazily, because this import takes seconds.
        from aenerf_ns.export.times import regular_times

        _, run, _ = open_run(self.load_config, test_mode="inference")
        correction = run.model.camera_optimizer
        estimated = correction.trajectory
        trajectory = estimated
        if self.poses == "ground-truth":
            trajectory = run.scene.ground_truth
            if trajectory is None:
                raise DataError(run.data, "it has no true poses", "export corrected or estimated ones")
            trajectory = trajectory.to(run.device).crop(estimated.start, estimated.end)
        times = trajectory.times
        if self.rate is not None:
            times = regular_times(trajectory.start, trajectory.end, self.rate).to(times.device)
        source = correction if self.poses == "corrected" else trajectory
        with torch.no_grad():
            poses = source.pose(trajectory.seconds(times))
        written = Trajectory(times.cpu(), run.scene.to_recording(poses))
        with created(self.output, "--output"):
            write_tum_trajectory(self.output, written)
        CONSOLE.print(f"{self.output}: {len(written)} {self.poses} poses.")
