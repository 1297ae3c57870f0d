"""Whole data sets in which one value, type, size or link is broken at a time: read, or refused in one line."""

from __future__ import annotations

import json
import os
import shutil
import zipfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import yaml
from helpers.bounded_reading import read_whole, readable_folder, refusal
from helpers.dataset_faults import dump_raw, load_raw, npy_header, rewrite_zip, zip_members
from helpers.event_file_checks import EDITS, edited
from helpers.malformed_inputs import camchain
from helpers.published_datasets import CAMCHAIN
from helpers.streams import FUZZ_EXAMPLES
from helpers.vendor_recordings import DATASETS, read_dataset
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from aenerf_ns.camera.intrinsics import CameraIntrinsics

# Seconds that reading one data set may take: a large lens alone takes some.
MAX_SECONDS = 10.0

WORDS = [
    "", ".", "..", "../x", "/", "/etc/passwd",
    "\0", "a" * 300, "a" * 5000, "é\n", "nan", "inf", "-1", "1e999", "{}", "%s",
]  # fmt: skip
NUMBERS = [
    "0", "-0", "1", "-1", "0.5", "64.7", "1e-320", "-1e-30", "1e30", "1e300", "-1e300", "1e308", "1e400", "1e999999999",
    "1e-999999999", "9" * 18, "9" * 19, "9" * 400, "9" * 5000, "-9223372036854775808", "65535", "65536",
    "NaN", "Infinity",
]  # fmt: skip
VALUES = [
    *NUMBERS, "null", "true", "[]", "{}", "[[]]", "[1, [2, [3]]]", '"x"', '[["x"]]', '{"a": 1}', "[" * 40 + "]" * 40,
    *map(json.dumps, WORDS),
]  # fmt: skip
DTYPES = ["i1", "u1", "u2", "i4", "i8", "u8", "f2", "f4", "f8", "?", "S3", "c16", "U2", "m8[ns]"]
EXTREMES = [0, 1, -1, 2, 255, 256, 65535, 2**31, 2**53, 2**62, 2**63 - 1, -(2**63), 1e-320, 1e30, 1e300, np.inf, np.nan]

Draw = Callable[[st.SearchStrategy], Any]


def places(tree: Any) -> Iterator[tuple[Any, Any]]:
    """Yield each list or object in a tree with each of its keys."""
    keys = tree.keys() if isinstance(tree, dict) else range(len(tree)) if isinstance(tree, list) else ()
    for key in list(keys):
        yield tree, key
        yield from places(tree[key])


def break_tree(draw: Draw, tree: Any) -> Any:
    """Replace, drop or repeat one value in a tree. Numbers stay texts that :func:`dump_raw` writes without quotes."""
    parent, key = draw(st.sampled_from(list(places(tree))))
    way = draw(st.sampled_from(["replace"] * 6 + ["drop", "repeat", "swap"]))
    if way == "replace":
        parent[key] = f"RAW:{draw(st.sampled_from(VALUES))}"
    elif way == "drop":
        del parent[key]
    elif way == "repeat" and isinstance(parent, list):
        parent.insert(key, parent[key])
    else:
        parent[key] = {"a": parent[key]} if way == "swap" else [parent[key]]
    return tree


def break_json(draw: Draw, path: Path) -> None:
    path.write_text(dump_raw(break_tree(draw, load_raw(path.read_text()))))


def break_yaml(draw: Draw, path: Path) -> None:
    # JSON is YAML, but for the exponents of numbers.
    path.write_text(dump_raw(break_tree(draw, yaml.safe_load(path.read_text()))))


def break_text(draw: Draw, path: Path) -> None:
    """Break one field or line of a table."""
    lines = path.read_text().splitlines()
    line = draw(st.integers(0, len(lines) - 1))
    fields = lines[line].split()
    way = draw(st.sampled_from(["value"] * 6 + ["drop", "repeat", "swap", "join", "long"]))
    if way == "value" and fields:
        fields[draw(st.integers(0, len(fields) - 1))] = draw(st.sampled_from([*NUMBERS, *WORDS, "x", "0x1", "1_0"]))
    elif way == "drop":
        fields = fields[:-1]
    elif way == "long":
        fields *= 20_000
    lines[line] = " ".join(fields)
    if way in ("repeat", "swap"):
        lines.insert(0 if way == "swap" else line, lines[line])
    path.write_text((" " if way == "join" else "\n").join(lines) + "\n")


def broken_array(draw: Draw, values: np.ndarray) -> np.ndarray:
    """Change one value, the type, the length or the shape of an array."""
    way = draw(st.sampled_from(["value"] * 3 + ["type", "shorter", "flat", "deeper", "scalar", "reversed", "records"]))
    flat = values.ravel()
    with np.errstate(all="ignore"):
        if way == "value" and values.size and values.dtype.kind in "iuf":
            flat = values.flatten()
            flat[draw(st.integers(0, values.size - 1))] = np.float64(draw(st.sampled_from(EXTREMES))).astype(flat.dtype)
            return flat.reshape(values.shape)
        if way == "type":
            with suppress(TypeError, ValueError):
                return values.astype(draw(st.sampled_from(DTYPES)))
    changes = {
        "records": np.zeros(values.shape[:1], [("x", "u2"), ("t", "i8"), ("s", "S2")]),
        "shorter": values[:-1] if values.ndim else values,
        "flat": flat,
        "deeper": values[..., None],
        "scalar": flat[0] if values.size else values,
        "reversed": values[::-1] if values.ndim else values,
    }
    return np.asarray(changes.get(way, values))


HEADER_SHAPES = [
    "(3,)", "()", "(10000000000000,)", "(-1,)", "(3", "(3.5,)", "(2, 4)", f"({2**70},)", "(True,)", "3", "None",
]  # fmt: skip
HEADER_TYPES = ["'<i8'", "'|O'", "'<f8'", "'<U1000000000'", "'<q99'", "[('a', '<i8', (9, 9))]", "'<f8", "0"]


def broken_npy(draw: Draw, content: bytes) -> bytes:
    """Break the array, the header or the bytes of an .npy file."""
    way = draw(st.sampled_from(["array"] * 4 + ["header", "bytes"]))
    if way == "array" and b"|O" not in content[:128]:
        stream = BytesIO()
        np.save(stream, broken_array(draw, np.load(BytesIO(content))))
        return stream.getvalue()
    if way == "header":
        shape, kind = draw(st.sampled_from(HEADER_SHAPES)), draw(st.sampled_from(HEADER_TYPES))
        return npy_header(shape, kind, draw(st.sampled_from([", }", "", "}", ", 'x': 1}"]))) + content[128:]
    return edited(content, draw(EDITS))


def break_npy(draw: Draw, path: Path) -> None:
    path.write_bytes(broken_npy(draw, path.read_bytes()))


def break_npz(draw: Draw, path: Path) -> None:
    members = zip_members(path)
    name = draw(st.sampled_from(sorted(members)))
    if draw(st.integers(0, 5)) == 0:
        del members[name]
    else:
        members[name] = broken_npy(draw, members[name])
    kind = draw(st.sampled_from([zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA]))
    rewrite_zip(path, members, kind)


def break_hdf5(draw: Draw, path: Path) -> None:
    """Break one column, group, attribute or link of an HDF5 file."""
    with h5py.File(path, "r+") as file:
        names: list[str] = []
        file.visit(names.append)
        name = draw(st.sampled_from(names))
        item = file[name]
        way = draw(
            st.sampled_from(["array"] * 4 + ["link", "attribute", "empty", "huge", "group", "type", "drop", "text"])
        )
        values = item[()] if isinstance(item, h5py.Dataset) else None
        others = {"empty": h5py.Empty("i8"), "type": np.dtype("i8"), "text": ["a", "b"]}
        if way == "attribute":
            key = draw(st.sampled_from(["time_unit", "time_offset"]))
            value: Any = draw(
                st.sampled_from([0, 0.5, 2**62, -(2**63), "us", b"\xff", [1, 2], ["ns"], h5py.Empty("i8"), "x"])
            )
            (item if isinstance(item, h5py.Group) else item.parent).attrs[key] = value
            return
        del file[name]
        if way == "array" and values is not None:
            array = broken_array(draw, np.asarray(values))
            file[name] = array.astype("S") if array.dtype.kind == "U" else array if array.dtype.kind != "m" else 3
        elif way == "link":
            outside = [(str(path.parent / "none.h5"), "/"), (str(path), f"/{name}")]
            targets = [h5py.SoftLink(target) for target in (f"/{name}", "/none", "/", "..")]
            targets += [h5py.ExternalLink(*target) for target in outside]
            file[name] = targets[draw(st.integers(0, len(targets) - 1))]
        elif way == "huge":
            shape = draw(st.sampled_from([(10**12,), (10**12, 4), (4, 10**9), (200, 10**6)]))
            file.create_dataset(name, shape, draw(st.sampled_from(["i8", "u2", "f8"])), chunks=(1,) * len(shape))
        elif way == "group":
            file.create_group(name)
        elif way in others:
            file[name] = others[way]


def break_any(draw: Draw, path: Path) -> None:
    """Break a file as a whole: change its bytes, or put something else in its place."""
    way = draw(st.sampled_from(["bytes"] * 3 + ["missing", "folder", "loop", "locked", "zeros"]))
    if way == "bytes":
        break_bytes(draw, path)
    elif way == "locked":
        path.chmod(0)
    elif way == "zeros":
        os.truncate(path, 4 << 30)
    else:
        path.unlink()
        if way == "folder":
            path.mkdir()
        elif way == "loop":
            path.symlink_to(path.name)


def break_bytes(draw: Draw, path: Path) -> None:
    path.write_bytes(edited(path.read_bytes(), draw(EDITS)))


BREAKS = {
    ".json": break_json, ".yaml": break_yaml, ".txt": break_text,
    ".npy": break_npy, ".npz": break_npz, ".h5": break_hdf5,
    **dict.fromkeys((".raw", ".dat", ".aedat4", ".bag", ".db3", ".mcap", ".bin"), break_bytes),
}  # fmt: skip
WRITERS: dict[str, Callable[[Path], object]] = {
    **DATASETS,
    "camchain": lambda folder: (
        DATASETS["event-recording-data"](folder),
        camchain(yaml.dump({"cam0": {**CAMCHAIN["cam1"], "T_cn_cnm1": np.eye(4).tolist()}}))(folder),
    ),
}


def read(name: str, folder: Path) -> None:
    read_dataset("event-recording-data" if name == "camchain" else name, folder)


def search(folder: Path, **options: Any) -> int:
    """Break data sets, as many as the options of hypothesis say, and return their number."""
    for name, write in WRITERS.items():
        write(folder / name)
        read_whole(lambda name=name: read(name, folder / name))
    count = 0

    @settings(**options, deadline=None, suppress_health_check=list(HealthCheck), database=None)
    @given(st.data())
    def check(data: st.DataObject) -> None:
        nonlocal count
        count += 1
        name = data.draw(st.sampled_from(sorted(WRITERS)))
        made = folder / "case"
        shutil.rmtree(made, ignore_errors=True)
        shutil.copytree(folder / name, made)
        for path in (made, *made.rglob("*")):
            path.chmod(0o777)
        # Of many files of a kind, such as poses, each stands for all.
        files = sorted(path for path in made.rglob("*") if path.is_file())
        kinds = sorted({(path.parent.name, path.suffix) for path in files})
        kind = data.draw(st.sampled_from(kinds))
        path = data.draw(st.sampled_from([path for path in files if (path.parent.name, path.suffix) == kind]))
        change = BREAKS.get(path.suffix, break_any) if data.draw(st.integers(0, 4)) else break_any
        change(data.draw, path)
        refusal(lambda: read(name, made), MAX_SECONDS)

    check()
    return count


@pytest.fixture(autouse=True)
def lenses_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compute the directions of each lens once: they take most of the time."""
    monkeypatch.setattr(CameraIntrinsics, "pixel_directions", lru_cache(maxsize=16)(CameraIntrinsics.pixel_directions))


@pytest.mark.parametrize(
    "options",
    [
        pytest.param({"max_examples": FUZZ_EXAMPLES}, id="some"),
        pytest.param({"max_examples": 200 * FUZZ_EXAMPLES, "derandomize": False}, id="many", marks=pytest.mark.slow),
    ],
)
def test_broken_datasets_are_read_or_refused(options: dict[str, Any]) -> None:
    with readable_folder() as folder:
        count = search(folder, **options)
        print(f"{count:,} data sets")
        assert count >= options["max_examples"]
