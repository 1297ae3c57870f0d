"""JSON files that a struct describes: exact numbers, and one clear line for everything else."""

from pathlib import Path
from typing import Annotated, Literal

import msgspec
import pytest

from aenerf_ns.errors import DataError
from aenerf_ns.files.json_file import Nanoseconds, read_json


class Lens(msgspec.Struct, forbid_unknown_fields=True):
    k1: Annotated[float, msgspec.Meta(le=1)] = 0.0

    def __post_init__(self) -> None:
        if self.k1 == -1:
            raise ValueError("such a lens folds over")


class Camera(msgspec.Struct):
    start_ns: int = 0
    time: Nanoseconds | None = None
    pose: tuple[tuple[float, float], ...] = ()
    model: Literal["pinhole", "fisheye"] = "pinhole"
    lenses: list[Lens] = []
    named: dict[str, Lens] = {}


def read(path: Path, text: str) -> Camera:
    path.write_text(text, "utf8")
    return read_json(path, Camera, "see the manual")


@pytest.mark.parametrize("number", [1_763_945_940_123_456_789, -(2**63 - 1)])
def test_integers_are_exact(tmp_path: Path, number: int) -> None:
    assert read(tmp_path / "file.json", f'{{"start_ns": {number}}}').start_ns == number


@pytest.mark.parametrize(
    ("seconds", "nanoseconds"),
    [("1600000000.123456789", 1_600_000_000_123_456_789), ("2", 2_000_000_000), ("-1e-9", -1), ("1e-999999999", 0)],
)
def test_seconds_are_exact_nanoseconds(tmp_path: Path, seconds: str, nanoseconds: int) -> None:
    assert read(tmp_path / "file.json", f'{{"time": {seconds}}}').time == nanoseconds


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ('{"start_ns": "many"}', "start_ns: expected `int`, got `str` ('many')"),
        ('{"start_ns": 1.5}', "start_ns"),
        ('{"start_ns": true}', "start_ns"),
        ('{"time": "1"}', "time"),
        ('{"time": true}', "time"),
        ('{"time": 1e20}', "time"),
        ('{"pose": [[0, 1], [2, "high"]]}', "pose[1][1]"),
        ('{"pose": [[0, 1], [2]]}', "pose[1]: expected `array` of length 2"),
        ('{"model": "round"}', "model: invalid enum value 'round'"),
        ('{"lenses": [{}, {"k1": 2}]}', "lenses[1].k1: expected `float` <= 1.0 (2)"),
        ('{"lenses": [{"k1": -1}]}', "lenses[0]: such a lens folds over"),
        ('{"lenses": [{"k2": 0}]}', "unknown field `k2`"),
        ('{"named": {"left": {"k1": 2}}}', "named[...].k1"),
        ("[]", "expected `object`"),
        ("", "not valid JSON"),
        ('{"time": 1', "not valid JSON"),
        ('{"time": NaN}', "NaN"),
        ('{"time": 1, "time": 2}', "duplicate key 'time'"),
        (f'{{"start_ns": {2**63}}}', "too large"),
        (f'{{"start_ns": -{"9" * 5000}}}', "too large"),
        ('{"time": 1e999999999999999999999}', "too large"),
        ('{"time": ' + "[" * 100_000, "not valid JSON"),
        *((f'{{"start_ns": {"[" * depth}{"]" * depth}}}', "") for depth in range(950, 1000, 5)),
    ],
    ids=lambda value: value[:20],
)
def test_wrong_values_are_named_in_one_line(tmp_path: Path, text: str, problem: str) -> None:
    with pytest.raises(DataError) as error:
        read(tmp_path / "file.json", text)
    assert error.value.source == tmp_path / "file.json"
    assert problem in error.value.problem
