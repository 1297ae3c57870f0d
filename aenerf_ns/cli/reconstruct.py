"""``aenerf reconstruct``: images of a recording's events, as a dataset and as a video."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, field

import numpy as np
import torch
from nerfstudio.utils.rich_utils import CONSOLE
from numpy.typing import NDArray

from aenerf_ns.camera.trajectory import homogeneous
from aenerf_ns.cli.arguments import Automatic, ReconstructArguments
from aenerf_ns.cli.dataset_format import DatasetFormat, open_dataset, training_command
from aenerf_ns.cli.termination import ended_by_exception
from aenerf_ns.cli.video_file import new_video
from aenerf_ns.errors import DataError
from aenerf_ns.events.stream import EventStream
from aenerf_ns.progress import tracked
from aenerf_ns.reconstruction.images import FilteredImages, ImageSource, NetworkImages, images_of
from aenerf_ns.reconstruction.weights import load_network
from aenerf_ns.recording.images import check_image
from aenerf_ns.recording.output_lock import OutputLock
from aenerf_ns.recording.recording import SPLITS, Recording
from aenerf_ns.recording.views import thinned
from aenerf_ns.recording.writer import NativeDatasetWriter

_VIDEO, _VIDEO_RATE = "reconstruction.mp4", 25


@dataclass
class Reconstruct(ReconstructArguments):
    __doc__ = ReconstructArguments.__doc__

    format: DatasetFormat = field(default_factory=Automatic)

    def main(self) -> None:
        """Read the dataset, reconstruct the images and write them."""
        self.judge()
        with ended_by_exception(), OutputLock(self.output) as lock:
            self._reconstruct(lock)

    def _reconstruct(self, lock: OutputLock) -> None:
        parser = open_dataset(self.data, self.format)
        recording = parser.recording
        source = self._source(recording)
        camera, longest_gap = recording.event_camera, parser.config.max_pose_gap_ns
        longest_gap = recording.max_pose_gap if longest_gap is None else longest_gap
        with (
            NativeDatasetWriter(
                lock,
                camera,
                recording.sensor,
                recording.image_encoding,
                scene_box=None if recording.scene_box is None else recording.scene_box.numpy(),
                max_pose_gap=longest_gap,
                # The field then has the scale that a field of the recording's events has.
                auto_scale_poses=parser.scales_poses(recording),
            ) as writer,
            closing(new_video(writer.other_file(_VIDEO), camera.width, camera.height, _VIDEO_RATE)) as video,
        ):
            writer.add_trajectories(recording.trajectory, recording.ground_truth)
            _add_reference_views(recording, writer)
            num_images = 0
            for time, image in self._images(recording, source, longest_gap, writer):
                pose = homogeneous(recording.trajectory.interpolate(time))
                writer.add_image("train", image, pose, time)
                video.send(image.tobytes())
                num_images += 1
        CONSOLE.print(
            f"{self.output}: {num_images} images reconstructed by {self.method}, and {_VIDEO}.\n"
            f"Train on them with: {training_command(self.output, method='e2vid-nerf')}",
            highlight=False,
            soft_wrap=True,
        )

    def _source(self, recording: Recording) -> ImageSource:
        camera, sensor = recording.event_camera, recording.sensor
        if self.method == "high-pass":
            return FilteredImages(camera.width, camera.height, sensor)
        device = "cuda" if torch.cuda.is_available() else "cpu"
        return NetworkImages(load_network(self.method, self.weights), sensor, device)

    def _images(
        self, recording: Recording, source: ImageSource, longest_gap: int | None, writer: NativeDatasetWriter
    ) -> Iterator[tuple[int, NDArray[np.uint8]]]:
        """Write the events, and yield time and image of each batch of them that ends at a time with a pose."""
        events = recording.event_file
        known = recording.trajectory.known_time(longest_gap)
        num_events = max(int(self.events_per_pixel * events.width * events.height), 1)

        def copied() -> Iterator[EventStream]:
            for chunk in tracked(events.chunks(), "Reconstructing images", events.count()):
                writer.events.append(chunk)
                yield chunk

        num_made = num_placed = 0
        for time, image in images_of(copied(), num_events, source):
            num_made += 1
            if known.contains(time):
                num_placed += 1
                yield time, image
        if num_placed == 0:
            raise DataError(
                events.path,
                f"its events make {num_made} images of {num_events} events each, none at a time with a pose",
                "give a smaller --events-per-pixel, or poses that cover the events",
            )
        if num_placed < num_made:
            CONSOLE.print(
                f"{num_made - num_placed} of {num_made} images are left out: no pose is known at their times."
            )


def _add_reference_views(recording: Recording, writer: NativeDatasetWriter) -> None:
    """Copy the validation and test views, with which every method on this recording is evaluated."""
    views = {split: thinned(recording.reference_views[split], recording.max_views) for split in SPLITS[1:]}
    if recording.frame_camera != recording.event_camera:
        if any(views.values()):
            CONSOLE.print("The recording's images are left out: they are of another camera than the events.")
        return
    for file in {view.file for split in views.values() for view in split}:
        check_image(file, recording.frame_camera)
    for split, kept in views.items():
        for view in kept:
            writer.add_image_file(split, view.file, view.camera_to_world, view.time, recording.image_background)
