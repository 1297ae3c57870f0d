"""``aenerf export-cameras``: the images of a recording at the corrected poses, for other trainers."""

from __future__ import annotations

import shutil
from dataclasses import dataclass

from nerfstudio.utils.rich_utils import CONSOLE

from aenerf_ns.cli.export_arguments import ExportCamerasArguments
from aenerf_ns.cli.trained_run import open_run
from aenerf_ns.files.output_paths import cannot_be_created


@dataclass
class ExportCameras(ExportCamerasArguments):
    __doc__ = ExportCamerasArguments.__doc__

    def main(self) -> None:
        """Load the run and write cameras, points and images."""
        self.judge()
        # Imported lazily, because these imports take seconds.
        from aenerf_ns.export.camera_model_files import IMAGE_FOLDER
        from aenerf_ns.export.frames import write_cameras
        from aenerf_ns.export.placing import placed_views
        from aenerf_ns.export.rendering import points_seen

        _, run, _ = open_run(self.load_config, test_mode="inference")
        placed = placed_views(run)
        images = [image for image, _ in placed]
        points = points_seen(run, images, self.num_points)
        try:
            for image, file in placed:
                target = self.output / IMAGE_FOLDER / image.name
                target.parent.mkdir(parents=True, exist_ok=True)
                if self.copy:
                    shutil.copyfile(file, target)
                else:
                    target.symlink_to(file.resolve())
            write_cameras(self.output, images, points)
        except OSError as error:
            raise cannot_be_created(self.output, error) from None
        CONSOLE.print(
            f"{self.output}: {len(images)} images with cameras, {len(points.positions)} points. Train on them with:\n"
            f"  ns-train splatfacto --data {self.output} nerfstudio-data --load-3D-points True\n"
            f"  ns-train nerfacto --data {self.output} colmap --colmap-path sparse/0",
            highlight=False,
            soft_wrap=True,
        )
