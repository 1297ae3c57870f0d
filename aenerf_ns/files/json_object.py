"""Objects in JSON that are checked as they are read."""

from __future__ import annotations

import json
from decimal import Decimal
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from aenerf_ns.camera.image_encoding import ImageEncoding
from aenerf_ns.camera.lens import EventCamera, LensModel
from aenerf_ns.camera.trajectory import require_rigid
from aenerf_ns.errors import DataError

# The lens and the names of its distortion parameters, in OpenCV's order, for Nerfstudio's names of camera models.
LENS_MODELS: dict[str, tuple[LensModel, tuple[str, ...]]] = {
    "OPENCV": ("radial_tangential", ("k1", "k2", "p1", "p2", "k3")),
    "OPENCV_FISHEYE": ("fisheye", ("k1", "k2", "k3", "k4")),
}


class Metadata:
    """A JSON object that reports a missing or ill-typed value with its file and name."""

    def __init__(self, path: Path, values: dict[str, Any], prefix: str = "") -> None:
        self.path = path
        self._values = values
        self._prefix = prefix

    @classmethod
    def read(cls, path: Path) -> Metadata:
        if not path.is_file():
            raise DataError(
                path, "there is no such file", "give a dataset folder as --data, or name its format after the options"
            )
        try:
            # Decimal keeps every digit of a time stamp; float would drop nanoseconds of the Unix time.
            values = json.loads(path.read_text(encoding="utf-8"), parse_float=Decimal)
        except ValueError as error:
            raise DataError(path, f"not valid JSON ({error})", "correct it there") from None
        if not isinstance(values, dict):
            raise DataError(path, "not a JSON object", "see the dataset format in the docs")
        return cls(path, values)

    def __contains__(self, name: str) -> bool:
        return name in self._values

    def error(self, name: str, problem: str) -> DataError:
        return DataError(self.path, f"{self._prefix}{name} {problem}", "see the dataset format in the docs")

    def get(self, name: str, kind: type, *default: Any) -> Any:
        """The value of ``name``, converted to ``kind`` (float also takes integers)."""
        if name not in self._values:
            if default:
                return default[0]
            raise self.error(name, "is missing")
        value = self._values[name]
        accepted = (int, Decimal) if kind is float else kind
        if not isinstance(value, accepted) or isinstance(value, bool):
            raise self.error(name, f"is {value!r}, not of type {kind.__name__}")
        return kind(value)

    def block(self, name: str) -> Metadata:
        return Metadata(self.path, self.get(name, dict), f"{self._prefix}{name}.")

    def entry(self, name: str, index: int) -> Any:
        """Entry ``index`` of the list ``name``."""
        values = self.get(name, list)
        if index >= len(values):
            raise self.error(name, f"has {len(values)} entries, not {index + 1}")
        return values[index]

    def entry_block(self, name: str, index: int) -> Metadata:
        """Entry ``index`` of the list ``name``, an object."""
        value = self.entry(name, index)
        if not isinstance(value, dict):
            raise self.error(f"{name}[{index}]", f"is {value!r}, not an object")
        return Metadata(self.path, value, f"{self._prefix}{name}[{index}].")

    def rigid_motion(self, name: str) -> Tensor | None:
        """The (4, 4) float64 matrix ``name`` of a rotation and a translation, or None when it is absent."""
        if name not in self._values:
            return None
        matrix = self.numbers(name, self._values[name], (4, 4))
        require_rigid(matrix[None], f"{self.path}: {self._prefix}{name}")
        return matrix

    def numbers(self, name: str, value: Any, shape: tuple[int, ...]) -> Tensor:
        try:
            array = torch.tensor(_floats(value), dtype=torch.float64)
        except (TypeError, ValueError):
            raise self.error(name, f"is not a table of numbers: {value!r}") from None
        if array.shape != shape or not array.isfinite().all():
            raise self.error(name, f"must be {' x '.join(map(str, shape))} finite numbers")
        return array


def _floats(value: Any) -> Any:
    return [_floats(item) for item in value] if isinstance(value, list) else float(value)


def read_camera(meta: Metadata, width: str, height: str) -> EventCamera:
    """A camera from Nerfstudio's names for intrinsics."""
    model = meta.get("camera_model", str, "OPENCV")
    if model not in LENS_MODELS:
        raise meta.error("camera_model", f"is {model!r}, not one of {', '.join(LENS_MODELS)}")
    lens, names = LENS_MODELS[model]
    try:
        return EventCamera(
            meta.get(width, int),
            meta.get(height, int),
            fx=meta.get("fl_x", float),
            fy=meta.get("fl_y", float),
            cx=meta.get("cx", float),
            cy=meta.get("cy", float),
            lens_model=lens,
            distortion=tuple(meta.get(name, float, 0.0) for name in names),
        )
    except DataError:
        raise
    except ValueError as error:
        raise meta.error("intrinsics:", str(error)) from None


def read_image_encoding(meta: Metadata) -> ImageEncoding:
    """What the values of the images are; sRGB unless it is stated.

    Raises:
        DataError: it is neither sRGB nor linear.
    """
    encoding: ImageEncoding = meta.get("image_encoding", str, "srgb")
    if encoding not in ("srgb", "linear"):
        raise DataError(meta.path, f'image_encoding is "{encoding}"', 'use "srgb" or "linear"')
    return encoding
