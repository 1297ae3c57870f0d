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
from nerfstudio.utils.rich_utils import CONSOLE
from PIL import Image

from aenerf_ns.dataparsers.recording import (
    EventDataParser,
    EventDataParserConfig,
    FrameSequence,
    Recording,
    ReferenceView,
)
from aenerf_ns.dataparsers.text import parse_numbers, parse_seconds, read_rows
from aenerf_ns.dataparsers.tum_trajectory import read_tum_trajectory
from aenerf_ns.errors import DataError
from aenerf_ns.event_camera import EventCamera
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.events.stream import EventFile, EventStream
from aenerf_ns.trajectory.trajectory import Trajectory, homogeneous

_CHUNK_LINES = 1_000_000
# Longer than any line of events.txt.
_TAIL_BYTES = 4096


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
                line = [i for i, text in enumerate(block) if _is_row(text.encode("ascii", "replace"))][row]
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
        with self.path.open("rb") as file:
            first = next((line for line in file if _is_row(line)), b"")
            file.seek(0, 2)
            file.seek(max(file.tell() - _TAIL_BYTES, 0))
            last = next((line for line in reversed(file.read().splitlines()) if _is_row(line)), b"")
        if not first or not last:
            raise self.empty_error()
        start, end = (int(self._parse([line.decode("ascii", "replace")], 0).t[0]) for line in (first, last))
        return start, end


def _is_row(line: bytes) -> bool:
    """Whether a line is neither empty nor a comment."""
    return bool(line.split(b"#", 1)[0].strip())


def _is_pixel(values: np.ndarray, size: int) -> np.ndarray:
    return (values >= 0) & (values < size) & (values == np.floor(values))


@dataclass
class EcdDataParserConfig(EventDataParserConfig):
    """Event Camera Dataset (text files)."""

    _target: type = field(default_factory=lambda: EcdDataParser)
    auto_scale_poses: bool = False
    """Poses of this dataset are in metres, and slow recordings move little compared to the scene's distance."""
    positive_contrast_threshold: float = 0.5
    """C+: the dataset does not state it. It only sets the scale of the log-radiance, which colour correction finds."""
    negative_contrast_threshold: float = 0.5
    """C-: likewise; its ratio to C+ matters."""
    trajectory: Path | None = None
    """Estimated poses in the format of groundtruth.txt, to be used in its place. groundtruth.txt then only serves to
    evaluate them."""
    refractory_period_ns: int = 0
    """Time for which a pixel is blind after each event, in nanoseconds."""


class EcdDataParser(EventDataParser):
    """Reads a folder of the Event Camera Dataset. Its images alternate between the validation and the test split."""

    config: EcdDataParserConfig

    def read_recording(self) -> Recording:
        frames = self._read_all_but_poses()
        folder, given = Path(self.config.data), self.config.trajectory
        reference = read_tum_trajectory(folder / "groundtruth.txt")
        images = _views(frames, reference)
        return Recording(
            event_file=frames.event_file,
            event_camera=frames.event_camera,
            sensor=frames.sensor,
            trajectory=reference if given is None else read_tum_trajectory(given),
            ground_truth=None if given is None else reference,
            frame_camera=frames.frame_camera,
            reference_views={"train": images, "val": images[::2], "test": images[1::2]},
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
        times, files = _list_images(folder)
        camera = _read_calibration(folder / "calib.txt", _image_size(files[0] if files else None))
        return FrameSequence(
            event_file=EcdEventFile(folder / "events.txt", camera.width, camera.height),
            event_camera=camera,
            sensor=SensorModel(
                self.config.positive_contrast_threshold,
                self.config.negative_contrast_threshold,
                self.config.refractory_period_ns,
            ),
            frame_camera=camera,
            files=files,
            times=times,
            image_encoding="linear",
            recording=None,
        )


def _list_images(folder: Path) -> tuple[list[int], list[Path]]:
    """Times and files of the frames."""
    path = folder / "images.txt"
    if not path.exists():
        return [], []
    rows = read_rows(path, "t file")
    for _, name in rows:
        if not (folder / name).is_file():
            raise DataError(path, f"it names {name}, which does not exist", "copy the images too")
    return parse_seconds(path, [row[0] for row in rows]).tolist(), [folder / name for _, name in rows]


def _views(frames: FrameSequence, trajectory: Trajectory) -> list[ReferenceView]:
    """The frames that were taken within the span of the poses."""
    views = [
        ReferenceView(file, homogeneous(trajectory.interpolate(time)), time)
        for time, file in zip(frames.times, frames.files, strict=True)
        if trajectory.start <= time <= trajectory.end
    ]
    if len(views) < len(frames.files):
        CONSOLE.print(
            f"{len(frames.files) - len(views)} of {len(frames.files)} images are left out: they were taken outside "
            "the poses."
        )
    return views


def _image_size(image: Path | None) -> tuple[int, int]:
    """Size of the sensor: that of its frames, or of the DAVIS240C, which recorded the dataset."""
    if image is None:
        return 240, 180
    with Image.open(image) as picture:
        return picture.size


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
