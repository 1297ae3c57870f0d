"""The arguments of each ``aenerf`` command, and what can be judged of them before anything slow is imported.

Nothing here imports torch or the framework, which take seconds. The classes of the commands add the work to these.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from aenerf_ns.cli.operands import Dataset, RunConfig
from aenerf_ns.errors import DataError, reading
from aenerf_ns.events.sensor import BayerPattern, SensorModel, require_event_sensor_size
from aenerf_ns.files.limits import require_file
from aenerf_ns.files.output_paths import require_new, require_writable
from aenerf_ns.files.text import MAX_ROWS
from aenerf_ns.method.color_protocol import ColorCorrectionProtocol
from aenerf_ns.reconstruction.batches import EVENTS_PER_PIXEL
from aenerf_ns.reconstruction.weights import require_weights
from aenerf_ns.simulator.options import BUILT_IN, DURATIONS, Interpolation, SensorNoise, require_scene_file

if TYPE_CHECKING:
    from aenerf_ns.events.filters import EventFilters

_SIMULATE = "aenerf simulate"
# Wider than anybody needs. Beyond them a simulation would run for days, or fill the memory.
_RANGES = {
    "width": (1, 1 << 14),
    "height": (1, 1 << 14),
    "duration": DURATIONS,
    "pose_rate": (1e-3, 1e6),
    "frame_rate": (1e-3, 1e6),
    "exposure": (1e-9, 1e3),
    "max_displacement": (1e-2, 1e2),
    "pose_noise_degrees": (0, 180),
    "pose_noise_translation": (0, 1e6),
    "pose_noise_correlation_time": (1e-6, 1e6),
    "train_images": (0, 100_000),
    "validation_views": (0, 100_000),
    "test_views": (0, 100_000),
    "contrast_threshold_spread": (0, 10),
    "leak_rate": (0, 1e6),
    "shot_noise_rate": (0, 1e6),
}
_MOST_EVENTS_PER_PIXEL = 1e6
_MOST_TOLD = 10**300
_FOR_SCENES = ("scene", "speed", "width", "height", "duration", "pose_rate", "exposure")
_FOR_VIDEOS = ("interpolation", "trajectory", "intrinsics", "calibration", "event_camera")

# Takes exactly four words. As an optional tuple, the option would also take the dataset if it follows.
Region = Annotated[
    tuple[int, int, int, int] | None,
    tyro.constructors.PrimitiveConstructorSpec(
        nargs=4,
        metavar="X Y WIDTH HEIGHT",
        instance_from_str=lambda words: tuple(int(word) for word in words),
        is_instance=lambda value: value is None or isinstance(value, tuple),
        str_from_instance=lambda value: [str(value)],
    ),
]

# Endings of the names of images, by which their formats are known.
_PICTURES = (".png", ".jpg", ".jpeg")


def _require_seed(seed: int, source: str) -> None:
    if not 0 <= seed < 2**63:
        raise DataError(source, f"--seed {seed}", "give a whole number from 0 on")


def told(value: float) -> str:
    """Return a number for a message. Formats turn whole numbers into float64, which cannot hold all of them."""
    return str(value) if isinstance(value, int) and abs(value) > _MOST_TOLD else f"{value:g}"


def require_rate(command: str, rate: float) -> None:
    """Raise a DataError for a rate a second that no run can have."""
    if not 0 < rate <= 1e9:
        raise DataError(command, f"a rate of {rate}", "give one above 0 and up to 1e9")


@dataclass
class Automatic:
    """Recognise the format from the files of the dataset."""


@dataclass
class Named:
    """A format that is named, without its options."""


FORMAT_NAMES = tuple(
    point.name
    for point in entry_points(group="nerfstudio.dataparser_configs")
    if point.value.startswith("aenerf_ns.") and point.name != "event-data"
)

if TYPE_CHECKING:
    FormatName = Any
else:
    # With the names of the formats only, because their options come with the framework.
    FormatName = tyro.conf.OmitArgPrefixes[
        tyro.extras.subcommand_type_from_defaults(
            {"auto": Automatic(), **{name: Named() for name in FORMAT_NAMES}},
            descriptions={"auto": "recognize the format from the files of the dataset"},
            prefix_names=False,
        )
    ]


@dataclass
class CheckArguments:
    """Look a dataset over: its events, its poses, and whether the two fit each other. Exit status 0 if all is well, 1
    if there are problems, 2 if the dataset cannot be read. Options of a format come after its name; by default the
    format is recognised."""

    data: Dataset
    picture: Path | None = None
    """PNG file to write: events as they came, and warped to one view by the poses."""
    format: FormatName = field(default_factory=Automatic)

    def judge(self) -> None:
        """Raise a DataError if the picture cannot have its name."""
        if self.picture is not None:
            if self.picture.suffix.lower() not in _PICTURES:
                raise DataError(self.picture, "its name is not that of a picture", "end the --picture with .png")
            require_writable(self.picture, "--picture")


@dataclass
class ConvertArguments:
    """Write a dataset of any format as a dataset folder of aenerf-ns, with some of the events left out where asked.
    The events are read and written piece by piece, and the folder appears when it is complete. Options of a format come
    after its name; by default the format is recognised."""

    data: Dataset
    output: Path
    """Dataset folder to create."""
    poses: Literal["given", "colmap"] = "given"
    """given: take the dataset's poses. colmap: have COLMAP estimate poses from the recording's frames, without metric
    scale. The given poses are then kept as ground truth, to compare with."""
    start_time_ns: int | None = None
    """Leave out events and images before this time on the clock of the events, in nanoseconds."""
    end_time_ns: int | None = None
    """Leave out events and images after this time on the clock of the events, in nanoseconds."""
    region: Region = None
    """Keep only this part of the sensor, in pixels."""
    drop_hot_pixels: bool = False
    """Leave out pixels that fire by themselves. Reads the events twice."""
    shortest_interval_ns: int = 0
    """Leave out events that follow the last kept event of their pixel by less than this, in nanoseconds. Meant for
    pixels that fire repeatedly for one change of light. Leaving out any other event loses a change of light of one
    contrast threshold."""
    pixel_share: float = 1.0
    """Keep the events of this share of the pixels, chosen at random, to train on fewer events."""
    seed: int = 0
    """Seed of the choice of pixels, and of COLMAP."""
    format: FormatName = field(default_factory=Automatic)

    def judge(self) -> None:
        """Raise a DataError if the output is in the way or a filter is impossible."""
        require_new(self.output)
        _require_seed(self.seed, "aenerf convert")
        self.filters()

    def filters(self) -> EventFilters:
        """Return the filters of the events.

        Raises:
            DataError: a value is out of range.
        """
        from aenerf_ns.events.filters import EventFilters

        try:
            return EventFilters(
                start=self.start_time_ns,
                end=self.end_time_ns,
                region=self.region,
                hot_pixels=self.drop_hot_pixels,
                pixel_share=self.pixel_share,
                shortest_interval=self.shortest_interval_ns,
                seed=self.seed,
            )
        except ValueError as error:
            raise DataError("aenerf convert", str(error), "see aenerf convert --help") from None


@dataclass
class ReconstructArguments:
    """Make images of a recording's events, and write a dataset folder with these images as training images, at the
    interpolated poses of their times. The events and the other images are those of the recording. reconstruction.mp4
    in the folder shows the images one after another. Options of a format come after its name; by default the format is
    recognised."""

    data: Dataset
    output: Path
    """Dataset folder to create."""
    method: Literal["high-pass", "firenet", "e2vid"] = "high-pass"
    """high-pass: the asynchronous high-pass filter of Scheerlinck et al. (2018), which needs no weights. firenet and
    e2vid: the networks of Scheerlinck et al. (2020) and Rebecq et al. (2021), whose weights you have."""
    weights: Path | None = None
    """Weights file of the network, as its authors distribute it."""
    events_per_pixel: float = EVENTS_PER_PIXEL
    """Events between two images, as a share of the sensor's pixels."""
    format: FormatName = field(default_factory=Automatic)

    def judge(self) -> None:
        """Raise a DataError if the output is in the way, a number is impossible, or weights do not fit the method."""
        require_new(self.output)
        if not 0 < self.events_per_pixel <= _MOST_EVENTS_PER_PIXEL:
            remedy = f"give an --events-per-pixel above 0 and up to {_MOST_EVENTS_PER_PIXEL:g}"
            raise DataError("aenerf reconstruct", f"{self.events_per_pixel} events a pixel", remedy)
        if self.method == "high-pass":
            if self.weights is not None:
                raise DataError(self.weights, "the high-pass filter has no weights", "leave out --weights")
        else:
            require_weights(self.method, self.weights)


@dataclass
class EvaluateArguments:
    """Compare a trained run's renderings with the test views, as ns-eval does and in the same JSON layout, optionally
    under another protocol than the run's. Nothing in the run's folder changes."""

    load_config: RunConfig
    output: Path
    """JSON file to write."""
    color_correction: ColorCorrectionProtocol | None = None
    """Fit this colour correction on the run's data and use it; by default the correction stored with the run."""
    render_output: Path | None = None
    """Folder for pictures, from the test poses as placed: truth beside reconstruction, accumulation, depth."""
    nerfbaselines: Path | None = None
    """Folder to create in the layout of nerfbaselines: results.json, and the predictions that `nerfbaselines evaluate`
    reads, from the test poses as placed."""

    def judge(self) -> None:
        """Raise a DataError if an output cannot be written, or the folder for nerfbaselines is in the way."""
        require_writable(self.output, "--output")
        if self.render_output is not None:
            require_writable(self.render_output / "0000.png", "--render-output")
        if self.nerfbaselines is not None:
            require_new(self.nerfbaselines, "--nerfbaselines")


@dataclass
class ExportTrajectoryArguments:
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

    def judge(self) -> None:
        """Raise a DataError if the output cannot be written, or the rate is impossible."""
        if self.rate is not None:
            require_rate("aenerf export-trajectory", self.rate)
        require_writable(self.output, "--output")


@dataclass
class SimulateArguments:
    """Simulate an event camera that moves through a scene, or that stands in for the camera of a video, and write a
    dataset for ns-train aenerf."""

    output: Path
    """Dataset folder to create."""
    scene: str = "room"
    """room: a furnished room seen from inside. object: a toy locomotive seen from around it. shiny_object: the
    same, varnished and polished. A .glb, .obj or .ply file: a mesh seen from around it. A .json file: a mesh, its light
    and the camera's path (docs/simulator.md)."""
    video: Path | None = None
    """A video in place of a scene: a file, or a folder of images with the list images.txt of their times (on each line:
    t[s] file). Without --trajectory and without --poses colmap, only events and images are written."""
    interpolation: Interpolation = "flow"
    """How the log-radiance changes between two frames of the video. flow: it moves along optical flow. linear: each
    pixel changes linearly in time. linear is faster, but wrong where the picture moves by pixels between frames."""
    trajectory: Path | None = None
    """Poses of the video's camera, as t tx ty tz qx qy qz qw in seconds on the clock of the video, camera-to-world,
    OpenCV camera axes. Needs the camera's intrinsics."""
    intrinsics: tuple[float, float, float, float] | None = None
    """Intrinsics of the video's camera without distortion: fl_x fl_y cx cy in pixels. cx and cy count from the edge of
    the image."""
    calibration: Path | None = None
    """The video's camera: calibration.json, or the camchain.yaml that Kalibr writes. Without this option and without
    --intrinsics, --poses colmap estimates the lens."""
    event_camera: str | None = None
    """Name of the video's camera in a camchain of several cameras, such as cam1."""
    speed: Literal["easy", "hard"] = "easy"
    """easy: constant speed. hard: the same path at 8^sin(2 pi t) times that speed."""
    width: int = 346
    """Pixel columns of the sensor."""
    height: int = 260
    """Pixel rows of the sensor."""
    duration: float | None = None
    """Seconds that the path takes at constant speed. Default: the duration in scene.json, or 4."""
    pose_rate: float = 250.0
    """Poses a second in the trajectories; with --poses colmap, in the true trajectory."""
    poses: Literal["noise", "colmap"] = "noise"
    """Source of the estimated poses. noise: the true poses, or those of --trajectory, with noise. colmap: COLMAP
    estimates a pose for each frame of a camera at the event sensor's place, as in a DAVIS, or for each frame of the
    video, and may lose or misplace frames."""
    frame_rate: float | None = None
    """Frames a second for COLMAP, 25 by default. With --video: the rate at which the camera took the frames, in place
    of the times that the video states, as for slow motion."""
    exposure: float = 0.003
    """Seconds for which a frame is exposed. Motion blurs the frame meanwhile."""
    pose_noise_degrees: float = 0.0
    """Error of the estimated rotations: root mean square of its angle, in degrees."""
    pose_noise_translation: float = 0.0
    """Error of the estimated positions: root mean square of its length, in scene units (metres)."""
    pose_noise_correlation_time: float = 0.25
    """Correlation time of the pose errors in seconds."""
    positive_contrast_threshold: float = 0.25
    """C+: rise of log-radiance that triggers an event."""
    negative_contrast_threshold: float = 0.25
    """C-: fall of log-radiance that triggers an event."""
    refractory_period_ns: int = 0
    """Time for which a pixel is blind after each event, in nanoseconds."""
    noise: tyro.conf.OmitArgPrefixes[SensorNoise] = field(default_factory=SensorNoise)
    bayer_pattern: BayerPattern = ""
    """RGGB for a colour sensor."""
    max_displacement: float = 0.5
    """Pixels that 99 % of the picture may move between two rendered frames, or between two frames along the flow."""
    train_images: int = 50
    """Reference images along the trajectory. They are not used for training."""
    validation_views: int = 20
    """Reference views around the trajectory, or frames of the video, for colour correction."""
    test_views: int = 20
    """Reference views from other places, or other frames of the video, for evaluation."""
    seed: int = 0
    """Seed of everything random: the scene, the sensor, the pose noise and the test views."""

    def judge(self) -> None:
        """Raise a DataError if the output is in the way, a file is missing, or options are impossible together."""
        require_new(self.output)
        self._refuse_options_without_effect()
        self.sensor()
        if self.video is None:
            if self.scene not in BUILT_IN:
                require_scene_file(Path(self.scene))
        else:
            self._judge_video(self.video)
        self._judge_numbers()
        noise = (self.pose_noise_degrees, self.pose_noise_translation)
        if self.poses == "colmap" and any(noise):
            remedy = "leave the pose noise out, because COLMAP makes errors of its own"
            raise DataError(_SIMULATE, f"pose noise {noise} with --poses colmap", remedy)
        _require_seed(self.seed, _SIMULATE)

    def _judge_numbers(self) -> None:
        for name, value in {**vars(self), **vars(self.noise)}.items():
            if name in _RANGES and value is not None:
                low, high = _RANGES[name]
                if not low <= value <= high:
                    remedy = f"give a number from {low:g} to {high:g}"
                    raise DataError(_SIMULATE, f"--{name.replace('_', '-')} {told(value)}", remedy)
        require_event_sensor_size(self.width, self.height, _SIMULATE)
        if self.duration is not None:
            self.require_poses(self.duration)

    def require_poses(self, duration: float) -> None:
        """Raise a DataError if the trajectories of a duration in seconds have one pose, or more than readers take."""
        num_poses = self.pose_rate * duration
        # The last pose is at the end, and one that is closer to it than half an interval is left out.
        if num_poses <= 0.5:
            raise DataError(_SIMULATE, f"--pose-rate {self.pose_rate:g} gives one pose", "give a higher --pose-rate")
        if num_poses > MAX_ROWS:
            raise DataError(_SIMULATE, f"{num_poses:.3g} poses", "give a lower --pose-rate or a shorter --duration")

    def _judge_video(self, video: Path) -> None:
        with reading(video):
            if not video.exists():
                raise DataError(video, "there is no such video", "give a file, or a folder of images")
        if self.calibration is not None and self.intrinsics is not None:
            raise DataError(_SIMULATE, "--calibration and --intrinsics are both given", "leave out one of them")
        noise = (self.pose_noise_degrees, self.pose_noise_translation)
        if any(noise) and self.trajectory is None:
            raise DataError(_SIMULATE, f"pose noise {noise} without poses to add it to", "give --trajectory")
        if self.trajectory is not None:
            if self.poses == "colmap":
                raise DataError(_SIMULATE, "--trajectory with --poses colmap", "leave out one of them")
            if self.calibration is None and self.intrinsics is None:
                raise DataError(
                    _SIMULATE,
                    "--trajectory without the intrinsics of the camera",
                    "give --calibration or --intrinsics, or let COLMAP estimate lens and poses with --poses colmap",
                )
        for file in (self.trajectory, self.calibration):
            if file is not None:
                require_file(file)

    def _refuse_options_without_effect(self) -> None:
        unused, subject = (_FOR_VIDEOS, "a scene") if self.video is None else (_FOR_SCENES, "a video")
        for option in fields(self):
            if option.name in unused and getattr(self, option.name) != option.default:
                name = option.name.replace("_", "-")
                raise DataError(_SIMULATE, f"--{name} has no meaning for {subject}", "leave the option out")

    def sensor(self) -> SensorModel:
        """Return the sensor.

        Raises:
            DataError: a value is impossible.
        """
        try:
            return SensorModel(
                self.positive_contrast_threshold,
                self.negative_contrast_threshold,
                self.refractory_period_ns,
                self.bayer_pattern,
            )
        except ValueError as error:
            raise DataError(_SIMULATE, str(error), "see aenerf simulate --help") from None
