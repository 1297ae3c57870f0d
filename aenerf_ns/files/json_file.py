"""Read JSON files whose format is stated by a class.

A format is a :class:`msgspec.Struct`: its fields are the keys, their types are what the values must be, and a
``__post_init__`` that raises a ValueError checks what types cannot say. Keys that the class does not have are ignored,
or refused with ``forbid_unknown_fields=True``. Whatever is wrong with the file is one DataError, such as "lamp.json:
center[2]: expected `float`, got `str` ('high'); see the dataset format in the docs". Values that come from elsewhere,
such as YAML, go through :func:`convert`.
"""

from __future__ import annotations

import json
import re
from decimal import Context, Decimal
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from aenerf_ns.errors import DataError
from aenerf_ns.files.limits import MAX_TIME, read_text

DATASET_REMEDY = "see the dataset format in the docs"

# 50,000 frames of a dataset.
_MAX_BYTES = 1 << 25
# Nanoseconds since 1970 have 19 digits.
_MAX_INTEGER = 2**63 - 1
# float64 holds numbers up to 10^308.
_MAX_EXPONENT = 300
# Without traps, a number that is too large for Decimal is NaN.
_NO_TRAPS = Context(traps=[])

T = TypeVar("T")


class Nanoseconds(int):
    """A time in integer nanoseconds, which the file holds in decimal seconds. float64 would drop its last digits."""


def read_json(path: Path, kind: type[T], remedy: str = DATASET_REMEDY) -> T:
    """Read a JSON file that holds a struct, or any other type (``kind``) that msgspec knows.

    Raises:
        DataError: the file is missing or too large, is not JSON, has a key twice, a number that is too large or not
            finite, or holds something else than ``kind``.
    """
    text = read_text(path, _MAX_BYTES)
    try:
        values = json.loads(
            text,
            parse_float=_parse_decimal,
            parse_int=_parse_integer,
            parse_constant=_parse_decimal,
            object_pairs_hook=_make_object,
        )
    except (ValueError, RecursionError) as error:
        raise DataError(path, f"not valid JSON ({error})", "correct it there") from None
    return convert(path, values, kind, remedy)


def convert(path: Path, values: Any, kind: type[T], remedy: str = DATASET_REMEDY, name: str = "") -> T:
    """Convert lists, dictionaries, texts and numbers to a type.

    Args:
        path: the file that they were read from, for the errors.
        values: what was read. Decimals give floats or, without rounding, nanoseconds.
        kind: a struct, or any other type that msgspec knows.
        remedy: what the errors advise.
        name: the key in the file that ``values`` belongs to, for the errors.

    Raises:
        DataError: a value does not fit the type. The error names its key.
    """
    try:
        return msgspec.convert(values, kind, dec_hook=_convert_other)
    except msgspec.ValidationError as error:
        problem, _, key_path = str(error).partition(" - at `$")
        key_path = key_path.removesuffix("`")
        found = ""
        # The path of a value in a dictionary has "[...]" in place of the key.
        if key_path and "[..." not in key_path:
            value = values
            for key, index in re.findall(r"\.([^.[]+)|\[(\d+)\]", key_path):
                value = value[key or int(index)]
            value = float(value) if isinstance(value, Decimal) else value
            found = f" ({value!r})" if isinstance(value, (str, int, float)) else ""
        key = f"{name}{key_path}".removeprefix(".")
        problem = f"{problem[:1].lower()}{problem[1:]}{found}"
        raise DataError(path, f"{key}: {problem}" if key else problem, remedy) from None


def _convert_other(kind: type, value: Any) -> Any:
    if kind is not Nanoseconds or not isinstance(value, (int, float, Decimal)) or isinstance(value, bool):
        raise TypeError(f"Expected a number, got `{type(value).__name__}`")
    nanoseconds = Decimal(value) * 1_000_000_000
    if not abs(nanoseconds) <= MAX_TIME:
        raise ValueError("out of range for a time in seconds")
    return Nanoseconds(nanoseconds.to_integral_value())


def _parse_decimal(text: str) -> Decimal:
    value = Decimal(text, _NO_TRAPS)
    if not value.is_finite() or value.adjusted() > _MAX_EXPONENT:
        raise ValueError(f"the number {text[:40]} is too large, or not finite")
    return value


def _parse_integer(text: str) -> int:
    # Python refuses to read numbers of thousands of digits with an error of its own.
    if len(text) > 20 or abs(int(text)) > _MAX_INTEGER:
        raise ValueError(f"the number {text[:40]} is too large")
    return int(text)


def _make_object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Refuse a key that stands twice. Python, and msgspec, would silently take the last one."""
    values = dict(pairs)
    if len(values) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"duplicate key {max(names, key=names.count)[:40]!r}")
    return values
