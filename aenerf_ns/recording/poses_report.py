"""The report in a dataset folder on how its poses were estimated or refined."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import msgspec
from PIL import Image

from aenerf_ns.camera.trajectory import Trajectory
from aenerf_ns.files.json_file import read_json
from aenerf_ns.recording.images import read_image

POSES_REPORT, POSES_PICTURE = "poses_report.json", "poses_report.png"


class _File(msgspec.Struct):
    """The one field of the report that is read. Reports of earlier versions lack it."""

    summary: str | None = None


@dataclass(frozen=True)
class PosesReport:
    """How poses were estimated or refined: in one line, and as a picture where one was drawn."""

    summary: str
    picture: Image.Image | None


def poses_report_files(trajectory: Trajectory) -> list[Path]:
    """Return the files of the report beside poses that ``aenerf convert`` found; none for other poses."""
    path = Path(trajectory.source)
    if path.name != "trajectory_estimated.txt":
        return []
    return [file for name in (POSES_REPORT, POSES_PICTURE) if (file := path.with_name(name)).is_file()]


def read_poses_report(trajectory: Trajectory) -> PosesReport | None:
    """Read the report beside poses that ``aenerf convert`` found; None for other poses, and where there is no report.

    Raises:
        DataError: the report or its picture cannot be read.
    """
    files = {file.name: file for file in poses_report_files(trajectory)}
    summary = read_json(files[POSES_REPORT], _File).summary if POSES_REPORT in files else None
    if summary is None:
        return None
    picture = read_image(files[POSES_PICTURE]).convert("RGB") if POSES_PICTURE in files else None
    return PosesReport(" ".join(summary.split()), picture)
