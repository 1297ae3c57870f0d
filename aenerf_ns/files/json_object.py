"""Read objects in JSON and check their values.

The import of torch takes seconds. So it waits until a matrix or a camera is read.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Sequence
from decimal import Decimal
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from aenerf_ns.errors import DataError, reading
from aenerf_ns.files.limits import file_inside, read_text

if TYPE_CHECKING:
    from torch import Tensor

DATASET_REMEDY = "see the dataset format in the docs"

# 50,000 frames of a dataset.
_MAX_BYTES = 1 << 25
# Matrices in an object in a list in an object have a depth of 5.
_MAX_DEPTH = 16
# The largest whole number: nanoseconds since 1970 have 19 digits.
_MAX_INTEGER = 2**63 - 1
# The largest power of ten of a decimal number: float64 holds 10^308.
_MAX_POWER = 300


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
            DataError: the file is missing or too large, is not JSON, holds something else than an object, is nested too
                deeply, or holds a number that is too large.
        """
        with reading(path):
            if not path.is_file():
                raise DataError(
                    path,
                    "there is no such file",
                    "give a dataset folder as --data, or name its format after the options",
                )
        text = read_text(path, _MAX_BYTES)
        try:
            values = json.loads(
                text, parse_float=_decimal, parse_int=_integer, parse_constant=_no_number, object_pairs_hook=_object
            )
        except (ValueError, RecursionError) as error:
            raise DataError(path, f"not valid JSON ({error})", "correct it there") from None
        if not isinstance(values, dict):
            raise DataError(path, "not a JSON object", remedy)
        require_shallow(path, values)
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
        if not isinstance(value, accepted) or (isinstance(value, bool) and kind is not bool):
            raise self.error(name, f"is {_told(value)}, not of type {kind.__name__}")
        return kind(value)

    def file(self, name: str) -> Path:
        """Return the path of the file that ``name`` names, which lies in the folder of this file."""
        return file_inside(self.path.parent, self.get(name, str), self.path)

    def holds(self, name: str, kind: type) -> bool:
        """Tell whether there is a value of ``name`` that has this type."""
        return isinstance(self._values.get(name), kind)

    def number(self, name: str, low: float, high: float, *default: float) -> float:
        """Return the number ``name``, which must be from the lower bound to the higher one."""
        value = self.get(name, float, *default)
        if not low <= value <= high:
            raise self.error(name, f"is {value:g}", f"give a number from {low:g} to {high:g}")
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

    def numbers(self, name: str, value: Any, shape: tuple[int | None, ...]) -> Tensor:
        """Convert a value to a float64 tensor of a shape; None stands for any length. Errors call the value ``name``.

        Raises:
            DataError: the value has another shape, or an entry is not a finite number.
        """
        import torch

        try:
            array = torch.tensor(_floats(value), dtype=torch.float64)
        except (TypeError, ValueError, OverflowError):
            raise self.error(name, f"is not a table of numbers: {_told(value)}") from None
        fits = len(array.shape) == len(shape) and all(b in (None, a) for a, b in zip(array.shape, shape, strict=True))
        if not fits or not array.isfinite().all():
            wanted = " x ".join("n" if side is None else str(side) for side in shape)
            raise self.error(name, f"must be {wanted} finite numbers, not {_told(value)}")
        return array


def _decimal(text: str) -> Decimal:
    """Keep every digit: float would drop nanoseconds of the Unix time.

    Raises:
        ValueError: float64 could not hold the number.
    """
    try:
        value = Decimal(text)
    except ArithmeticError:
        value = None
    if value is None or value.adjusted() > _MAX_POWER:
        raise ValueError(f"the number {text[:40]} is too large")
    return value


def _integer(text: str) -> int:
    # Python refuses to read numbers of thousands of digits with an error of its own.
    if len(text) > 20 or abs(int(text)) > _MAX_INTEGER:
        raise ValueError(f"the number {text[:40]} is too large")
    return int(text)


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Refuse a key that stands twice. Python would silently take the last one."""
    values = dict(pairs)
    if len(values) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"the key {max(names, key=names.count)[:40]!r} stands there twice")
    return values


def _no_number(text: str) -> NoReturn:
    raise ValueError(f"{text} is no number of JSON")


def require_shallow(path: Path, values: Any) -> None:
    """Raise a DataError for lists and objects in one another beyond the depth of 16, which no dataset has."""
    level = [values]
    for _ in range(_MAX_DEPTH):
        level = [
            item
            for value in level
            if isinstance(value, (dict, list))
            for item in (value.values() if isinstance(value, dict) else value)
        ]
    if any(isinstance(value, (dict, list)) for value in level):
        raise DataError(path, f"its lists and objects are nested more than {_MAX_DEPTH} deep", "correct it there")


def _floats(value: Any) -> Any:
    return [_floats(item) for item in value] if isinstance(value, list) else float(value)


def _told(value: Any) -> str:
    """Return the text of a value for a message, shortened."""
    text = repr(value) if isinstance(value, str) else json.dumps(value, default=_number_or_text, ensure_ascii=False)
    return text if len(text) <= 80 else f"{text[:77]}..."


def _number_or_text(value: Any) -> float | str:
    return float(value) if isinstance(value, Decimal) else str(value)
