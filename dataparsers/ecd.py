"""The text format of the Event Camera Dataset (Mueggler et al. 2017), which many DAVIS recordings use.

``events.txt`` (t x y p, polarity 0 or 1), ``images.txt`` (t file), ``groundtruth.txt`` (t px py pz qx qy qz qw,
camera-to-world, OpenCV axes) and ``calib.txt`` (fx fy cx cy k1 k2 p1 p2 k3).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path

import numpy as np
from nerfstudio.plugins.registry_dataparser import DataParserSpecification

from aenerf_ns.dataparsers.recording import (
    EventDataParser,
    FrameSequence,
    PublishedDataParserConfig,
    Recording,
    image_size_and_mode,
)
from aenerf_ns.dataparsers.text import first_and_last_row, is_row, parse_numbers, read_rows
from aenerf_ns.dataparsers.tum_trajectory import read_tum_trajectory
from aenerf_ns.dataparsers.views import read_image_list, views_on_trajectory
from aenerf_ns.errors import DataError
from aenerf_ns.event_camera import EventCamera
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.events.stream import EventFile, EventStream

_CHUNK_LINES = 1_000_000


class EcdEventFile(EventFile):
    """events.txt: t[s] x y p, with polarity 0 or 1."""

    def read_chunks(self) -> Iterator[EventStream]:
        with self.path.open(encoding="ascii", errors="replace") as file:
            lines = 0
            while block := list(islice(file, _CHUNK_LINES)):
                yield self._parse(block, lines)
                lines += len(block)

    def _parse(self, block: list[str], lines_before: int) -> EventStream:
        try:
            table = np.loadtxt(block, dtype=np.float64, ndmin=2)
        except ValueError as error:
            raise DataError(
                self.path, f"after line {lines_before}: {error}", "each line must hold the four numbers t x y p"
            ) from None
        if table.size == 0:
            table = table.reshape(0, 4)
        if table.shape[1] != 4:
            raise DataError(
                self.path, f"its lines have {table.shape[1]} fields", "each line must hold the four numbers t x y p"
            )
        checks = (
            ("time", 0, np.isfinite(table[:, 0]) & (np.abs(table[:, 0]) < 9e9), "times are in seconds"),
            ("x", 1, _is_pixel(table[:, 1], self.width), f"pixel columns are whole numbers below {self.width}"),
            ("y", 2, _is_pixel(table[:, 2], self.height), f"pixel rows are whole numbers below {self.height}"),
            ("polarity", 3, (table[:, 3] == 0) | (table[:, 3] == 1), "polarities are 0 or 1 in this format"),
        )
        for name, column, good, remedy in checks:
            if not good.all():
                row = int(np.argmin(good))
                line = [i for i, text in enumerate(block) if is_row(text.encode("ascii", "replace"))][row]
                raise DataError(self.path, f"line {lines_before + line + 1} has {name} {table[row, column]:g}", remedy)
        return EventStream(
            table[:, 1].astype(np.uint16),
            table[:, 2].astype(np.uint16),
            np.rint(table[:, 0] * 1e9).astype(np.int64),
            (2 * table[:, 3] - 1).astype(np.int8),
            self.width,
            self.height,
            self.path,
        )

    def time_span(self) -> tuple[int, int]:
        self.require()
        first, last = first_and_last_row(self.path)
        if not first or not last:
            raise self.empty_error()
        start, end = (int(self._parse([line], 0).t[0]) for line in (first, last))
        return start, end


def _is_pixel(values: np.ndarray, size: int) -> np.ndarray:
    return (values >= 0) & (values < size) & (values == np.floor(values))


@dataclass
class EcdDataParserConfig(PublishedDataParserConfig):
    """Event Camera Dataset (text files)."""

    _target: type = field(default_factory=lambda: EcdDataParser)


class EcdDataParser(EventDataParser):
    """Reads a folder of the Event Camera Dataset. Its images alternate between the validation and the test split."""

    config: EcdDataParserConfig
    layout = "events.txt with groundtruth.txt and calib.txt"

    @classmethod
    def recognises(cls, data: Path) -> bool:
        return all((data / name).is_file() for name in ("events.txt", "groundtruth.txt", "calib.txt"))

    def read_recording(self) -> Recording:
        frames = self._read_all_but_poses()
        reference = read_tum_trajectory(Path(self.config.data) / "groundtruth.txt")
        trajectory, ground_truth = self.config.estimated(reference)
        images = list(zip(frames.times, frames.files, strict=True))
        return Recording(
            event_file=frames.event_file,
            event_camera=frames.event_camera,
            sensor=frames.sensor,
            trajectory=trajectory,
            ground_truth=ground_truth,
            frame_camera=frames.frame_camera,
            reference_views=views_on_trajectory(images, reference),
            image_encoding=frames.image_encoding,
        )

    def read_frames(self) -> FrameSequence:
        frames = self._read_all_but_poses()
        has_poses = (Path(self.config.data) / "groundtruth.txt").exists()
        return replace(frames, recording=self.recording if has_poses else None)

    def _read_all_but_poses(self) -> FrameSequence:
        folder = Path(self.config.data)
        if not folder.is_dir():
            raise DataError(folder, "there is no such folder", "give the folder that holds events.txt as --data")
        images = read_image_list(folder / "images.txt") if (folder / "images.txt").exists() else []
        camera = _read_calibration(folder / "calib.txt", _image_size(images[0][1] if images else None))
        return FrameSequence(
            event_file=EcdEventFile(folder / "events.txt", camera.width, camera.height),
            event_camera=camera,
            sensor=self.config.sensor(SensorModel(0.5, 0.5)),
            frame_camera=camera,
            files=[file for _, file in images],
            times=[time for time, _ in images],
            image_encoding="linear",
            recording=None,
        )


def _image_size(image: Path | None) -> tuple[int, int]:
    """Size of the sensor: that of its frames, or of the DAVIS240C, which recorded the dataset."""
    if image is None:
        return 240, 180
    return image_size_and_mode(image)[0]


def _read_calibration(path: Path, size: tuple[int, int]) -> EventCamera:
    rows = read_rows(path, "fx fy cx cy k1 k2 p1 p2 k3")
    if not rows:
        raise DataError(path, "the file is empty", "it must hold fx fy cx cy k1 k2 p1 p2 k3")
    fx, fy, cx, cy, *distortion = parse_numbers(path, rows)[0].tolist()
    try:
        # OpenCV's principal point counts from the centre of the first pixel.
        return EventCamera(*size, fx, fy, cx + 0.5, cy + 0.5, "radial_tangential", tuple(distortion))
    except ValueError as error:
        raise DataError(path, str(error), "it must hold fx fy cx cy k1 k2 p1 p2 k3") from None


ecd_dataparser = DataParserSpecification(
    config=EcdDataParserConfig(), description="Event Camera Dataset text files: events, images, ground truth, calib"
)
