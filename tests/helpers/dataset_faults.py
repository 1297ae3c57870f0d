"""Ways to damage the files of a dataset, and the reading that must then end in one clear line.

A change takes the folder of a dataset. Names of files are relative to it; those of bytes may be patterns.
"""

import json
import re
import shutil
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from PIL import Image

from aenerf_ns.recording.dataset import EventDataset
from aenerf_ns.recording.options import EventDataParserConfig

Change = Callable[[Path], object]


def all_of(*changes: Change) -> Change:
    return lambda folder: [change(folder) for change in changes]


def remove(pattern: str) -> Change:
    return lambda folder: [shutil.rmtree(p) if p.is_dir() else p.unlink() for p in sorted(folder.glob(pattern))]


def write_text(name: str, content: str) -> Change:
    return lambda folder: (folder / name).write_text(content)


def write_bytes(name: str, content: bytes) -> Change:
    return lambda folder: (folder / name).write_bytes(content)


def edit_bytes(pattern: str, edit: Callable[[bytes], bytes]) -> Change:
    """Change the content of the one file that matches a pattern."""

    def change(folder: Path) -> None:
        (path,) = folder.glob(pattern)
        path.write_bytes(edit(path.read_bytes()))

    return change


def sparse(pattern: str, begin: bytes | None = None, end: bytes = b"", gigabytes: float = 8) -> Change:
    """Put zeros, which take no room on the disk, behind a file or behind a beginning."""

    def change(folder: Path) -> None:
        (path,) = folder.glob(pattern)
        with path.open("r+b") as file:
            if begin is not None:
                file.truncate(0)
                file.write(begin)
            # Words and records stay whole.
            file.truncate(file.seek(0, 2) + int(gigabytes * (1 << 30)))
            file.seek(0, 2)
            file.write(end)

    return change


def replace_line(name: str, index: int, line: str) -> Change:
    def change(folder: Path) -> None:
        lines = (folder / name).read_text().splitlines()
        lines[index] = line
        (folder / name).write_text("\n".join(lines) + "\n")

    return change


def load_raw(text: str) -> Any:
    """Parse JSON, with its decimals as texts that begin with "RAW:"."""
    return json.loads(text, parse_float=lambda number: f"RAW:{number}")


def dump_raw(tree: Any) -> str:
    """Format as JSON. What follows "RAW:" in a text is written without quotes."""
    return re.sub(r'"RAW:((?:[^"\\]|\\.)*)"', lambda match: json.loads(f'"{match[1]}"'), json.dumps(tree))


def edit_json(name: str, edit: Callable[[dict], object]) -> Change:
    def change(folder: Path) -> None:
        meta = load_raw((folder / name).read_text())
        edit(meta)
        (folder / name).write_text(dump_raw(meta))

    return change


def set_in(name: str, *keys: Any, value: object) -> Change:
    """Set the value at a path of keys in a JSON file."""

    def edit(meta: Any) -> None:
        for key in keys[:-1]:
            meta = meta[key]
        meta[keys[-1]] = value

    return edit_json(name, edit)


def edit_npz(name: str, **arrays: object) -> Change:
    """Replace arrays of an .npz file, or remove those that are None."""

    def change(folder: Path) -> None:
        with np.load(folder / name) as file:
            content = {**file, **arrays}
        np.savez(folder / name, **{key: value for key, value in content.items() if value is not None})

    return change


def npy_header(shape: str, descr: str = "'<i8'") -> bytes:
    """The beginning of an .npy file that states any shape."""
    text = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}".encode()
    text += b" " * (-(len(text) + 11) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text


def rewrite_zip(path: Path, members: dict[str, bytes], kind: int = zipfile.ZIP_STORED) -> None:
    with zipfile.ZipFile(path, "w", kind) as archive:
        for name, content in members.items():
            archive.writestr(name, content)


def zip_members(path: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def member(name: str, array: str, content: bytes) -> Change:
    """Replace an array of an .npz file by raw bytes."""
    return lambda folder: rewrite_zip(folder / name, {**zip_members(folder / name), f"{array}.npy": content})


def edit_hdf5(name: str, edit: Callable[[h5py.File], object]) -> Change:
    def change(folder: Path) -> None:
        with h5py.File(folder / name, "r+") as file:
            edit(file)

    return change


def without(file: h5py.File, name: str) -> h5py.File:
    if name in file:
        del file[name]
    return file


def put(name: str, key: str, value: object) -> Change:
    """Replace a column, group or link of an HDF5 file, or remove it for None."""
    return edit_hdf5(
        name, lambda file: without(file, key) if value is None else without(file, key).update({key: value})
    )


def set_attribute(name: str, value: object) -> Change:
    return edit_hdf5("events.h5", lambda file: file["events"].attrs.update({name: value}))


def saved_as(format: str, name: str, size: tuple[int, int] = (6, 4), mode: str = "RGB") -> Change:
    return lambda folder: Image.new(mode, size).save(folder / name, format=format)


def read_everything(config: EventDataParserConfig) -> None:
    config.setup().get_dataparser_outputs("val")
    assert len(EventDataset(config.setup().get_dataparser_outputs("train")).pairs)


OTHER_LENS = set_in("transforms.json", "fl_x", value=4.0)
MOUNTED_APART = set_in(
    "transforms.json", "event_camera", "T_frame_event", value=[[1, 0, 0, 0.1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
)
"""Changes of a dataset folder after which its images are of another camera. Cameras of one kind may share a lens."""
