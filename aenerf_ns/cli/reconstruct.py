"""``aenerf reconstruct``: images of a recording's events, as a dataset and as a video."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from aenerf_ns.cli.console import say
from aenerf_ns.cli.dataset import DatasetCommand, copy_images, open_writer, training_command, views_to_copy
from aenerf_ns.cli.ranges import require_range
from aenerf_ns.cli.termination import exclusive_output
from aenerf_ns.errors import DataError
from aenerf_ns.files.output_paths import require_absent
from aenerf_ns.reconstruction.batches import EVENTS_PER_PIXEL, batches_of
from aenerf_ns.reconstruction.weights import require_weights

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from aenerf_ns.events.stream import EventStream
    from aenerf_ns.reconstruction.images import ImageSource
    from aenerf_ns.recording.dataparser import EventDataParser
    from aenerf_ns.recording.output_lock import OutputLock
    from aenerf_ns.recording.recording import Recording
    from aenerf_ns.recording.writer import NativeDatasetWriter

_VIDEO, _VIDEO_RATE = "reconstruction.mp4", 25


@dataclass
class Reconstruct(DatasetCommand):
    """Make images of a recording's events, and write a dataset folder with these images as training images, at the
    interpolated poses of their times, the true ones where the recording has these. The events and the other images are
    those of the recording. reconstruction.mp4 in the folder shows the images one after another."""

    output: Path
    """Dataset folder to create."""
    weights: Path | None = None
    """Weights file of FireNet (Scheerlinck et al. 2020) or E2VID (Rebecq et al. 2021), as its authors distribute it:
    the network makes the images. By default, a high-pass filter that runs forwards and backwards makes them."""
    events_per_pixel: float = EVENTS_PER_PIXEL
    """Events between two images, as a share of the sensor's pixels."""

    def main(self) -> None:
        """Read the dataset, reconstruct the images and write them."""
        require_absent(self.output)
        require_range("events-per-pixel", self.events_per_pixel, 1e-6, 1e6)
        if self.weights is not None:
            require_weights(self.weights)
        parser = self.open_dataset()
        with exclusive_output(self.output) as lock:
            self._reconstruct(parser, lock)

    def _reconstruct(self, parser: EventDataParser, lock: OutputLock) -> None:
        from aenerf_ns.cli.video_file import write_video

        recording = parser.recording
        source = self._source(recording)
        # The images are made of the events, and are the event camera's own.
        made_by_events = replace(recording, frame_camera=recording.event_camera, frame_from_event=None)
        with open_writer(lock, parser, made_by_events) as writer:
            writer.add_trajectories(recording.trajectory, recording.ground_truth)
            writer.copy_poses_report(recording.trajectory)
            _add_reference_views(recording, writer)
            images = self._write_images(recording, source, writer)
            num_images = write_video(writer.other_file(_VIDEO), images, _VIDEO_RATE)
        say(
            f"{self.output}: {num_images} images of the events, and {_VIDEO}.\n"
            f"Train on them with: {training_command(self.output, method='e2vid-nerf')}"
        )

    def _source(self, recording: Recording) -> ImageSource:
        import torch

        from aenerf_ns.events.polarity_drift import drift_of_events
        from aenerf_ns.reconstruction.images import NetworkImages, filtered_images
        from aenerf_ns.reconstruction.weights import load_network

        if self.weights is None:
            chunks = recording.event_file.tracked("Comparing the pixels")
            drift = drift_of_events(chunks, recording.sensor.refractory_period)
            return partial(filtered_images, sensor=recording.sensor, drift=drift)
        device = "cuda" if torch.cuda.is_available() else "cpu"
        return NetworkImages(load_network(self.weights), recording.sensor, device)

    def _write_images(
        self, recording: Recording, source: ImageSource, writer: NativeDatasetWriter
    ) -> Iterator[NDArray[np.uint8]]:
        """Write the events and an image of each batch of them that ends at a time with a pose. Yield the images."""
        # The views of a dataset are in the world of its true poses where it has these, whatever poses are trained on.
        events, reference = recording.event_file, recording.reference_trajectory
        known, truly = recording.trajectory.known_time(recording.max_pose_gap), reference.time_without_gaps()
        num_events = max(int(self.events_per_pixel * events.width * events.height), 1)

        def copied() -> Iterator[EventStream]:
            for chunk in events.tracked("Reconstructing images"):
                writer.events.append(chunk)
                yield chunk

        num_images = num_posed = 0
        for time, image in source(batches_of(copied(), num_events)):
            num_images += 1
            time -= recording.sensor.image_lag
            if known.contains(time) and truly.contains(time):
                num_posed += 1
                writer.add_image("train", image, reference.interpolate(time), time)
                yield image
        if num_posed == 0:
            problem = f"its events make {num_images} images of {num_events} events each, none at a time with a pose"
            raise DataError(events.path, problem, "give a smaller --events-per-pixel, or poses that cover the events")
        if num_posed < num_images:
            left_out = num_images - num_posed
            say(f"{left_out} of {num_images} images are left out: no pose, or no true pose, is known at their times.")


def _add_reference_views(recording: Recording, writer: NativeDatasetWriter) -> None:
    """Copy the validation and test views, with which every method on this recording is evaluated."""
    from aenerf_ns.camera.time_window import TimeWindow

    views = views_to_copy(recording, TimeWindow())
    del views["train"]
    if not recording.has_own_frames:
        if any(views.values()):
            say("The recording's images are left out: they are of another camera than the events.")
        return
    copy_images(writer, recording, views)
