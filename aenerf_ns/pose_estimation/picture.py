"""A picture of estimated poses: the images and their tracks, and the camera's path from above."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

Observations = tuple[NDArray[np.int64], NDArray[np.float64]]
"""The tracks that an image shows: their (M,) numbers, and their (M, 2) pixels from the edge of the image."""

_COLUMNS, _ROWS = 3, 2
# Images before and after the one shown through which a track is drawn.
_TAIL = 4
_PANEL_WIDTH, _GAP = 320, 4
_COLORS = ("#999999", "#d62728", "#1f77b4")
# Bright colors that the numbers of tracks choose among.
_TRACK_COLORS = tuple(f"hsl({hue},100%,60%)" for hue in range(0, 360, 24))


def observations_of(model: Any, num_images: int) -> list[Observations]:
    """Return what each image shows of the tracks of a COLMAP model: nothing where it has no pose."""
    observed: list[Observations] = [(np.zeros(0, np.int64), np.zeros((0, 2)))] * num_images
    for image in model.images.values():
        points = [point for point in image.points2D if point.has_point3D()]
        if image.has_pose and points:
            numbers = np.array([point.point3D_id for point in points], np.int64)
            observed[int(Path(image.name).stem)] = numbers, np.stack([point.xy for point in points])
    return observed


def draw_poses(
    images: Sequence[NDArray[np.uint8]], observations: Sequence[Observations], paths: Mapping[str, NDArray[np.float64]]
) -> Image.Image:
    """Draw six images, each with its tracks through the images before and after it, and paths from above.

    Args:
        images: (height, width) gray or (height, width, 3) RGB, in the order of time.
        observations: of each image.
        paths: (N, 3, 4) camera-to-world poses of each path in one world, OpenCV camera axes, by name.
    """
    height = round(_PANEL_WIDTH * images[0].shape[0] / images[0].shape[1])
    side = _ROWS * height + (_ROWS - 1) * _GAP
    sheet = Image.new("RGB", (_COLUMNS * (_PANEL_WIDTH + _GAP) + side, side), "white")
    for place, index in enumerate(np.linspace(0, len(images) - 1, _COLUMNS * _ROWS).round().astype(int)):
        corner = place % _COLUMNS * (_PANEL_WIDTH + _GAP), place // _COLUMNS * (height + _GAP)
        sheet.paste(_draw_tracks(images, observations, index, height), corner)
    sheet.paste(_draw_paths(paths, side), (_COLUMNS * (_PANEL_WIDTH + _GAP), 0))
    return sheet


def _draw_tracks(
    images: Sequence[NDArray[np.uint8]], observations: Sequence[Observations], index: int, height: int
) -> Image.Image:
    panel = Image.fromarray(images[index]).convert("RGB").resize((_PANEL_WIDTH, height), Image.Resampling.BICUBIC)
    pen, factor = ImageDraw.Draw(panel), _PANEL_WIDTH / images[index].shape[1]
    near = [
        dict(zip(numbers.tolist(), (factor * pixels).tolist(), strict=True))
        for numbers, pixels in observations[max(index - _TAIL, 0) : index + _TAIL + 1]
    ]
    shown = near[min(index, _TAIL)]
    for number, (x, y) in shown.items():
        color = _TRACK_COLORS[number % len(_TRACK_COLORS)]
        pen.line([tuple(seen[number]) for seen in near if number in seen], color)
        pen.rectangle((x - 1, y - 1, x + 1, y + 1), color)
    pen.text((3, 2), f"image {index + 1} of {len(images)}: {len(shown)} tracks", "white", stroke_width=2, stroke_fill=0)
    return panel


def _draw_paths(paths: Mapping[str, NDArray[np.float64]], side: int) -> Image.Image:
    """Draw paths in the plane in which the cameras extend most, with the directions that they look in."""
    panel = Image.new("RGB", (side, side), "white")
    pen = ImageDraw.Draw(panel)
    positions = np.concatenate([poses[:, :, 3] for poses in paths.values()])
    center = positions.mean(0)
    plane = np.linalg.svd(positions - center, full_matrices=False)[2][:2]
    low, high = ((positions - center) @ plane.T).min(0), ((positions - center) @ plane.T).max(0)
    factor = 0.8 * side / max((high - low).max(), 1e-12)
    for row, ((name, poses), color) in enumerate(zip(paths.items(), _COLORS[-len(paths) :], strict=False)):
        points = ((poses[:, :, 3] - center) @ plane.T - (low + high) / 2) * factor + side / 2
        ends = points + poses[:, :, 2] @ plane.T * 0.06 * side
        for point, end in list(zip(points, ends, strict=True))[:: max(len(poses) // 40, 1)]:
            pen.line([*point, *end], color)
        pen.line(points.ravel().tolist(), color, width=2)
        pen.text((6, 4 + 13 * row), f"{name} ({len(poses)})", color)
    return panel
