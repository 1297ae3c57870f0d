"""Read objects in JSON and check their values."""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Sequence
from decimal import Decimal
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from aenerf_ns.camera.image_encoding import ImageEncoding
from aenerf_ns.camera.lens import EventCamera, LensModel
from aenerf_ns.camera.trajectory import require_rigid
from aenerf_ns.errors import DataError

# For each camera model of Nerfstudio: the lens, and the names of its distortion parameters in OpenCV's order.
LENS_MODELS: dict[str, tuple[LensModel, tuple[str, ...]]] = {
    "OPENCV": ("radial_tangential", ("k1", "k2", "p1", "p2", "k3")),
    "OPENCV_FISHEYE": ("fisheye", ("k1", "k2", "k3", "k4")),
}


DATASET_REMEDY = "see the dataset format in the docs"


class JsonObject:
    """A JSON object whose errors name the file, the key and the value.

    Args:
        path: the file.
        values: the object.
        prefix: where the object stands in the file, such as "light.".
        remedy: the remedy in the errors.
    """

    def __init__(self, path: Path, values: dict[str, Any], prefix: str = "", remedy: str = DATASET_REMEDY) -> None:
        self.path = path
        self._values = values
        self._prefix = prefix
        self._remedy = remedy

    @classmethod
    def read(cls, path: Path, remedy: str = DATASET_REMEDY) -> JsonObject:
        """Read the object in a file.

        Raises:
            DataError: the file is missing, is not JSON, or holds something else than an object.
        """
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
            raise DataError(path, "not a JSON object", remedy)
        return cls(path, values, remedy=remedy)

    def __contains__(self, name: str) -> bool:
        return name in self._values

    def error(self, name: str, problem: str, remedy: str | None = None) -> DataError:
        """Return an error about the value of ``name``."""
        return DataError(self.path, f"{self._prefix}{name} {problem}", remedy or self._remedy)

    def refuse_keys_except(self, known: Collection[str]) -> None:
        """Raise a DataError if there is a key that is not known."""
        for name in self._values:
            if name not in known:
                raise DataError(
                    self.path, f"unknown key '{self._prefix}{name}'", f"known keys are {', '.join(sorted(known))}"
                )

    def get(self, name: str, kind: type, *default: Any) -> Any:
        """Return the value of ``name``, converted to ``kind``. The kind float also takes integers.

        Raises:
            DataError: the value has another type, or is missing and there is no default.
        """
        if name not in self._values:
            if default:
                return default[0]
            raise self.error(name, "is missing")
        value = self._values[name]
        accepted = (int, Decimal) if kind is float else kind
        if not isinstance(value, accepted) or isinstance(value, bool):
            raise self.error(name, f"is {_told(value)}, not of type {kind.__name__}")
        return kind(value)

    def holds(self, name: str, kind: type) -> bool:
        """Tell whether there is a value of ``name`` that has this type."""
        return isinstance(self._values.get(name), kind)

    def positive(self, name: str, *default: float) -> float:
        """Return the number ``name``, which must be positive and finite."""
        value = self.get(name, float, *default)
        if not 0 < value < math.inf:
            raise self.error(name, f"is {value:g}", "give a positive number")
        return value

    def choice(self, name: str, known: Sequence[str], *default: str) -> str:
        """Return the text ``name``, which must be one of the known ones."""
        value = self.get(name, str, *default)
        if value not in known:
            raise self.error(name, f'is "{value}"', f"""give {" or ".join(f'"{item}"' for item in known)}""")
        return value

    def block(self, name: str) -> JsonObject:
        """Return the object ``name``."""
        return JsonObject(self.path, self.get(name, dict), f"{self._prefix}{name}.", self._remedy)

    def entry(self, name: str, index: int) -> Any:
        """Return entry ``index`` of the list ``name``."""
        values = self.get(name, list)
        if index >= len(values):
            raise self.error(name, f"has {len(values)} entries, not {index + 1}")
        return values[index]

    def entry_block(self, name: str, index: int) -> JsonObject:
        """Return entry ``index`` of the list ``name``, which must be an object."""
        value = self.entry(name, index)
        if not isinstance(value, dict):
            raise self.error(f"{name}[{index}]", f"is {_told(value)}, not an object")
        return JsonObject(self.path, value, f"{self._prefix}{name}[{index}].", self._remedy)

    def rigid_motion(self, name: str) -> Tensor | None:
        """Return the (4, 4) float64 matrix ``name`` of a rotation and a translation, or None if it is absent."""
        if name not in self._values:
            return None
        matrix = self.numbers(name, self._values[name], (4, 4))
        require_rigid(matrix[None], f"{self.path}: {self._prefix}{name}")
        return matrix

    def numbers(self, name: str, value: Any, shape: tuple[int | None, ...]) -> Tensor:
        """Convert a value to a float64 tensor of a shape; None stands for any length. Errors call the value ``name``.

        Raises:
            DataError: the value has another shape, or an entry is not a finite number.
        """
        try:
            array = torch.tensor(_floats(value), dtype=torch.float64)
        except (TypeError, ValueError):
            raise self.error(name, f"is not a table of numbers: {_told(value)}") from None
        fits = len(array.shape) == len(shape) and all(b in (None, a) for a, b in zip(array.shape, shape, strict=True))
        if not fits or not array.isfinite().all():
            wanted = " x ".join("n" if side is None else str(side) for side in shape)
            raise self.error(name, f"must be {wanted} finite numbers, not {_told(value)}")
        return array


def _floats(value: Any) -> Any:
    return [_floats(item) for item in value] if isinstance(value, list) else float(value)


def _told(value: Any) -> str:
    """Return the text of a value for a message, shortened."""
    text = repr(value) if isinstance(value, str) else json.dumps(value, default=float, ensure_ascii=False)
    return text if len(text) <= 80 else f"{text[:77]}..."


def read_camera(meta: JsonObject, width: str, height: str) -> EventCamera:
    """Read a camera from Nerfstudio's names of intrinsics; ``width`` and ``height`` are the keys of its size."""
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


def read_image_encoding(meta: JsonObject) -> ImageEncoding:
    """Return the encoding of the images' values. The default is sRGB.

    Raises:
        DataError: the encoding is neither sRGB nor linear.
    """
    encoding: ImageEncoding = meta.get("image_encoding", str, "srgb")
    if encoding not in ("srgb", "linear"):
        raise DataError(meta.path, f'image_encoding is "{encoding}"', 'use "srgb" or "linear"')
    return encoding
