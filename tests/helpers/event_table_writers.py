"""Write events in the layouts of other projects."""

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

WIDTH, HEIGHT, N = 60, 40, 300
Columns = dict[str, np.ndarray]


def made_columns() -> Columns:
    """x, y, t in microseconds since 1970, p in {0, 1}."""
    rng = np.random.default_rng(0)
    return {
        "x": rng.integers(0, WIDTH, N).astype(np.uint16),
        "y": rng.integers(0, HEIGHT, N).astype(np.uint16),
        "t": 1_600_000_000_000_000 + np.sort(rng.integers(0, 5_000_000, N)),
        "p": rng.integers(0, 2, N).astype(np.uint8),
    }


def write_dsec(path: Path, columns: Columns) -> None:
    offset = int(columns["t"][0]) - 7
    with h5py.File(path, "w") as file:
        for name, values in columns.items():
            values = (values - offset).astype(np.uint32) if name == "t" else values
            file[f"events/{name}"] = values
        file["ms_to_idx"] = np.zeros(3, np.uint64)
        file["t_offset"] = offset


def write_tum_vie(path: Path, columns: Columns) -> None:
    hdf5plugin = pytest.importorskip("hdf5plugin", reason="the extra hdf5-filters is not installed")
    with h5py.File(path, "w") as file:
        for name, values in columns.items():
            file.create_dataset(f"events/{name}", data=values, chunks=(64,), **hdf5plugin.Blosc())
        file["ms_to_idx"] = np.zeros(3, np.uint64)


def write_eds(path: Path, columns: Columns) -> None:
    with h5py.File(path, "w") as file:
        for name, values in columns.items():
            file[name] = values


def write_paev3d(path: Path, columns: Columns) -> None:
    with h5py.File(path, "w") as file:
        file["events"] = np.stack([columns[name] for name in "txyp"], 1).astype(np.float64)


def records(columns: Columns) -> np.ndarray:
    table = np.zeros(N, dtype=[("x", np.uint16), ("y", np.uint16), ("p", np.int16), ("t", np.int64)])
    for name, values in columns.items():
        table[name] = values
    return table


def write_prophesee(path: Path, columns: Columns) -> None:
    with h5py.File(path, "w") as file:
        file["CD/events"] = records(columns)


def write_robust_enerf(path: Path, columns: Columns) -> None:
    position = np.stack([columns["x"], columns["y"]], 1)
    np.savez(path, position=position, timestamp=columns["t"] * 1_000, polarity=columns["p"].astype(bool))


def signed(columns: Columns) -> Columns:
    return {**columns, "p": 2 * columns["p"].astype(np.int8) - 1}


def write_csv(path: Path, columns: Columns) -> None:
    order = ("t", "p", "x", "y")
    rows = zip(*(columns[name].tolist() for name in order), strict=True)
    path.write_text("# made\n" + "\n".join(", ".join(map(str, row)) for row in [order, *rows]) + "\n")


def write_text(path: Path, columns: Columns, line: str) -> None:
    rows = zip(*(columns[name].tolist() for name in "xytp"), strict=True)
    text = "".join(line.format(x=x, y=y, t=t, s=t // 10**6, us=t % 10**6, p=p) for x, y, t, p in rows)
    path.write_bytes(f"# made\n{text}".encode())


def replaced(name: str, values: np.ndarray | None) -> Callable[[Path], None]:
    def write(path: Path) -> None:
        columns = made_columns()
        if values is None:
            del columns[name]
        else:
            columns[name] = values
        if path.suffix == ".h5":
            write_eds(path, columns)
        else:
            np.savez(path, **columns)

    return write


T, ZEROS = made_columns()["t"], np.zeros(N, np.int64)
