"""Malformed datasets: what is too large, of the wrong kind, unreadable, absurd, or leads elsewhere."""

import os
import struct
import zipfile
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from PIL import Image

from helpers.dataset_faults import (
    Change,
    all_of,
    edit_bytes,
    edit_hdf5,
    edit_json,
    edit_npz,
    member,
    npy_header,
    put,
    remove,
    saved_as,
    set_attribute,
    set_in,
    sparse,
    without,
    write_bytes,
    write_text,
)
from helpers.published_datasets import WRITERS
from helpers.small_datasets import START, write_ecd, write_native

FORMAT_WRITERS: dict[str, Callable[[Path], object]] = {"aenerf-data": write_native, "ecd-data": write_ecd, **WRITERS}

_NATIVE, _ECD, _ROBUST = "aenerf-data", "ecd-data", "robust-enerf-data"
_ESIM, _EVENTNERF, _PAEV3D, _OWN = "enerf-esim-data", "eventnerf-data", "paev3d-data", "event-recording-data"
_H5, OBJECTS = "events.h5", "Render_info/Bunny/0003.npz"
_VAL_IMAGE, _TRAIN_IMAGE, _PAEV3D_EVENTS = "images/val/00000.png", "images/train/00001.png", "H5_Files/Bunny/event.h5"


def camera(**values: object) -> Change:
    return edit_json("transforms.json", lambda meta: meta["event_camera"].update(values))


poses = partial(write_text, "trajectory_estimated.txt")
robust_poses = partial(edit_npz, "camera_poses.npz")
robust_events = partial(edit_npz, "raw_events.npz")


def view(path: str) -> Change:
    return set_in("views/transforms_val.json", "frames", 0, "file_path", value=path)


def npz_bomb(folder: Path) -> None:
    """A member of 3 GB in 3 MB, as its header says."""
    header = npy_header(f"({3 << 27},)")
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    first = packer.compress(header) + packer.flush(zlib.Z_FULL_FLUSH)
    block = packer.compress(bytes(1 << 24)) + packer.flush(zlib.Z_FULL_FLUSH)
    member("raw_events.npz", "timestamp", first + block * (3 << 6) + packer.flush())(folder)
    with zipfile.ZipFile(folder / "raw_events.npz", "a") as archive:
        # The list at the end of the file counts.
        entry = archive.getinfo("timestamp.npy")
        entry.compress_type, entry.file_size = zipfile.ZIP_DEFLATED, len(header) + (3 << 30)
        archive.writestr("last", b"")


def unallocated(name: str, columns: dict[str, Any], group: str = "", shape: tuple[int, ...] = (10**12,)) -> Change:
    """Columns of 10^12 rows that were never written."""

    def edit(file: h5py.File) -> None:
        for column, dtype in columns.items():
            key, chunks = f"{group}{column}", (1 << 16, *shape[1:])
            without(file, key).create_dataset(key, shape, dtype, chunks=chunks, compression="gzip")

    return edit_hdf5(name, edit)


def chunk(kind: bytes, data: bytes) -> bytes:
    """A part of a PNG."""
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def with_chunks(name: str, make_chunks: Callable[[], bytes]) -> Change:
    """Put further parts behind the header of a PNG."""
    return edit_bytes(name, lambda content: content[:33] + make_chunks() + content[33:])


def animation() -> bytes:
    """A claim to be the first of 2^32 pictures. The next picture has no size."""
    return chunk(b"acTL", struct.pack(">II", 2**32 - 1, 0)) + chunk(b"fcTL", bytes(26))


def text_bomb() -> bytes:
    """A comment of 64 MB of zeros."""
    return chunk(b"zTXt", b"Comment\0\0" + zlib.compress(bytes(64 << 20)))


def black(name: str, side: int) -> Change:
    """A square PNG of one bit a pixel."""

    def change(folder: Path) -> None:
        data = zlib.compress(bytes(1 + (side + 7) // 8) * side)
        header = struct.pack(">IIBBBBB", side, side, 1, 0, 0, 0, 0)
        parts = chunk(b"IHDR", header) + chunk(b"IDAT", data) + chunk(b"IEND", b"")
        (folder / name).write_bytes(b"\x89PNG\r\n\x1a\n" + parts)

    return change


def cut_image(folder: Path) -> None:
    """The beginning of a picture whose bytes do not compress."""
    noise = np.random.default_rng(0).integers(0, 256, (4, 6, 3)).astype(np.uint8)
    Image.fromarray(noise).save(folder / _VAL_IMAGE)
    os.truncate(folder / _VAL_IMAGE, int(0.7 * (folder / _VAL_IMAGE).stat().st_size))


def camchain(text: str) -> Change:
    """Kalibr's calibration in place of calibration.json."""
    return all_of(remove("calibration.json"), write_text("camchain.yaml", text))


CAM0 = """cam0:
  camera_model: pinhole
  intrinsics: [50.0, 51.0, 30.0, 20.5]
  distortion_model: radtan
  distortion_coeffs: [0.0, 0.0, 0.0, 0.0]
  resolution: [60, 40]
"""


def poses_pickle(*opcodes: bytes) -> Change:
    """An object_poses that is a pickle of these opcodes."""
    stream = b"\x80\x03" + b"".join(opcodes) + b"."
    return member(OBJECTS, "object_poses", npy_header("(1,)", "'|O'") + stream)


_RECONSTRUCT = b"cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\n"


def unreadable(name: str) -> Change:
    """A file or folder without any rights. The runner gives up those of root."""
    return lambda folder: (folder / name).chmod(0)


def link(name: str, target: str) -> Change:
    return all_of(remove(name), lambda folder: (folder / name).symlink_to(target))


def folder_for(name: str) -> Change:
    return all_of(remove(name), lambda folder: (folder / name).mkdir())


def outside_events(folder: Path) -> Path:
    """Whole events in a file beside the data set."""
    other = folder.parent / "outside.h5"
    other.write_bytes((folder / "events.h5").read_bytes())
    return other


def external_link(folder: Path) -> None:
    put("events.h5", "events/t", h5py.ExternalLink(str(outside_events(folder)), "events/t"))(folder)


def external_storage(folder: Path) -> None:
    raw = folder.parent / "raw.bin"
    raw.write_bytes((np.arange(200) + START).astype("<i8").tobytes())
    with h5py.File(folder / "events.h5", "r+") as file:
        without(file, "events/t").create_dataset("events/t", (200,), "i8", external=[(str(raw), 0, 1600)])


def virtual(folder: Path) -> None:
    layout = h5py.VirtualLayout((200,), "i8")
    layout[:] = h5py.VirtualSource(str(outside_events(folder)), "events/t", (200,))
    with h5py.File(folder / "events.h5", "r+") as file:
        without(file, "events/t").create_virtual_dataset("events/t", layout)


def outside_image(change: Change, size: tuple[int, int] = (6, 4), mode: str = "RGB") -> Change:
    """An image beside the data set, which the change names."""
    return all_of(lambda folder: Image.new(mode, size).save(folder.parent / "outside.png"), change)


_SOFT_LOOP = all_of(
    put("events.h5", "events/t", h5py.SoftLink("/events/t2")), put("events.h5", "events/t2", h5py.SoftLink("/events/t"))
)
_MILLISECONDS = set_attribute("time_unit", "ms")

# Values in transforms.json, by the keys that lead to them: one or two for each way in which values are refused.
_JSON_VALUES: dict[tuple, list] = {
    ("event_camera", "refractory_period_ns"): [10**10, 2**63 - 1],
    ("event_camera", "bandwidth_hz"): [1e-300, 1e300],
    ("event_camera", "cx"): ["RAW:1e300"],
    ("event_camera", "k1"): ["RAW:-1e10"],
    ("event_camera", "k2"): ["RAW:1e300"],
    ("k1",): ["RAW:-1e10"],
    ("event_camera", "negative_contrast_threshold"): ["RAW:1e300"],
    ("event_camera", "file"): ["a" * 5000, "a\0b", "", "images"],
    ("frames", 0, "file_path"): ["a" * 5000],
    ("scene_box",): [[[-1e300] * 3, [1e300] * 3], [[0, 0, 0], [1, 1, 1e-320]]],
}
_ATTRIBUTES: dict[str, list] = {
    "time_offset": [np.uint64(2**63), [1, 2], h5py.Empty("i8")],
    "time_unit": [["ns", "us"], h5py.Empty("S1"), 3, np.bytes_(b"\xff\xfe")],
}
# What is in place of a column or of a number in an HDF5 file.
_HDF5_VALUES: dict[tuple[str, str, str], list] = {
    (_OWN, "events.h5", "t_offset"): [np.uint64(2**64 - 1), h5py.Empty("i8"), h5py.SoftLink("/t_offset")],
    (_NATIVE, "events.h5", "events/t"): [h5py.SoftLink("/none"), h5py.Empty("i8"), np.int64(3), ["a", "b"]],
    (_OWN, "events.h5", "events/t"): [h5py.Empty("i8")],
    (_PAEV3D, _PAEV3D_EVENTS, "events"): [[["a"] * 4] * 3, 3.0],
}
_UNREADABLE: dict[str, str] = {
    _NATIVE: "transforms.json trajectory_estimated.txt events.h5 images/val/00000.png images/val .",
    _ECD: "events.txt",
    _ROBUST: "raw_events.npz",
    _ESIM: "events",
}
_CAMCHAINS = {
    "yaml that multiplies": "a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1]\n"
    + "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 12))
    + CAM0.replace("[60, 40]", "*a11"),
    "yaml of 3 MB": CAM0 + "  rostopic: [" + "1, " * 1_000_000 + "1]\n",
    "kalibr of 400 digits": CAM0.replace("51.0", "9" * 400),
    "kalibr of 5000 digits": CAM0.replace("51.0", "9" * 5000),
    "yaml of depth 5000": CAM0 + "  x: " + "[" * 5000 + "]" * 5000 + "\n",
    "a number for a name": "0: {}\n1: {}\n",
    "an unknown tag": "cam0: !!python/object/apply:os.getcwd []\n",
    "a timestamp that is none": CAM0 + "  x: !!timestamp never\n",
    "a character beyond Unicode": CAM0 + '  x: "\\UFFFFFFFF"\n',
}
_NPY = {
    "bounds of 10^13 rows": npy_header("(10000000000000, 17)", "'<f8'"),
    "npy header of depth 3000": npy_header("(" * 3000 + ")" * 3000),
    "type of many fields": npy_header("(3, 17)", "[('a', '<f8', (1000000, 1000000))]"),
    "shape of true": npy_header("(True, 17)", "'<f8'") + bytes(999),
    "header beyond the end": b"\x93NUMPY\x02\x00\xff\xff\xff\x7f",
}
_CHANGES: dict[str, dict[str, Change]] = {
    _NATIVE: {
        "transforms of 8 GB": sparse("transforms.json"),
        "a sensor of 16000 x 16000": camera(width=16000, height=16000),
        "png of 30000 x 30000 among views": black(_VAL_IMAGE, 30000),
        "png comment of 64 MB": with_chunks(_VAL_IMAGE, text_bomb),
        "an animation of 2^32 pictures": with_chunks(_VAL_IMAGE, animation),
        "poses of 8 GB": sparse("trajectory_estimated.txt"),
        "pose time of 1e30": poses("0 0 0 0 0 0 0 1\n1e30 0 0 0 0 0 0 1\n"),
        "pose at 1e300": poses("1600000000 1e300 0 0 0 0 0 1\n1600000009 0 0 0 0 0 0 1\n"),
        "times that overflow with their unit": all_of(put(_H5, "events/t", np.arange(200) + (1 << 62)), _MILLISECONDS),
        "text that is not UTF-8": write_bytes("transforms.json", b'{"a": "\xff\xfe"}'),
        "a folder for the poses": folder_for("trajectory_estimated.txt"),
        "a link to itself": link("trajectory_estimated.txt", "trajectory_estimated.txt"),
        "an image that is a link to itself": link(_VAL_IMAGE, "00000.png"),
        "soft links in a circle": _SOFT_LOOP,
        "column that is a group": edit_hdf5("events.h5", lambda f: without(f, "events/t").create_group("events/t")),
        "a fisheye no pixel survives": camera(camera_model="OPENCV_FISHEYE", k1="RAW:-1e6", p1=0, k3=0),
        "truncated": cut_image,
        "16 bits": saved_as("PNG", _VAL_IMAGE, mode="I;16"),
        "another size among the train views": saved_as("PNG", _TRAIN_IMAGE, (3, 2)),
        "events": lambda folder: (outside_events(folder), camera(file="../outside.h5")(folder)),
        "image": outside_image(set_in("transforms.json", "frames", 0, "file_path", value="../outside.png")),
        "external link to a column": external_link,
        "external storage": external_storage,
        "virtual column": virtual,
    },
    _ROBUST: {
        "npz bomb": npz_bomb,
        "robust pose times of uint64": robust_poses(T_wc_timestamp=np.arange(21, dtype="u8") + np.uint64(2**64 - 30)),
        "robust complex positions": robust_poses(T_wc_position=np.zeros((21, 3), np.complex128)),
        "robust position of records": robust_events(position=np.zeros(200, [("x", "u2"), ("y", "u2")])),
        "robust file_path of 5000 letters": view("a" * 5000),
        "no dimensions": robust_events(timestamp=np.int64(3)),
        "robust image": outside_image(view("../../outside"), (50, 30), "RGBA"),
    },
    _OWN: {"own t_offset that is a group": edit_hdf5(_H5, lambda f: without(f, "t_offset").create_group("t_offset"))},
    _ESIM: {"width of 64.5": lambda folder: np.save(folder / "poses_bounds.npy", np.full((3, 17), 64.5))},
    _PAEV3D: {
        "HDF5 matrix of 10^12 rows": unallocated(_PAEV3D_EVENTS, {"events": "f8"}, shape=(10**12, 4)),
        "pickle of an array of 10^12": poses_pickle(
            _RECONSTRUCT, b"\x8a\x06" + (10**12).to_bytes(6, "little"), b"\x85C\x01b\x87R"
        ),
        "pickle of a record of 2 GB": poses_pickle(
            b"cnumpy.core.multiarray\nscalar\ncnumpy\ndtype\n", b"X\x0b\0\0\0V2000000000\x85R\x85R"
        ),
    },
    _ECD: {
        "png of 12000 x 12000": black("images/0.png", 12000),
        "event lines of 8 GB": sparse("events.txt"),
        "a listed image of 5000 letters": write_text("images.txt", f"0.05 {'a' * 5000}\n"),
        "events that are a folder": folder_for("events.txt"),
        "listed image": outside_image(write_text("images.txt", "0.05 ../outside.png\n"), mode="L"),
    },
    _EVENTNERF: {"matrix of 8 GB": sparse("train/pose/r_00003.txt")},
}

MALFORMED: dict[str, tuple[str, Change]] = {
    **{
        f"{'.'.join(map(str, keys))} = {str(value)[:40]}": (_NATIVE, set_in("transforms.json", *keys, value=value))
        for keys, values in _JSON_VALUES.items()
        for value in values
    },
    **{
        f"attribute {name} = {value!r}": (_NATIVE, set_attribute(name, value))
        for name, values in _ATTRIBUTES.items()
        for value in values
    },
    **{
        f"{kind} {name} = {str(value)[:40]}": (kind, put(file, name, value))
        for (kind, file, name), values in _HDF5_VALUES.items()
        for value in values
    },
    **{
        f"unreadable {kind} {name}": (kind, unreadable(name))
        for kind, names in _UNREADABLE.items()
        for name in names.split()
    },
    **{f"kalibr: {name}": (_OWN, camchain(text)) for name, text in _CAMCHAINS.items()},
    **{f"npy: {name}": (_ESIM, write_bytes("poses_bounds.npy", content)) for name, content in _NPY.items()},
    **{f"{kind} {name}": (kind, change) for kind, changes in _CHANGES.items() for name, change in changes.items()},
}
"""By a name: the format of a whole dataset, and the change that makes it malformed."""
