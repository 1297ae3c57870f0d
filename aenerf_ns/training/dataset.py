"""Training cameras with pictures, and the events behind them, read when first needed."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from nerfstudio.data.datasets.base_dataset import InputDataset
from nerfstudio.utils.rich_utils import CONSOLE
from numpy.typing import NDArray

from aenerf_ns.errors import DataError
from aenerf_ns.events.picture import polarity_picture
from aenerf_ns.events.stream import EventFile
from aenerf_ns.progress import progress_bar

if TYPE_CHECKING:
    from aenerf_ns.events.pairs import EventPairs

# Events in a picture, as a share of the sensor's pixels: enough to show edges, few enough not to smear them.
_PICTURE_DENSITY = 0.25


class EventDataset(InputDataset):
    """A split of a recording: training cameras show an image or their events, the others show images."""

    @cached_property
    def pairs(self) -> EventPairs:
        """All pairs of events in the time window. Reads the whole event file.

        Raises:
            DataError: the event file is missing or malformed, or no event lies in the time window.
        """
        # Late, for every command of every method would wait for numba.
        from aenerf_ns.events.pairs import pair_events

        event_file: EventFile = self.metadata["event_file"]
        start, end = self.metadata["time_window"]
        count = event_file.count()
        with progress_bar() as progress:
            task = progress.add_task(f"Reading {event_file.path.name}", total=count)

            def chunks():
                for chunk in event_file.chunks():
                    yield chunk
                    progress.advance(task, len(chunk))

            pairs = pair_events(
                chunks(),
                refractory_period=self.metadata["sensor"].refractory_period,
                start=start,
                end=end,
                gaps=self.metadata["pose_gaps"],
                expected_events=count,
            )
        CONSOLE.print(f"{event_file.path.name}: {pairs.summary()}.")
        if len(pairs) == 0:
            raise DataError(event_file.path, "no pixel has two events", "record longer, or widen the time window")
        return pairs

    def get_numpy_image(self, image_idx: int) -> NDArray[np.uint8]:
        """The image (H, W, 3), or for a camera without one the events nearest in time, accumulated."""
        if self.metadata["has_image"][image_idx]:
            return super().get_numpy_image(image_idx)
        camera = self.metadata["event_camera"]
        if not self.metadata["event_file"].path.exists():
            # A trained run may be opened where its events are not.
            nothing = np.zeros(0, dtype=np.int64)
            return polarity_picture(nothing, nothing, nothing, camera.width, camera.height)
        pairs = self.pairs
        half = max(int(_PICTURE_DENSITY * camera.width * camera.height) // 2, 1)
        middle = int(np.searchsorted(pairs.time, int(self.metadata["camera_times"][image_idx])))
        shown = slice(max(middle - half, 0), middle + half)
        polarity = pairs.num_positive[shown].astype(np.int64) - pairs.num_negative[shown]
        return polarity_picture(pairs.x[shown], pairs.y[shown], polarity, camera.width, camera.height)
