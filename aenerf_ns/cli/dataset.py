"""The dataset that a command reads, its format, and the command that trains on it."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, fields
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import tyro

from aenerf_ns.cli.console import say
from aenerf_ns.errors import DataError
from aenerf_ns.files.output_paths import require_dataset

if TYPE_CHECKING:
    from torch import Tensor

    from aenerf_ns.camera.time_window import TimeWindow
    from aenerf_ns.recording.dataparser import EventDataParser
    from aenerf_ns.recording.options import EventDataParserConfig
    from aenerf_ns.recording.output_lock import OutputLock
    from aenerf_ns.recording.recording import Recording, ReferenceView, Split
    from aenerf_ns.recording.writer import NativeDatasetWriter

    FormatName = str
else:
    # From the package's metadata, because the formats themselves take seconds to import.
    _POINTS = entry_points(group="nerfstudio.dataparser_configs")
    _NAMES = [point.name for point in _POINTS if point.value.startswith("aenerf_ns.") and point.name != "event-data"]
    FormatName = Literal[("auto", *_NAMES)]


@dataclass
class DatasetCommand:
    """A command that reads a dataset of any format."""

    data: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DATA")]
    """The dataset. --data DATA works too."""
    format: FormatName = field(default="auto", kw_only=True)
    """Format of the dataset. By default it is recognized from the names of the files."""
    format_options: Annotated[tuple[str, ...], tyro.conf.arg(metavar="KEY=VALUE ...")] = field(default=(), kw_only=True)
    """Options of the format (docs/options.md), such as width=346 height=260."""
    drop_malformed: bool = field(default=False, kw_only=True)
    """Leave out events outside the sensor or out of order, as long as they are at most a thousandth, and the piece in
    which an interrupted file ends. Say how many and where."""

    placing_options: ClassVar[tuple[str, ...]] = ()
    """Options of all formats that the command takes, too: they place the recording in a scene, or cut it."""

    def __post_init__(self) -> None:
        if self.drop_malformed:
            # The command for training that is printed then has the option, too.
            self.format_options += ("drop-malformed=True",)

    def open_dataset(self) -> EventDataParser:
        """Make the parser of the dataset, which reads nothing yet.

        Raises:
            DataError: there is no such dataset, its format is not recognized or lacks an option, or a value is wrong.
        """
        require_dataset(self.data)
        from aenerf_ns.dataparsers.formats import FORMATS, recognize

        guessed = recognize(self.data) if self.format == "auto" else None
        name = guessed or self.format
        config = _with_options(FORMATS[name], name, self.format_options, self.placing_options)
        config.data = self.data
        parser = config.setup()
        parser.guessed_format = guessed
        return parser


def _with_options(
    config: EventDataParserConfig, name: str, options: Sequence[str], placing: Sequence[str]
) -> EventDataParserConfig:
    """Copy the configuration of a format, with options set by ``key=value``."""
    from aenerf_ns.recording.options import EventDataParserConfig

    # Most commands keep the world of the recording, so options that place it in a scene have no effect. The longest
    # gap between poses and malformed events belong to the recording.
    without_effect = {option.name for option in fields(EventDataParserConfig)}
    without_effect -= {"max_pose_gap_ns", "drop_malformed", *placing}
    known = [option.name for option in fields(config) if option.name not in without_effect]
    config = copy(config)
    for option in options:
        key, equals, value = option.partition("=")
        if not equals or key.replace("-", "_") not in known:
            remedy = f"write KEY=VALUE with one of {', '.join(known)}"
            raise DataError(f"--format-options {option}", f"not an option of {name}", remedy)
        # As ns-train parses it.
        words, markers = [f"--{key}={value}"], (tyro.conf.FlagConversionOff,)
        try:
            config = tyro.cli(type(config), default=config, args=words, config=markers, console_outputs=False)
        except SystemExit:
            remedy = f"see {name} in docs/options.md for what {key} may be"
            raise DataError(f"--format-options {option}", f"{value!r} is not a value of {key}", remedy) from None
    return config


def open_writer(
    lock: OutputLock, parser: EventDataParser, recording: Recording, has_metric_poses: bool = True
) -> NativeDatasetWriter:
    """Open a dataset folder for what a command makes of a recording, in the world of the recording.

    Poses without metric scale are scaled in training, whatever the format of the recording does.
    """
    from aenerf_ns.recording.writer import NativeDatasetWriter

    return NativeDatasetWriter(
        lock,
        recording.event_camera,
        recording.sensor,
        recording.image_encoding,
        scene_box=recording.scene_box,
        max_pose_gap=recording.max_pose_gap,
        frame_camera=recording.frame_camera,
        frame_from_event=recording.frame_from_event,
        # Near and far planes keep their units.
        auto_scale_poses=parser.scales_poses(recording) or not has_metric_poses,
        has_estimated_intrinsics=recording.intrinsics_origin == "estimated",
        has_assumed_thresholds=recording.has_assumed_thresholds,
    )


def views_to_copy(recording: Recording, window: TimeWindow) -> dict[Split, list[ReferenceView]]:
    """Choose the views in a time window that a command copies: where a format uses only some, those that training uses.

    Frames outside the events may serve COLMAP, but none of them may take the place of one that training evaluates on.
    """
    from aenerf_ns.camera.time_window import TimeWindow
    from aenerf_ns.recording.views import thin_views

    if recording.max_views is not None:
        first, last = recording.event_file.time_span()
        gaps = recording.trajectory.known_time(recording.max_pose_gap).gaps
        window = TimeWindow(max(first, window.start), min(last, window.end), gaps)
    chosen: dict[Split, list[ReferenceView]] = {}
    for split, views in recording.reference_views.items():
        within = [view for view in views if view.time is None or window.contains(view.time)]
        chosen[split] = within if split == "train" else thin_views(within, recording.max_views)
    return chosen


def copy_images(writer: NativeDatasetWriter, recording: Recording, views: Mapping[Split, list[ReferenceView]]) -> None:
    """Copy the images of views of a recording to a dataset folder.

    Raises:
        DataError: an image cannot be read, or is of another size than the camera.
    """
    from aenerf_ns.recording.images import check_image

    for file in {view.file for split in views.values() for view in split}:
        check_image(file, recording.frame_camera)
    for split, kept in views.items():
        for view in kept:
            writer.add_image_file(split, view.file, view.camera_to_world, view.time, recording.image_background)


def training_command(
    data: Path, method: str = "aenerf", options: Mapping[str, object] | None = None, format_words: Sequence[str] = ()
) -> str:
    """Write the command that trains on a dataset, with options of the method and words of the dataset's format."""
    words = ["ns-train", method]
    for name, value in (options or {}).items():
        words += [f"--{name}", str(value)]
    # After the format's words the framework would not name the run by its data.
    return shlex.join([*words, "--data", str(data), *format_words])


def say_scene_box(box: Tensor | None) -> None:
    """Say that a dataset gets the box that its camera was found to go around, if there is one."""
    if box is not None:
        say(
            "The camera goes around what it sees, so the dataset gets a scene box, "
            f"{box.round(decimals=3).tolist()}. Where more is to be seen, delete scene_box from transforms.json."
        )
