"""Count how often ``aenerf check`` finds a problem in short windows of recordings, in right ones and in wrong ones.

    python -m benchmarks.check_windows --recordings data/room data/hand --output windows.json

Poses are the true ones. Windows are 0.1 to 1 s long (log-uniform) and drawn at random. Each mistake is made in the
whole recording, and a window is cut out of it afterwards.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.camera.rotation import quaternion_from_rotation, rotation_from_quaternion, rotation_from_vector
from aenerf_ns.camera.time_window import TimeWindow
from aenerf_ns.camera.trajectory import Trajectory, homogeneous
from aenerf_ns.checking.report import check
from aenerf_ns.cli.dataset import DatasetCommand
from aenerf_ns.errors import DataError
from aenerf_ns.events.stream import EventStream
from aenerf_ns.files.event_reader import EventFile
from aenerf_ns.progress import track
from aenerf_ns.recording.recording import Recording
from aenerf_ns.recording.time_units import require_one_unit
from benchmarks.runs import run_benchmark, write_result

Given = tuple[EventStream, Recording]


class _EventsInMemory(EventFile):
    def __init__(self, path: Path, events: EventStream) -> None:
        super().__init__(path, events.width, events.height)
        self._events = events

    def require(self) -> None:
        """Leave the file alone."""

    def read_chunks(self) -> Iterator[EventStream]:
        yield self._events


def _poses(change: Callable[[Tensor], Tensor]) -> Callable[..., Given]:
    return lambda events, recording: (events, replace(recording, trajectory=recording.trajectory.transform(change)))


def _camera(x: float, y: float, z: float, degrees: float = 0) -> Callable[..., Given]:
    """Multiply the axes of the camera, and turn it about its vertical axis."""
    matrix = torch.diag(torch.tensor([x, y, z, 1], dtype=torch.float64))
    matrix[:3, :3] @= rotation_from_vector(torch.tensor([0, np.radians(degrees), 0], dtype=torch.float64))
    return _poses(lambda poses: poses @ matrix)


def _read_with_w_first(poses: Tensor) -> Tensor:
    quaternion = quaternion_from_rotation(poses[:, :3, :3]).roll(1, -1)
    return homogeneous(torch.cat([rotation_from_quaternion(quaternion), poses[:, :3, 3:]], -1))


def _held(period: int, moving: int) -> Callable[[Tensor], Tensor]:
    """Repeat a pose until the period of so many poses is over, after so many that are right."""
    return lambda poses: poses[(k := torch.arange(len(poses))) - (k % period - moving).clamp(min=0)]


def _with_placeholders(poses: Tensor) -> Tensor:
    return torch.where((torch.arange(len(poses)) % 20 == 7)[:, None, None], torch.eye(4, dtype=torch.float64), poses)


def shift_clock(offset: float = 0, factor: int = 1) -> Callable[..., Given]:
    """Add seconds to the times of the poses, multiplied by a factor."""

    def change(events: EventStream, recording: Recording) -> Given:
        given = recording.trajectory
        return events, replace(
            recording, trajectory=Trajectory(given.times * factor + round(offset * 1e9), given.camera_to_worlds)
        )

    return change


def _events(columns_of: Callable[[EventStream], dict[str, Any]]) -> Callable[..., Given]:
    def change(events: EventStream, recording: Recording) -> Given:
        columns = columns_of(events)
        inside = (columns.get("x", events.x) < events.width) & (columns.get("y", events.y) < events.height)
        return replace(events[inside], **{name: column[inside] for name, column in columns.items()}), recording

    return change


def _lens(values_of: Callable[[CameraIntrinsics], dict[str, float]]) -> Callable[..., Given]:
    return lambda events, recording: (
        events,
        replace(recording, event_camera=replace(recording.event_camera, **values_of(recording.event_camera))),
    )


def _focal_lengths(factor: float) -> Callable[..., Given]:
    return _lens(lambda camera: {"fx": factor * camera.fx, "fy": factor * camera.fy})


MISTAKES: dict[str, Callable[..., Given]] = {
    "OpenGL camera axes": _camera(1, -1, -1),
    "camera axes x and y flipped": _camera(-1, -1, 1),
    "camera axes x and z flipped": _camera(-1, 1, -1),
    "world-to-camera": _poses(torch.linalg.inv),
    "quaternions with w first": _poses(_read_with_w_first),
    "mount left out, camera turned by 90 degrees": _camera(1, 1, 1, 90),
    "mount left out, camera turned by 20 degrees": _camera(1, 1, 1, 20),
    "poses of another path": _poses(lambda poses: poses.flip(0)),
    "placeholders among the poses": _poses(_with_placeholders),
    "tracking lost for half the time": _poses(_held(40, 20)),
    "each pose repeated 8 times": _poses(_held(8, 0)),
    "clock of the poses 0.2 s ahead": shift_clock(0.2),
    "clock of the poses 0.05 s behind": shift_clock(-0.05),
    "times of the poses in milliseconds": shift_clock(factor=1000),
    "times of the poses in microseconds": shift_clock(factor=1_000_000),
    "focal lengths x 1.5": _focal_lengths(1.5),
    "focal lengths / 1.5": _focal_lengths(1 / 1.5),
    "principal point of twice the resolution": _lens(lambda camera: {"cx": 2 * camera.cx, "cy": 2 * camera.cy}),
    "events binned by 2": _events(lambda events: {"x": events.x // 2, "y": events.y // 2}),
    "pixels mirrored in x": _events(lambda events: {"x": events.width - 1 - events.x}),
    "pixels mirrored in y": _events(lambda events: {"y": events.height - 1 - events.y}),
    "x and y swapped": _events(lambda events: {"x": events.y, "y": events.x}),
    "polarities all positive": _events(lambda events: {"p": np.abs(events.p)}),
    "polarities reversed": _events(lambda events: {"p": -events.p}),
    "times in whole milliseconds": _events(lambda events: {"t": events.t // 1_000_000 * 1_000_000}),
    "pixels in a random order": _events(
        lambda events: {name: np.random.default_rng(0).permutation(getattr(events, name)) for name in "xy"}
    ),
}


def find_problems(events: EventStream, recording: Recording, start: int, end: int) -> tuple[list[str], bool]:
    """Open and check a part of a recording, from ``start`` to ``end`` in nanoseconds.

    Returns:
        The problems, and whether there were enough events for the contrast to tell whether the poses are right.
    """
    events = events.between(start, end)
    if len(events) == 0:
        return ["it holds no events"], True
    try:
        trajectory = recording.trajectory.crop(start, end)
        file = _EventsInMemory(recording.event_file.path, events)
        require_one_unit(file, trajectory, "")
        window = TimeWindow(max(int(events.t[0]), trajectory.start), min(int(events.t[-1]), trajectory.end))
        result = check(replace(recording, trajectory=trajectory, event_file=file), recording.frames, window)
    except DataError as error:
        return [str(error)], True
    return result.problems, not any("too few events" in line or "not computed" in line for line in result.figures)


@dataclass
class CheckWindows:
    """Count false alarms and hits of the check."""

    recordings: tuple[Path, ...]
    """Datasets with true poses."""
    output: Path
    """JSON file to write after each recording."""
    right: int = 30
    """Right windows of each recording."""
    wrong: int = 1
    """Wrong windows of each recording, for each mistake."""

    def main(self) -> None:
        """Check the windows, and write what was found."""
        found: list[dict[str, Any]] = []
        kinds = {"right": (lambda *given: given, self.right)} | {name: (f, self.wrong) for name, f in MISTAKES.items()}
        for folder in track(self.recordings, "Recordings"):
            recording = DatasetCommand(folder).open_dataset().recording
            recording = replace(recording, trajectory=recording.ground_truth or recording.trajectory)
            events = EventStream.concatenate(list(recording.event_file.chunks()))
            rng = np.random.default_rng(0)
            for kind, (change, count) in kinds.items():
                wrong_events, wrong_recording = change(events, recording)
                for length in np.minimum(10 ** rng.uniform(8, 9, count), events.t[-1] - events.t[0]):
                    start = int(rng.integers(events.t[0], events.t[-1] - int(length) + 1))
                    problems, has_enough = find_problems(wrong_events, wrong_recording, start, start + int(length))
                    window = {"start": start, "seconds": length * 1e-9, "enough_events": has_enough}
                    found.append({"recording": folder.name, "kind": kind, **window, "problems": problems})
            write_result(self.output, {"table": table(found), "windows": found}, show=False)


def table(found: list[dict[str, Any]]) -> dict[str, dict[str, int]]:
    """Count windows, those with enough events, and those with problems, by the kind of mistake."""
    kinds = {one["kind"]: [other for other in found if other["kind"] == one["kind"]] for one in found}
    return {
        kind: {
            "windows": len(of),
            "enough events": sum(one["enough_events"] for one in of),
            "problems": sum(bool(one["problems"]) for one in of),
            "problems, enough events": sum(bool(one["problems"]) and one["enough_events"] for one in of),
        }
        for kind, of in kinds.items()
    }


if __name__ == "__main__":
    run_benchmark(CheckWindows)
