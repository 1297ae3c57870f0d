"""Compose the README's picture: events, two runs' renderings and the truth, for some test views of a simulated dataset.

    aenerf simulate --scene scenes/forklift/scene.json --speed hard --width 160 --height 120 --pose-noise-degrees 1.5 \\
        --pose-noise-translation 0.04 --validation-views 20 --test-views 20 --output forklift
    ns-train aenerf-small --machine.device-type cpu --max-num-iterations 1500 --data forklift
    ns-eval --load-config .../config.yml --output-path corrected.json --render-output-path corrected
    (the same with --pipeline.model.camera-optimizer.mode off, as uncorrected)
    python -m benchmarks.readme_picture --data forklift --uncorrected uncorrected --corrected corrected \\
        --views 3 18 --output docs/images/pose_correction.png

Prints the PSNR of each rendering shown.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from aenerf_ns.events.picture import polarity_picture
from aenerf_ns.files.open import open_event_file
from aenerf_ns.files.tum_trajectory import read_tum_trajectory
from benchmarks.runs import run_benchmark

_SCALE = 2
_GAP = 4
_HEADER = 26
_TITLES = ("events", "without pose correction", "with pose correction", "truth")


@dataclass
class ReadmePicture:
    """Compose the README's picture."""

    data: Path
    """Dataset folder that aenerf simulate wrote."""
    uncorrected: Path
    """Folder that ns-eval --render-output-path wrote for the run without pose correction."""
    corrected: Path
    """The same for the run with pose correction."""
    output: Path
    """Picture to write."""
    views: tuple[int, ...] = (0, 1)
    """Numbers of the test views, one row each."""
    num_events: int = 6000
    """Events of a picture: the ones nearest in time to when the camera was nearest to the view."""

    def main(self) -> None:
        """Write the picture."""
        rows = [self._row(view) for view in self.views]
        height, width = rows[0][0].shape[:2]
        across, down = width * _SCALE + _GAP, height * _SCALE + _GAP
        sheet = Image.new("RGB", (across * len(_TITLES) - _GAP, _HEADER + down * len(rows) - _GAP), "white")
        draw = ImageDraw.Draw(sheet)
        font = ImageFont.load_default(size=17)
        for column, title in enumerate(_TITLES):
            draw.text((column * across + across // 2, _HEADER // 2), title, "black", font, anchor="mm")
        for row, panels in enumerate(rows):
            for column, panel in enumerate(panels):
                picture = Image.fromarray(panel).resize((width * _SCALE, height * _SCALE), Image.Resampling.LANCZOS)
                sheet.paste(picture, (column * across, _HEADER + row * down))
        sheet.save(self.output, optimize=True)

    def _row(self, view: int) -> list[NDArray[np.uint8]]:
        """Return the (H, W, 3) panels of a test view."""
        # ns-eval puts the truth to the left of the rendering.
        pictures = [
            np.asarray(Image.open(sorted(folder.glob("eval_img_*.png"))[view]).convert("RGB"))
            for folder in (self.uncorrected, self.corrected)
        ]
        width = pictures[0].shape[1] // 2
        truth = pictures[0][:, :width]
        renderings = [picture[:, width:] for picture in pictures]
        psnr = [-10 * np.log10(np.mean((truth / 255.0 - picture / 255.0) ** 2)) for picture in renderings]
        print(f"view {view}: {psnr[0]:.1f} and {psnr[1]:.1f} dB")
        return [self._events(self._nearest(view), width, truth.shape[0]), *renderings, truth]

    def _nearest(self, view: int) -> int:
        """Return when the camera was nearest to a test view, in nanoseconds."""
        transforms = json.loads((self.data / "transforms.json").read_text(encoding="utf-8"))
        name = transforms["test_filenames"][view]
        frame = next(frame for frame in transforms["frames"] if frame["file_path"] == name)
        position = np.array(frame["transform_matrix"])[:3, 3]
        path = read_tum_trajectory(self.data / "trajectory_ground_truth.txt")
        distances = np.linalg.norm(path.camera_to_worlds[:, :, 3].numpy() - position, axis=1)
        return int(path.times[distances.argmin()])

    def _events(self, time: int, width: int, height: int) -> NDArray[np.uint8]:
        """Return the picture of the events around a time in nanoseconds."""
        chunks = open_event_file(self.data / "events.h5", width, height).read_chunks()
        columns = [(chunk.x, chunk.y, chunk.t, chunk.p) for chunk in chunks]
        x, y, t, p = (np.concatenate(column) for column in zip(*columns, strict=True))
        near = np.argsort(np.abs(t - time), kind="stable")[: self.num_events]
        return polarity_picture(x[near], y[near], p[near], width, height)


if __name__ == "__main__":
    run_benchmark(ReadmePicture)
