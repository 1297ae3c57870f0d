"""``aenerf convert``: a dataset of any format as a dataset folder of aenerf-ns."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from aenerf_ns.cli.console import say
from aenerf_ns.cli.dataset import (
    DatasetCommand,
    copy_images,
    open_writer,
    say_scene_box,
    training_command,
    views_to_copy,
)
from aenerf_ns.cli.four_words import four_words
from aenerf_ns.cli.ranges import require_seed
from aenerf_ns.cli.termination import exclusive_output
from aenerf_ns.errors import DataError, value_errors_as_data_error
from aenerf_ns.files.output_paths import require_absent
from aenerf_ns.reconstruction.weights import require_weights

if TYPE_CHECKING:
    from PIL.Image import Image

    from aenerf_ns.camera.time_window import TimeWindow
    from aenerf_ns.camera.trajectory import Trajectory
    from aenerf_ns.events.filters import EventFilters, EventSelection
    from aenerf_ns.events.stream import EventStream
    from aenerf_ns.pose_estimation.placement import EstimatedPoses
    from aenerf_ns.recording.dataparser import EventDataParser
    from aenerf_ns.recording.output_lock import OutputLock
    from aenerf_ns.recording.recording import Capture, Recording
    from aenerf_ns.recording.writer import NativeDatasetWriter


@dataclass
class Convert(DatasetCommand):
    """Write a dataset of any format as a dataset folder of aenerf-ns, with some of the events left out where asked.
    The events are read and written piece by piece, and the folder appears when it is complete. A command that was
    interrupted while it looked for poses goes on when it is repeated."""

    output: Path
    """Dataset folder to create."""
    poses: Literal["given", "refined", "colmap", "events"] = "given"
    """given: take the dataset's poses. refined: correct them by the motion of features in images that are made of the
    events, as far as these know better. colmap: have COLMAP estimate poses from the recording's frames. events: have it
    estimate poses from images that are made of the events, for a recording without frames or of fast motion. Poses
    of colmap and events have no metric scale, and poses that the dataset gives are kept as ground truth."""
    weights: Path | None = None
    """Weights file of FireNet or E2VID, as its authors distribute it: the network makes the images that poses are
    refined by or estimated from. By default, a filter makes them."""
    start_time_ns: int | None = None
    """Leave out events and images before this time on the clock of the events, in nanoseconds."""
    end_time_ns: int | None = None
    """Leave out events and images after this time on the clock of the events, in nanoseconds."""
    region: Annotated[tuple[int, int, int, int] | None, four_words(int, "X Y WIDTH HEIGHT")] = None
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

    def main(self) -> None:
        """Read the dataset and write it."""
        require_absent(self.output)
        require_seed(self.seed)
        if self.weights is not None:
            if self.poses not in ("refined", "events"):
                problem = f"--poses {self.poses} makes no images of events"
                raise DataError("--weights", problem, "choose --poses refined or events")
            require_weights(self.weights)
        from aenerf_ns.events.filters import EventFilters

        with value_errors_as_data_error("aenerf convert", "see aenerf convert --help"):
            filters = EventFilters(
                start=self.start_time_ns,
                end=self.end_time_ns,
                region=self.region,
                hot_pixels=self.drop_hot_pixels,
                pixel_share=self.pixel_share,
                shortest_interval=self.shortest_interval_ns,
                seed=self.seed,
            )
        parser = self.open_dataset()
        with exclusive_output(self.output) as lock:
            self._convert(parser, filters, lock)

    @property
    def _colmap_folder(self) -> Path:
        return self.output.with_name(f".{self.output.name}.colmap")

    def _convert(self, parser: EventDataParser, filters: EventFilters, lock: OutputLock) -> None:
        from aenerf_ns.events.filters import EventSelection
        from aenerf_ns.recording.images import check_image
        from aenerf_ns.recording.poses_report import POSES_PICTURE
        from aenerf_ns.recording.time_units import require_covered

        has_given_poses = self.poses in ("given", "refined")
        capture, images = (parser.recording, parser.recording.frames) if has_given_poses else parser.read_frames()
        source = capture.event_file
        events = EventSelection(source.path, source.width, source.height, filters, capture.sensor.bayer_pattern)
        # Refused before poses are found, which may take hours.
        if self.region is not None and capture.sensor.bayer_pattern and (self.region[0] % 2 or self.region[1] % 2):
            problem = f"a region of interest from pixel {self.region[0]} {self.region[1]} of a color sensor"
            remedy = "begin it at an even column and row, so that the Bayer pattern begins there as on the whole sensor"
            raise DataError("aenerf convert", problem, remedy)
        if self.poses == "refined" or (self.poses == "events" and capture.has_own_frames):
            for time, file in images:
                if filters.window.contains(time):
                    check_image(file, capture.frame_camera)
        report = picture = None
        if has_given_poses:
            recording = parser.recording
            # Called for its errors: events that are missing, or fit the poses in another unit of time alone.
            parser.event_span(recording, self.start_time_ns, self.end_time_ns)
            if self.poses == "refined":
                recording, report, picture = self._with_refined_poses(parser, recording, filters.window)
        else:
            recording, report, picture = self._with_estimated_poses(capture, images, filters.window)
            # The dataset's own longest gap is about its own poses, but one that was given is about these.
            if any(option.replace("-", "_").startswith("max_pose_gap_ns=") for option in self.format_options):
                recording = replace(recording, max_pose_gap=parser.config.max_pose_gap_ns)
        trajectory = _cut(recording, filters.window)
        views = views_to_copy(recording, filters.window)
        if self.region is not None:
            recording = replace(recording, event_camera=recording.event_camera.crop(*self.region))
        with open_writer(lock, parser, recording, has_given_poses) as writer:
            writer.add_trajectories(trajectory, recording.ground_truth)
            if report is None:
                writer.copy_poses_report(trajectory)
            else:
                writer.add_poses_report(report)
            if picture is not None:
                picture.quantize().save(writer.other_file(POSES_PICTURE))
            copy_images(writer, recording, views)
            num_read, num_covered = _copy_events(recording, events, writer)
            if has_given_poses and self.start_time_ns is None and self.end_time_ns is None:
                require_covered(recording.event_file.path, writer.events.num_events, num_covered)
        counts = ", ".join(f"{len(views[split])} {split}" for split in ("train", "val", "test"))
        say(
            f"{self.output}: {writer.events.num_events:,} of {num_read:,} events, {len(trajectory)} poses, "
            f"images: {counts}.\n"
            f"Look it over with: aenerf check {shlex.quote(str(self.output))}\n"
            f"Train with: {training_command(self.output)}"
        )

    def _with_estimated_poses(
        self, capture: Capture, images: list[tuple[int, Path]], window: TimeWindow
    ) -> tuple[Recording, dict[str, Any], Image | None]:
        """Estimate poses with COLMAP, and return the recording with them, COLMAP's report and its picture."""
        from aenerf_ns.pose_estimation.from_events import estimate_poses_from_events
        from aenerf_ns.pose_estimation.from_frames import estimate_poses
        from aenerf_ns.recording.views import require_seconds

        if self.poses == "events":
            found = estimate_poses_from_events(capture, window, self.data, self.seed, self.weights, self._colmap_folder)
            return _with_poses(found, capture, images)
        if not capture.has_own_frames:
            raise DataError(
                self.data,
                "its frames are of another camera than its events, and COLMAP finds the poses of the frames only",
                "estimate them from the events (--poses events), or estimate poses elsewhere, convert them to poses of "
                "the event camera, and give them as the trajectory",
            )
        kept = [(time, file) for time, file in images if window.contains(time)]
        times, files = [time for time, _ in kept], [file for _, file in kept]
        first, last = span = capture.event_file.time_span()
        # Before COLMAP's work, which may take hours.
        num_inside = sum(first <= time <= last for time in times)
        if num_inside <= len(times) // 10:
            require_seconds(times, self.data, "events", span)
        if len(times) > 2 and num_inside < 2:
            problem = f"{num_inside} of {len(times)} frames were taken during the events, from {first} to {last} ns"
            raise DataError(self.data, problem, "give the times of the frames in seconds on the clock of the events")
        lens = capture.event_camera
        camera = (lens.width, lens.height) if capture.intrinsics_origin == "guessed" else lens
        found = estimate_poses(files, times, camera, self.data, self.seed, self._colmap_folder)
        return _with_poses(found, capture, kept)

    def _with_refined_poses(
        self, parser: EventDataParser, recording: Recording, window: TimeWindow
    ) -> tuple[Recording, dict[str, Any], Image]:
        """Refine the poses, and return the recording with them, the report on them, and a picture."""
        from aenerf_ns.camera.alignment import pose_errors
        from aenerf_ns.pose_estimation.from_poses import refine_poses
        from aenerf_ns.recording.views import move_views

        given, truth = recording.trajectory, recording.ground_truth
        knots = None if truth is None else given.knots_covered_by(truth)
        found = refine_poses(recording, window, self.data, self.seed, self.weights, self._colmap_folder)
        report, refined = found.report, found.trajectory
        say(report["summary"])
        paths = {"given": given.camera_to_worlds.numpy(), "refined": refined.camera_to_worlds.numpy()}
        if truth is None or knots is None:
            views = {split: move_views(views, given, refined) for split, views in recording.reference_views.items()}
            recording = replace(recording, reference_views=views)
        else:
            true = truth.interpolate(knots)
            before, after = (pose_errors(poses.interpolate(knots), true) for poses in (given, refined))
            report |= {"errors_given": before, "errors": after}
            say(
                f"Compared with the ground truth: mean errors {before['rotation_error_degrees']:.2f} degrees and "
                f"{before['translation_error']:.2g} as given, {after['rotation_error_degrees']:.2f} degrees and "
                f"{after['translation_error']:.2g} refined."
            )
        # Near and far planes of poses that training does not scale are in the units of these.
        if recording.scene_box is None and parser.scales_poses(recording):
            say_scene_box(found.scene_box)
            recording = replace(recording, scene_box=found.scene_box)
        return replace(recording, trajectory=found.trajectory), report, found.draw(paths)


def _cut(recording: Recording, window: TimeWindow) -> Trajectory:
    """Crop the poses to the time window, or return all poses if the window has no bounds."""
    from aenerf_ns.camera.time_window import TimeWindow

    first, last = recording.event_file.time_span()
    start, end = max(first, window.start), min(last, window.end)
    if end < start:
        problem = f"its events are from {first} to {last} ns, all outside the time window"
        raise DataError(recording.event_file.path, problem, "widen the time window (--start-time-ns, --end-time-ns)")
    covered = recording.trajectory.crop(start, end)
    return recording.trajectory if window == TimeWindow() else covered


def _copy_events(recording: Recording, events: EventSelection, writer: NativeDatasetWriter) -> tuple[int, int]:
    """Write the kept events, and count the events that were read, and those of the kept ones that have a pose."""
    source, known = recording.event_file, recording.trajectory.known_time()
    num_read = num_covered = 0

    def read(description: str) -> Iterator[EventStream]:
        nonlocal num_read
        num_read = 0
        for chunk in source.tracked(description):
            yield chunk
            num_read += len(chunk)

    hot_pixels = events.find_hot_pixels(read("Looking for hot pixels"))
    for chunk in events.filtered(read("Converting events")):
        writer.events.append(chunk)
        num_covered += int(known.contains(chunk.t).sum())
    if writer.events.num_events == 0:
        remedy = "widen the time window, the region of interest or the share"
        raise DataError(source.path, "no event is left", remedy)
    if hot_pixels:
        say(hot_pixels)
    return num_read, num_covered


def _with_poses(
    found: EstimatedPoses, capture: Capture, images: list[tuple[int, Path]]
) -> tuple[Recording, dict[str, Any], Image | None]:
    """Return the recording with estimated poses, the report on them, and a picture of them."""
    from aenerf_ns.camera.trajectory import Trajectory
    from aenerf_ns.pose_estimation.from_frames import compare_with_truth
    from aenerf_ns.recording.recording import Capture, Recording
    from aenerf_ns.recording.views import MAX_VIEWS, views_on_trajectory

    trajectory, report = found.trajectory, found.report()
    # In place of what a dataset has: its scene box is in the world of its own poses, and its longest gap about these.
    new: dict[str, Any] = {"trajectory": trajectory, "scene_box": found.scene_box, "max_pose_gap": found.max_pose_gap()}
    if capture.intrinsics_origin == "guessed":
        if capture.has_own_frames:
            capture = replace(capture, frame_camera=found.camera)
        capture = replace(capture, event_camera=found.camera, intrinsics_origin="estimated")
        report["intrinsics"] = found.camera.to_transforms()
        say(f"The intrinsics were estimated with the poses: {found.camera.summary()}.")
    paths = {"estimated": trajectory.camera_to_worlds.numpy()}
    say(found.summary())
    say(
        "The poses are in a world of their own: z is up if the camera was held level, and the scale is arbitrary, as "
        "images of one camera tell no lengths."
    )
    say_scene_box(found.scene_box)
    if isinstance(capture, Recording):
        truth, name, of_name = capture.reference_trajectory, "true", "ground truth"
        if capture.ground_truth is None:
            name, of_name = "given", "given poses, which are kept as ground truth"
        knots = trajectory.knots_known_to(truth)
        if len(knots) > 1:
            covered = Trajectory(knots, trajectory.interpolate(knots))
            aligned, errors = compare_with_truth(covered, truth.interpolate(knots))
            paths = {name: truth.interpolate(knots).numpy(), "estimated": aligned.camera_to_worlds.numpy()}
            report["errors"] = errors
            say(
                f"Compared with the {of_name}: mean errors {errors['rotation_error_degrees']:.2f} degrees and "
                f"{errors['translation_error']:.2g} of their units."
            )
            recording = replace(capture, ground_truth=truth, **new)
            return recording, report, found.draw and found.draw(paths)
        say(
            f"The {name} poses, from {truth.start} to {truth.end} ns, are of another time than the estimated ones, "
            f"from {trajectory.start} to {trajectory.end} ns: they are left out."
        )
    if not capture.has_own_frames:
        if images:
            say("The recording's images are left out: they are of another camera than the events.")
        # In a world without scale, nothing tells how far one camera is from the other.
        images, capture = [], replace(capture, frame_from_event=None)
    placed = [(time, file) for time, file in images if trajectory.start <= time <= trajectory.end]
    views = views_on_trajectory(placed, trajectory)
    camera = {field.name: getattr(capture, field.name) for field in fields(Capture)}
    recording = Recording(**camera, **new, reference_views=views, max_views=MAX_VIEWS)
    return recording, report, found.draw and found.draw(paths)
