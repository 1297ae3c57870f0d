"""Malformed datasets of every format, and recordings that unpack to far more than they hold: one clear line each, in
little memory and time. A search breaks one value or file of a whole dataset at a time."""

import json
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
import yaml
from helpers.bounded_reading import MAX_SECONDS, refusal
from helpers.dataset_faults import dump_raw, load_raw
from helpers.event_file_checks import EDITS, edited
from helpers.faulty_datasets import FAULTS
from helpers.malformed_inputs import MALFORMED
from helpers.streams import FUZZ_EXAMPLES
from helpers.vendor_recordings import BOMBS, DATASETS, read_dataset
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from aenerf_ns.camera.intrinsics import CameraIntrinsics

CASES = {**FAULTS, **{name: (*case, "", "") for name, case in {**MALFORMED, **BOMBS}.items()}}


@pytest.fixture(scope="module")
def whole() -> Iterator[Path]:
    """A dataset of each kind, in a folder that others than root may read too, with nothing to refuse."""
    pytest.importorskip("rosbags")
    with TemporaryDirectory() as name:
        root = Path(name)
        root.chmod(0o755)
        for kind, write in DATASETS.items():
            write(root / kind)
            # With the rights of root, because numba compiles meanwhile.
            read_dataset(kind, root / kind)
        yield root


@contextmanager
def copy_of(dataset: Path) -> Iterator[Path]:
    """Copy a dataset to a folder that is removed at the end."""
    folder = Path(shutil.copytree(dataset, dataset.parent / "case" / "made"))
    try:
        for path in (folder, *folder.rglob("*")):
            path.chmod(0o777)
        yield folder
    finally:
        shutil.rmtree(folder.parent)


# A warning of a library would print a second line.
@pytest.mark.filterwarnings("error::RuntimeWarning", "error::UserWarning")
@pytest.mark.parametrize("name", sorted(CASES), ids=lambda name: name.replace(" ", "_"))
def test_malformed_dataset_is_one_line(name: str, whole: Path) -> None:
    kind, change, source, problem = CASES[name]
    with copy_of(whole / kind) as folder:
        change(folder)
        message = refusal(lambda: read_dataset(kind, folder))
    assert message
    assert f"{source}: " in message
    assert problem in message
    # The refusal is of the fault, not of what the test takes from the reader.
    assert "unreadable" in name or "Permission denied" not in message
    assert "Cannot allocate memory" not in message


WORDS = ["", ".", "..", "../x", "/etc/passwd", "\0", "a" * 5000, "é\n", "nan", "inf", "-1", "1e999", "{}", "%s"]
NUMBERS = [
    "0", "-0", "1", "-1", "0.5", "64.7", "1e-320", "-1e-30", "1e30", "1e300", "-1e300", "1e400", "1e999999999",
    "1e-999999999", "9" * 18, "9" * 19, "9" * 5000, "-9223372036854775808", "65536", "NaN", "Infinity",
]  # fmt: skip
VALUES = [*NUMBERS, "null", "true", "[]", "{}", '[["x"]]', '{"a": 1}', "[" * 40 + "]" * 40, *map(json.dumps, WORDS)]

Draw = Callable[[st.SearchStrategy], Any]


def places(tree: Any) -> Iterator[tuple[Any, Any]]:
    """Yield each list or object in a tree with each of its keys."""
    keys = tree.keys() if isinstance(tree, dict) else range(len(tree)) if isinstance(tree, list) else ()
    for key in list(keys):
        yield tree, key
        yield from places(tree[key])


def break_tree(draw: Draw, path: Path, load: Callable[[str], Any]) -> None:
    """Replace, drop or repeat one value. JSON is YAML, but for the exponents of numbers."""
    tree = load(path.read_text())
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
    path.write_text(dump_raw(tree))


def break_text(draw: Draw, path: Path) -> None:
    """Break one field or line of a table."""
    lines = path.read_text().splitlines()
    line = draw(st.integers(0, len(lines) - 1))
    fields = lines[line].split()
    way = draw(st.sampled_from(["value"] * 6 + ["drop", "long", "first"]))
    if way == "value" and fields:
        fields[draw(st.integers(0, len(fields) - 1))] = draw(st.sampled_from([*NUMBERS, *WORDS, "x", "0x1", "1_0"]))
    elif way == "drop":
        fields = fields[:-1]
    elif way == "long":
        fields *= 20_000
    lines[line] = " ".join(fields)
    if way == "first":
        lines.insert(0, lines[line])
    path.write_text("\n".join(lines) + "\n")


def break_any(draw: Draw, path: Path) -> None:
    """Break a file as a whole: change its bytes, or put something else in its place."""
    way = draw(st.sampled_from(["bytes"] * 3 + ["missing", "folder", "loop", "locked", "zeros"]))
    if way == "bytes":
        path.write_bytes(edited(path.read_bytes(), draw(EDITS)))
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


BREAKS: dict[str, Callable[[Draw, Path], None]] = {
    ".json": partial(break_tree, load=load_raw),
    ".yaml": partial(break_tree, load=yaml.safe_load),
    ".txt": break_text,
}


def test_broken_datasets_are_read_or_refused(whole: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # The directions of a lens take most of the time.
    monkeypatch.setattr(CameraIntrinsics, "pixel_directions", lru_cache(maxsize=16)(CameraIntrinsics.pixel_directions))

    @settings(max_examples=FUZZ_EXAMPLES, deadline=None, suppress_health_check=list(HealthCheck), database=None)
    @given(st.data())
    def check(data: st.DataObject) -> None:
        kind = data.draw(st.sampled_from(sorted(DATASETS)))
        with copy_of(whole / kind) as made:
            # Of many files of a kind, such as poses, each stands for all.
            files = sorted(path for path in made.rglob("*") if path.is_file())
            kinds = sorted({(path.parent.name, path.suffix) for path in files})
            one = data.draw(st.sampled_from(kinds))
            path = data.draw(st.sampled_from([path for path in files if (path.parent.name, path.suffix) == one]))
            change = BREAKS.get(path.suffix, break_any) if data.draw(st.integers(0, 4)) else break_any
            change(data.draw, path)
            # A large lens alone takes some seconds.
            refusal(lambda: read_dataset(kind, made), 5 * MAX_SECONDS)

    check()
