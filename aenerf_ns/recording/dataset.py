"""Nerfstudio's dataset of a recording: cameras with pictures, and the events, read when first needed."""

from __future__ import annotations

import zlib
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from nerfstudio.data.datasets.base_dataset import InputDataset
from nerfstudio.utils.rich_utils import CONSOLE
from numpy.typing import NDArray
from torch import Tensor

from aenerf_ns.camera.metadata_keys import REFERENCE_SECONDS
from aenerf_ns.errors import DataError
from aenerf_ns.events.pair_store import EventPairs
from aenerf_ns.events.picture import polarity_picture
from aenerf_ns.events.sorted_events import SortedEvents, sort_events
from aenerf_ns.events.stream import EventStream
from aenerf_ns.recording.pair_cache import PairFile
from aenerf_ns.recording.scene import SCENE_KEY, SceneRecording
from aenerf_ns.recording.time_units import require_covered

if TYPE_CHECKING:
    from aenerf_ns.events.polarity_drift import PolarityDrift

# The most rows that a timeline is made from, in memory and in a file, where each row is a page to read.
_TIMELINE_ROWS, _TIMELINE_ROWS_IN_FILE = 1 << 23, 1 << 18


class EventDataset(InputDataset):
    """A split of a recording. Training cameras show an image or the events around them, the others show images."""

    @property
    def scene(self) -> SceneRecording:
        """The recording in the frame of the scene."""
        return self.metadata[SCENE_KEY]

    @property
    def reference_seconds(self) -> Tensor:
        """When the images of a split of reference views were taken, wherever their cameras are now: (N,) float64
        seconds since the start of the estimated trajectory, NaN for images off the trajectory."""
        seconds: Tensor = self._dataparser_outputs.cameras.metadata[REFERENCE_SECONDS]
        return seconds[:, 0]

    @cached_property
    def usable(self) -> Tensor:
        """(height, width) whether the lens model gives a pixel of the split's cameras a direction."""
        return torch.from_numpy(self.scene.camera.scaled(self.scale_factor).pixel_directions()[1])

    def get_metadata(self, data: dict[str, Any]) -> dict[str, Any]:
        """Return the framework's mask (height, width, 1) of the pixels of a reference view that have a direction."""
        # The viewer shows training cameras. To find their directions would delay its start by seconds.
        return {} if len(self.scene.camera_times) else {"mask": self.usable[..., None]}

    @cached_property
    def polarity_drift(self) -> PolarityDrift:
        """How the contrast thresholds of the pixels differ. The first access goes through all :attr:`pairs`."""
        # Imported lazily: every ns-* command imports this module, and numba is slow to import.
        from aenerf_ns.events.polarity_drift import polarity_drift

        return polarity_drift(self.pairs)

    @cached_property
    def pairs(self) -> EventPairs:
        """All pairs of events in the time window. The first access reads the whole event file, or finds its pairs.

        Raises:
            DataError: the event file is missing or malformed, or no event lies in the time window.
        """
        scene = self.scene
        events, window, period = scene.event_file, scene.window, scene.sensor.refractory_period
        events.require()
        _, usable = scene.event_camera.pixel_directions()
        bounds = [window.start, window.end, window.gaps]
        made_from = {"refractory_period": period, "window": bounds, "usable": zlib.crc32(usable.data)}
        file, count = PairFile(events, made_from), events.count()
        # Imported lazily: every ns-* command imports this module, and numba is slow to import.
        from aenerf_ns.events.pairing import EVENTS_IN_MEMORY, pair_events

        pairs, read = file.find(), file.path
        if pairs is None:
            # Several processes read a short recording side by side.
            with file.making(alone=count is None or count > EVENTS_IN_MEMORY):
                pairs = file.find()
                if pairs is None:
                    read = events.path
                    pairs = pair_events(
                        events.tracked(), refractory_period=period, window=window, usable=usable, open_file=file.open
                    )
                    if len(pairs) > 0:
                        file.keep(pairs)
        CONSOLE.print(f"{read.name}: {pairs.summary()}.", markup=False)
        self._require_covered(pairs.num_events, pairs.num_outside)
        if len(pairs) == 0:
            raise DataError(events.path, "no pixel has two events", "record longer, or widen the time window")
        return pairs

    @cached_property
    def windows(self) -> SortedEvents:
        """All events in the time window, in the order of time. The first access reads the whole event file.

        Raises:
            DataError: the event file is missing or malformed, or no event lies in the time window.
        """
        scene = self.scene
        scene.event_file.require()
        _, usable = scene.event_camera.pixel_directions()
        windows = sort_events(scene.event_file.tracked(), window=scene.window, usable=usable)
        CONSOLE.print(f"{scene.event_file.path.name}: {windows.summary()}.", markup=False)
        self._require_covered(len(windows.times) + windows.num_outside + windows.num_unusable, windows.num_outside)
        return windows

    def _require_covered(self, num_events: int, num_outside: int) -> None:
        # Gaps of the poses are left out on purpose, and are most of some recordings.
        if self.scene.is_whole and not self.scene.window.gaps:
            require_covered(self.scene.event_file.path, num_events, num_events - num_outside)

    def get_numpy_image(self, image_idx: int) -> NDArray[np.uint8]:
        """Return the (H, W, 3) image of a camera, or a picture of events around its time if it has no image."""
        scene = self.scene
        if scene.has_image[image_idx]:
            return super().get_numpy_image(image_idx)
        events = self.events_around(int(scene.camera_times[image_idx]), self.usual_number_of_events)
        return polarity_picture(events)

    @property
    def usual_number_of_events(self) -> int:
        """Events in a picture that show edges without smearing them: a quarter of the pixels."""
        camera = self.scene.event_camera
        return min(max(camera.width * camera.height // 400 * 100, 200), 20_000)

    def events_around(self, time: int, count: int) -> EventStream:
        """Return about ``count`` events around a time in nanoseconds; none where there is no file."""
        if self.has_events:
            return self.timeline.nearest(time, count)
        nothing, camera = np.zeros(0, np.uint16), self.scene.event_camera
        return EventStream(nothing, nothing, np.zeros(0, np.int64), np.zeros(0, np.int8), camera.width, camera.height)

    @property
    def has_events(self) -> bool:
        """Whether the event file is there. A trained run may be opened where it is not."""
        return self.scene.event_file.path.exists()

    @cached_property
    def timeline(self) -> EventStream:
        """Events to look at around a time, at most 8 million. The first access may read the whole event file.

        Raises:
            DataError: see :attr:`pairs`.
        """
        # Reading again, as pairs, what was read as windows for training would take as long.
        if "windows" in vars(self):
            return self.windows.events(_every(len(self.windows.times), _TIMELINE_ROWS))
        # Rows that are mapped from a file are read-only.
        in_memory = self.pairs.rows.flags.writeable
        most = _TIMELINE_ROWS if in_memory else _TIMELINE_ROWS_IN_FILE
        return self.pairs.events(_every(len(self.pairs.rows), most))


def _every(num_rows: int, max_rows: int) -> slice:
    """Return a slice of at most ``max_rows`` of the rows, evenly spread."""
    return slice(None, None, max(-(-num_rows // max_rows), 1))
