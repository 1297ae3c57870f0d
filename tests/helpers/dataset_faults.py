"""Ways to damage the files of a dataset, and the one clear line with which its reader must answer."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np

from aenerf_ns.recording.dataset import EventDataset
from aenerf_ns.recording.options import EventDataParserConfig


def edit_npz(name: str, **arrays: object) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        with np.load(folder / name) as file:
            content = {key: file[key] for key in file.files}
        content.update(arrays)
        np.savez(folder / name, **{key: value for key, value in content.items() if value is not None})

    return change


def edit_json(name: str, edit: Callable[[dict], object]) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        meta = json.loads((folder / name).read_text())
        edit(meta)
        (folder / name).write_text(json.dumps(meta))

    return change


def write_text(name: str, content: str) -> Callable[[Path], object]:
    return lambda folder: (folder / name).write_text(content)


def remove(pattern: str) -> Callable[[Path], object]:
    return lambda folder: [shutil.rmtree(p) if p.is_dir() else p.unlink() for p in sorted(folder.glob(pattern))]


def replace_line(name: str, index: int, line: str) -> Callable[[Path], object]:
    def change(folder: Path) -> None:
        lines = (folder / name).read_text().splitlines()
        lines[index] = line
        (folder / name).write_text("\n".join(lines) + "\n")

    return change


def read_everything(config: EventDataParserConfig) -> None:
    config.setup().get_dataparser_outputs("val")
    assert len(EventDataset(config.setup().get_dataparser_outputs("train")).pairs)
