"""What `aenerf simulate` is asked for each benchmark scene: the figures' own size, and a tiny one for a CPU."""

from __future__ import annotations

from typing import Literal

Options = dict[str, int | float]
"""Options of `aenerf simulate` by name, with underscores."""

_FULL: Options = {
    "width": 346,
    "height": 260,
    "pose_rate": 250.0,
    # Half of it changes the number of events by less than 2 %, and doubles the time.
    "max_displacement": 1.0,
    "train_images": 50,
    "validation_views": 100,
    "test_views": 100,
}
_TINY: Options = {
    "width": 96,
    "height": 72,
    "pose_rate": 250.0,
    "max_displacement": 1.0,
    "train_images": 10,
    "validation_views": 8,
    "test_views": 8,
}
DURATIONS: dict[str, float] = {
    "piano": 4.0,
    "bookshelf": 4.0,
    "plants": 4.0,
    "playground": 4.0,
    "breakfast": 4.0,
    "lounge": 4.0,
    "forklift": 4.0,
    "games": 4.0,
    "living_room": 4.0,
    "terrace": 6.0,
    "gallery": 8.0,
    "workshop": 5.0,
}
"""Every scene, and the seconds that its path takes at constant speed."""


def simulate_options(scene: str, size: Literal["full", "tiny"]) -> Options:
    """Options of `aenerf simulate` for a scene, without the scene and the output.

    Raises:
        KeyError: on a name that is no benchmark scene.
    """
    return {"duration": DURATIONS[scene], **(_FULL if size == "full" else _TINY)}
