"""Nerfstudio's dataset of a recording: cameras with pictures, and the pairs of events, read when first needed."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from nerfstudio.data.datasets.base_dataset import InputDataset
from nerfstudio.utils.rich_utils import CONSOLE
from numpy.typing import NDArray

from aenerf_ns.errors import DataError
from aenerf_ns.events.picture import polarity_picture
from aenerf_ns.progress import tracked
from aenerf_ns.recording.scene import SCENE, Scene

if TYPE_CHECKING:
    from aenerf_ns.events.pairs import EventPairs

# Events in a picture, as a share of the sensor's pixels: enough to show edges, too few to smear them.
_PICTURE_DENSITY = 0.25


class EventDataset(InputDataset):
    """A split of a recording. Training cameras show an image or the events around them, the others show images."""

    @property
    def scene(self) -> Scene:
        """The recording in the frame of the scene."""
        return self.metadata[SCENE]

    @cached_property
    def pairs(self) -> EventPairs:
        """All pairs of events in the time window. The first access reads the whole event file.

        Raises:
            DataError: the event file is missing or malformed, or no event lies in the time window.
        """
        # Imported lazily: every ns-* command imports this module, and numba is slow to import.
        from aenerf_ns.events.pairs import pair_events

        scene = self.scene
        count = scene.event_file.count()
        pairs = pair_events(
            tracked(scene.event_file.chunks(), f"Reading {scene.event_file.path.name}", count),
            refractory_period=scene.sensor.refractory_period,
            window=scene.window,
            expected_events=count,
        )
        CONSOLE.print(f"{scene.event_file.path.name}: {pairs.summary()}.")
        if len(pairs) == 0:
            raise DataError(scene.event_file.path, "no pixel has two events", "record longer, or widen the time window")
        return pairs

    def get_numpy_image(self, image_idx: int) -> NDArray[np.uint8]:
        """Return the (H, W, 3) image of a camera, or a picture of the events nearest in time if it has no image."""
        scene = self.scene
        if scene.has_image[image_idx]:
            return super().get_numpy_image(image_idx)
        width, height = scene.event_camera.width, scene.event_camera.height
        if not scene.event_file.path.exists():
            # A trained run may be opened where its events are not.
            nothing = np.zeros(0, dtype=np.int64)
            return polarity_picture(nothing, nothing, nothing, width, height)
        pairs = self.pairs
        half = max(int(_PICTURE_DENSITY * width * height) // 2, 1)
        middle = int(np.searchsorted(pairs.time, int(scene.camera_times[image_idx])))
        shown = slice(max(middle - half, 0), middle + half)
        polarity = pairs.num_positive[shown].astype(np.int64) - pairs.num_negative[shown]
        return polarity_picture(pairs.x[shown], pairs.y[shown], polarity, width, height)
