"""How the files of each format are laid out: what a folder is recognised by, and what can be read at a first look.

Nothing here imports torch or the framework, which take seconds. So commands can judge a folder before they do.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from aenerf_ns.errors import DataError, reading
from aenerf_ns.files.json_object import JsonObject
from aenerf_ns.files.open import SUFFIXES
from aenerf_ns.files.output_paths import require_dataset
from aenerf_ns.files.text import POSE_COLUMNS, TimeUnit, parse_numbers, parse_times, read_rows

CALIBRATIONS = ("calibration.json", "camchain.yaml")
"""Files of the cameras beside a recording of one's own."""
TUM_VIE_EVENTS = re.compile(r"(?P<sequence>.+)-events_(?P<side>left|right)\.h5")
"""Names of the event files of TUM-VIE."""
_TUM_VIE_PARTS = ("-events_left.h5", "-vi_gt_data")


@dataclass(frozen=True)
class Layout:
    """The files of a format.

    Attributes:
        summary: what the format is, for the help of commands.
        files: the files that the format is recognised by, as messages name them.
        recognises: tells whether a path looks like this format, from names of files alone.
        objects: names of JSON files in the folder.
        trajectories: names of trajectories in the folder, and the unit of their times.
    """

    summary: str
    files: str
    recognises: Callable[[Path], bool]
    objects: tuple[str, ...] = ()
    trajectories: tuple[tuple[str, TimeUnit], ...] = ()


def tum_vie_event_files(data: Path) -> list[Path]:
    """Return the event files of the sequences of TUM-VIE in a folder. A trained run is opened without its events, so
    any other part of a sequence suffices."""
    if TUM_VIE_EVENTS.fullmatch(data.name):
        return [data]
    names = {path.name.removesuffix(suffix) for suffix in _TUM_VIE_PARTS for path in data.glob(f"?*{suffix}")}
    return [data / f"{name}-events_left.h5" for name in sorted(names)]


def eventnerf_splits(data: Path) -> list[Path]:
    """Return the folders of EventNeRF's training splits."""
    return [data] if (data / "pose").is_dir() else sorted(path for path in data.glob("train*") if path.is_dir())


def paev3d_scenes(data: Path) -> list[Path]:
    """Return PAEv3D's folders of events. A trained run is opened without its events, so the file need not exist."""
    if data.parent.name == "H5_Files":
        return [data]
    return sorted(path for path in data.glob("H5_Files/*") if path.is_dir())


def _has_files(*names: str) -> Callable[[Path], bool]:
    return lambda data: all((data / name).is_file() for name in names)


def _is_enerf_esim(data: Path) -> bool:
    return any(data.glob("*poses_all*.txt")) and (data / "poses_bounds.npy").is_file() and (data / "events").is_dir()


def _is_eventnerf(data: Path) -> bool:
    return any((split / "pose").is_dir() and (split / "intrinsics").is_dir() for split in eventnerf_splits(data))


def _is_own_recording(data: Path) -> bool:
    return any((data / name).is_file() for name in CALIBRATIONS) and (
        (data / "trajectory.txt").is_file() or (data / "colmap").is_dir()
    )


# Where a folder has several formats, the first one here is taken.
LAYOUTS: dict[str, Layout] = {
    "aenerf-data": Layout(
        "aenerf-ns dataset folder.",
        "transforms.json with trajectory_estimated.txt",
        _has_files("transforms.json", "trajectory_estimated.txt"),
        ("transforms.json",),
        (("trajectory_estimated.txt", "s"), ("trajectory_ground_truth.txt", "s")),
    ),
    "ecd-data": Layout(
        "Event Camera Dataset (text files).",
        "events.txt with groundtruth.txt and calib.txt",
        _has_files("events.txt", "groundtruth.txt", "calib.txt"),
        trajectories=(("groundtruth.txt", "s"),),
    ),
    "robust-enerf-data": Layout(
        "Robust e-NeRF (raw_events.npz).",
        "raw_events.npz with camera_poses.npz and camera_calibration.npz",
        _has_files("raw_events.npz", "camera_poses.npz", "camera_calibration.npz"),
    ),
    "tum-vie-data": Layout(
        "TUM-VIE (raw download).",
        "SEQUENCE-events_left.h5 with SEQUENCE-vi_gt_data",
        lambda data: bool(tum_vie_event_files(data)),
        tuple(f"{kind}-calibration{which}.json" for kind in ("camera", "mocap-imu") for which in "AB"),
    ),
    "eds-data": Layout(
        "EDS (raw download).",
        "events.h5 with stamped_groundtruth.txt",
        _has_files("events.h5", "stamped_groundtruth.txt"),
        trajectories=(("stamped_groundtruth.txt", "s"),),
    ),
    "enerf-esim-data": Layout(
        "E-NeRF's ESIM scenes.", "events/*.npy with *poses_all*.txt and poses_bounds.npy", _is_enerf_esim
    ),
    "eventnerf-data": Layout("EventNeRF.", "train/events/*.npz with train/pose and train/intrinsics", _is_eventnerf),
    "paev3d-data": Layout(
        "PAEv3D.",
        "H5_Files/SCENE/event.h5 with Render_info/SCENE and Intrinsics",
        lambda data: bool(paev3d_scenes(data)),
    ),
    "event-recording-data": Layout(
        "A recording of your own.",
        f"events{{{','.join(SUFFIXES)}}} with {' or '.join(CALIBRATIONS)} and trajectory.txt or a COLMAP model in "
        "colmap",
        _is_own_recording,
        ("calibration.json",),
        (("trajectory.txt", "s"),),
    ),
}
"""By the names that the formats are registered with."""


def recognise(data: Path) -> str:
    """Return the name of the format that a folder has, judged by the names of its files.

    Raises:
        DataError: the folder does not exist, or has none of the formats.
    """
    with reading(data):
        for name, layout in LAYOUTS.items():
            if layout.recognises(data):
                return name
    require_dataset(data)
    known = "; ".join(f"{name}: {layout.files}" for name, layout in LAYOUTS.items())
    raise DataError(data, "no known format of recordings", f"looked for {known}")


def look_over(data: Path) -> None:
    """Recognise the format of a folder, and read its JSON files and trajectories without judging what they mean.

    Raises:
        DataError: the folder does not exist, has none of the formats, or has a file that is malformed.
    """
    name = recognise(data)
    try:
        for path, unit in _small_files(data, LAYOUTS[name]):
            if unit is None:
                JsonObject.read(path)
            else:
                rows = read_rows(path, POSE_COLUMNS)
                parse_times(path, [row[0] for row in rows], unit)
                parse_numbers(path, rows)
    except DataError as error:
        raise of_guessed_format(error, name) from None


def of_guessed_format(error: DataError, name: str) -> DataError:
    """Return an error in a dataset that also says that its format was guessed."""
    remark = f"the format {name} was guessed: where it is another, name it before --data"
    return DataError(error.source, error.problem, f"{error.remedy} ({remark})")


def _small_files(data: Path, layout: Layout) -> Iterator[tuple[Path, TimeUnit | None]]:
    with reading(data):
        for name in layout.objects:
            if (data / name).is_file():
                yield data / name, None
        for name, unit in layout.trajectories:
            if (data / name).is_file():
                yield data / name, unit
