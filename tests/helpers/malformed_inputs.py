"""Malformed datasets: what is too large, of the wrong kind, not readable, absurd, or leads elsewhere."""

from __future__ import annotations

import pickle
import re
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

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
    truncated,
    without,
    write_bytes,
    write_text,
)
from helpers.published_datasets import WRITERS
from helpers.small_datasets import START, write_ecd, write_native

FORMAT_WRITERS: dict[str, Callable[[Path], object]] = {"aenerf-data": write_native, "ecd-data": write_ecd, **WRITERS}

_NATIVE, _ECD, _ROBUST, _EDS = "aenerf-data", "ecd-data", "robust-enerf-data", "eds-data"
_ESIM, _EVENTNERF, _PAEV3D, _OWN = "enerf-esim-data", "eventnerf-data", "paev3d-data", "event-recording-data"
_H5, _OBJECTS = "events.h5", "Render_info/Bunny/0003.npz"
_VAL_IMAGE, _TRAIN_IMAGE, _PAEV3D_EVENTS = "images/val/00000.png", "images/train/00001.png", "H5_Files/Bunny/event.h5"


def camera(**values: object) -> Change:
    return edit_json("transforms.json", lambda meta: meta["event_camera"].update(values))


def poses(content: str) -> Change:
    return write_text("trajectory_estimated.txt", content)


def calibration(**arrays: object) -> Change:
    return edit_npz("camera_calibration.npz", **arrays)


def robust_poses(**arrays: object) -> Change:
    return edit_npz("camera_poses.npz", **arrays)


def robust_events(**arrays: object) -> Change:
    return edit_npz("raw_events.npz", **arrays)


def view(*keys: object, value: object) -> Change:
    return set_in("views/transforms_val.json", *keys, value=value)


def deflated_zeros(gigabytes: int, beginning: bytes = b"") -> bytes:
    """Zeros behind a beginning, compressed by a factor of 1000."""
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    first = packer.compress(beginning) + packer.flush(zlib.Z_FULL_FLUSH)
    block = packer.compress(bytes(1 << 24)) + packer.flush(zlib.Z_FULL_FLUSH)
    return first + block * (gigabytes << 6) + packer.flush()


def npz_bomb(name: str, array: str) -> Change:
    """A member of 3 GB in 3 MB, as its header says."""

    def change(folder: Path) -> None:
        header = npy_header(f"({3 << 27},)")
        member(name, array, deflated_zeros(3, header))(folder)
        with zipfile.ZipFile(folder / name, "a") as archive:
            # The list at the end of the file counts.
            entry = archive.getinfo(f"{array}.npy")
            entry.compress_type, entry.file_size = zipfile.ZIP_DEFLATED, len(header) + (3 << 30)
            archive.writestr("last", b"")

    return change


def unallocated(name: str, columns: dict[str, str], group: str = "", shape: tuple[int, ...] = (10**12,)) -> Change:
    """Columns of 10^12 rows that were never written."""

    def edit(file: h5py.File) -> None:
        for column, dtype in columns.items():
            key, chunks = f"{group}{column}", (1 << 16, *shape[1:])
            without(file, key).create_dataset(key, shape, dtype, chunks=chunks, compression="gzip")

    return edit_hdf5(name, edit)


def typed_polarities(dtype: np.dtype) -> Change:
    return edit_hdf5(_H5, lambda file: without(file, "p").create_dataset("p", (200,), dtype))


def references(file: h5py.File) -> None:
    without(file, "events/t")["events/t"] = np.array([file.ref], h5py.ref_dtype)


_COLUMNS = {"x": "u2", "y": "u2", "t": "i8", "p": "i1"}


def huge_chunk(file: h5py.File) -> None:
    """One compressed piece of 2 GB."""
    times = file["events/t"][:]
    column = without(file, "events/t").create_dataset(
        "events/t", (200,), "i8", chunks=(1 << 28,), maxshape=(None,), compression="gzip", compression_opts=1
    )
    # No checksum: it is at the end.
    column.id.write_direct_chunk((0,), b"\x78\x9c" + deflated_zeros(2, times.tobytes()))


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


def cut_image(name: str, keep: float, format: str = "PNG") -> Change:
    """The beginning of a picture whose bytes do not compress."""
    noise = np.random.default_rng(0).integers(0, 256, (4, 6, 3)).astype(np.uint8)
    return all_of(lambda folder: Image.fromarray(noise).save(folder / name, format=format), truncated(name, keep))


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
    return member(_OBJECTS, "object_poses", npy_header("(1,)", "'|O'") + stream)


_RECONSTRUCT = b"cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\n"


def nested_pickle() -> bytes:
    value: object = [0]
    for _ in range(12):
        value = [value] * 10
    return pickle.dumps(value, 3)[2:-1]


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


def external_link(name: str) -> Change:
    return lambda folder: put("events.h5", name, h5py.ExternalLink(str(outside_events(folder)), name))(folder)


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
_TOO_MANY_ROWS = npy_header("(10000000000000,)")
BIG, HUGE = int("9" * 400), "RAW:1e999999999"

# Values in transforms.json, by the keys that lead to them: one or two for each way in which values are refused.
_JSON_VALUES: dict[tuple, list] = {
    ("event_camera", "refractory_period_ns"): [BIG, 10**10, 2**63 - 1, HUGE, "RAW:1e30"],
    ("event_camera", "width"): [True, "RAW:" + "9" * 5000],
    ("event_camera", "fl_x"): ["RAW:NaN", "RAW:1e-320"],
    ("event_camera", "cx"): ["RAW:1e300"],
    ("event_camera", "k1"): ["RAW:Infinity", "RAW:-1e10"],
    ("event_camera", "k2"): ["RAW:1e300"],
    ("k1",): ["RAW:-1e10"],
    ("event_camera", "positive_contrast_threshold"): ["RAW:1e-320"],
    ("event_camera", "negative_contrast_threshold"): ["RAW:1e300"],
    ("event_camera", "bayer_pattern"): [1],
    ("event_camera", "file"): [["events.h5"], "a" * 5000, "a\0b", "", "images"],
    ("frames",): [{"a": 1}],
    ("frames", 0): [["a.png"]],
    ("frames", 0, "file_path"): ["a" * 5000, "a\0b"],
    ("frames", 0, "timestamp"): [[1]],
    ("frames", 0, "transform_matrix"): ["RAW:" + "[" * 900 + "]" * 900, [[1], [1, 2]], [["1"] * 4] * 4],
    ("test_filenames",): [[["x.png"]]],
    ("scene_box",): ["wide", [{}, {}], [[-1e300] * 3, [1e300] * 3], [[0, 0, 0], [1, 1, 1e-320]]],
}
_ATTRIBUTES: dict[str, list] = {
    "time_offset": [np.uint64(2**63), [1, 2], h5py.Empty("i8")],
    "time_unit": [["ns", "us"], h5py.Empty("S1"), 3, np.bytes_(b"\xff\xfe")],
}
# What is in place of a column or of a number in an HDF5 file.
_HDF5_VALUES: dict[tuple[str, str, str], list] = {
    (_OWN, "events.h5", "t_offset"): [np.uint64(2**64 - 1), "1", h5py.Empty("i8"), h5py.SoftLink("/t_offset")],
    (_NATIVE, "events.h5", "events/t"): [h5py.SoftLink("/none"), h5py.Empty("i8"), np.int64(3), ["a", "b"]],
    (_OWN, "events.h5", "events/t"): [h5py.Empty("i8")],
    (_PAEV3D, _PAEV3D_EVENTS, "events"): [[["a"] * 4] * 3, 3.0],
}
_UNREADABLE: dict[str, str] = {
    _NATIVE: "transforms.json trajectory_estimated.txt events.h5 images/val/00000.png images/val .",
    _ECD: "events.txt calib.txt",
    _ROBUST: "raw_events.npz views/transforms_val.json",
    _ESIM: "events/2.npy events",
    _EVENTNERF: "train/pose/r_00003.txt train/pose",
    _PAEV3D: _OBJECTS,
    _OWN: "trajectory.txt",
}
_CAMCHAINS = {
    "kalibr sensor": CAM0.replace("[60, 40]", "[1000000, 1000000]"),
    "yaml that multiplies": "a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1]\n"
    + "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 12))
    + CAM0.replace("[60, 40]", "*a11"),
    "yaml of 3 MB": CAM0 + "  rostopic: [" + "1, " * 1_000_000 + "1]\n",
    "kalibr of 400 digits": CAM0.replace("51.0", str(BIG)),
    "kalibr of 5000 digits": CAM0.replace("51.0", "9" * 5000),
    "yaml of depth 5000": CAM0 + "  x: " + "[" * 5000 + "]" * 5000 + "\n",
    "kalibr resolution of 64.7": CAM0.replace("[60, 40]", "[64.7, 40]"),
    "two cameras, none asked for": CAM0 + CAM0.replace("cam0", "cam1"),
    "a camera that is itself": "cam0: &a\n  intrinsics: *a\n",
    "a number for a name": "0: {}\n1: {}\n",
    "an unknown tag": "cam0: !!python/object/apply:os.getcwd []\n",
    "a timestamp that is none": CAM0 + "  x: !!timestamp never\n",
    "a character beyond Unicode": CAM0 + '  x: "\\UFFFFFFFF"\n',
    "a distortion of 1e200": CAM0.replace("[0.0, 0.0, 0.0, 0.0]", "[1.0e+200, 0, 0, 0]"),
    "a date": CAM0.replace("[60, 40]", "2020-01-01"),
    "a key that is a list": "? [a, b]\n: {}\n",
}
_NPY = {
    "bounds of 10^13 rows": npy_header("(10000000000000, 17)", "'<f8'"),
    "npy header of depth 3000": npy_header("(" * 3000 + ")" * 3000),
    "unbalanced header": npy_header("(3, 17", "'<f8'", ""),
    "unknown type": npy_header("(3, 17)", "'<q99'"),
    "type of many fields": npy_header("(3, 17)", "[('a', '<f8', (1000000, 1000000))]"),
    "shape of decimals": npy_header("(3.5, 17)", "'<f8'") + bytes(999),
    "shape of true": npy_header("(True, 17)", "'<f8'") + bytes(999),
    "version 9": b"\x93NUMPY\x09\x00" + bytes(99),
    "header beyond the end": b"\x93NUMPY\x02\x00\xff\xff\xff\x7f",
    "pickle for npy": pickle.dumps([1, 2]),
}
_CHANGES: dict[str, dict[str, Change]] = {
    _NATIVE: {
        "a sensor of 10^6 x 10^6": camera(width=10**6, height=10**6),
        "a sensor of 16000 x 16000": camera(width=16000, height=16000),
        "frames of 10^9 x 10^9": edit_json("transforms.json", lambda meta: meta.update(w=10**9, h=10**9)),
        "HDF5 of 10^12 rows": unallocated("events.h5", _COLUMNS, "events/"),
        "HDF5 piece of 2 GB": edit_hdf5("events.h5", huge_chunk),
        "png of 30000 x 30000 among views": black(_VAL_IMAGE, 30000),
        "png comment of 64 MB": with_chunks(_VAL_IMAGE, text_bomb),
        "json of 8 GB": sparse("transforms.json"),
        "poses of 8 GB": sparse("trajectory_estimated.txt"),
        "timestamp of 1e30 without pose": edit_json(
            "transforms.json", lambda meta: meta["frames"][0].update(timestamp="RAW:1e30", transform_matrix=None)
        ),
        "pose time of 1e30": poses("0 0 0 0 0 0 0 1\n1e30 0 0 0 0 0 0 1\n"),
        "pose at 1e300": poses("1600000000 1e300 0 0 0 0 0 1\n1600000009 0 0 0 0 0 0 1\n"),
        "times that overflow with their unit": all_of(put(_H5, "events/t", np.arange(200) + (1 << 62)), _MILLISECONDS),
        "json of depth 100000": write_text("transforms.json", '{"a":' + "[" * 100_000 + "]" * 100_000 + "}"),
        "text that is not UTF-8": write_bytes("transforms.json", b'{"a": "\xff\xfe"}'),
        "a folder for the poses": folder_for("trajectory_estimated.txt"),
        "a link to itself": link("trajectory_estimated.txt", "trajectory_estimated.txt"),
        "an image that is a link to itself": link(_VAL_IMAGE, "00000.png"),
        "soft links in a circle": _SOFT_LOOP,
        "column that is a group": edit_hdf5("events.h5", lambda f: without(f, "events/t").create_group("events/t")),
        "half a file": truncated("events.h5"),
        "a fisheye no pixel survives": camera(camera_model="OPENCV_FISHEYE", k1="RAW:-1e6", p1=0, k3=0),
        "truncated": cut_image(_VAL_IMAGE, 0.7),
        "TIFF among the train views": saved_as("TIFF", _TRAIN_IMAGE),
        "16 bits": saved_as("PNG", _VAL_IMAGE, mode="I;16"),
        "another size among the train views": saved_as("PNG", _TRAIN_IMAGE, (3, 2)),
        "an animation of 2^32 pictures": with_chunks(_VAL_IMAGE, animation),
        "half of a JPEG": cut_image(_VAL_IMAGE, 0.9, "JPEG"),
        "events": lambda folder: (outside_events(folder), camera(file="../outside.h5")(folder)),
        "image": outside_image(set_in("transforms.json", "frames", 0, "file_path", value="../outside.png")),
        "external link to a group": external_link("events"),
        "external link to a column": external_link("events/t"),
        "external storage": external_storage,
        "virtual column": virtual,
    },
    _ROBUST: {
        "npz of 10^13 rows, stored": member("raw_events.npz", "timestamp", _TOO_MANY_ROWS),
        "npz bomb": npz_bomb("raw_events.npz", "timestamp"),
        "npz text of 10^9 letters": member(
            "camera_calibration.npz", "bayer_pattern", npy_header("()", "'<U1000000000'")
        ),
        "npz of 8 GB": sparse("camera_poses.npz"),
        "robust refractory period of 1e300": calibration(refractory_period=np.float64(1e300)),
        "robust pose times of uint64": robust_poses(T_wc_timestamp=np.arange(21, dtype="u8") + np.uint64(2**64 - 30)),
        "robust angle of 0": view("camera_angle_x", value=0),
        "robust name of bytes": calibration(bayer_pattern=np.array(b"RGGB")),
        "robust objects": calibration(bayer_pattern=np.array({}, dtype=object)),
        "robust complex positions": robust_poses(T_wc_position=np.zeros((21, 3), np.complex128)),
        "robust polarity of text": robust_events(polarity=np.full(200, "on")),
        "robust position of records": robust_events(position=np.zeros(200, [("x", "u2"), ("y", "u2")])),
        "robust file_path of 5000 letters": view("frames", 0, "file_path", value="a" * 5000),
        "robust file_path with a null": view("frames", 0, "file_path", value="a\0b"),
        "unbalanced header in npz": member("raw_events.npz", "timestamp", npy_header("(3", end="")),
        "member with a password": edit_bytes(
            # The flags follow the versions, which differ between versions of Python.
            "camera_poses.npz",
            lambda b: re.sub(b"(PK\1\2.{4})\0", lambda found: found[1] + b"\1", b, flags=re.DOTALL),
        ),
        "no dimensions": robust_events(timestamp=np.int64(3)),
        "a threshold of 1e-320 of robust": calibration(pos_contrast_threshold=np.float64(1e-320)),
        "robust width of 60.5": calibration(img_width=60.5),
        "robust image": outside_image(view("frames", 0, "file_path", value="../../outside"), (50, 30), "RGBA"),
    },
    _OWN: {
        "own sensor": edit_json(
            "calibration.json", lambda meta: meta["event_camera"].update(width=10**6, height=10**6)
        ),
        "calibration of depth 100000": write_text("calibration.json", "[" * 100_000),
        "unreadable camchain": all_of(camchain(CAM0), unreadable("camchain.yaml")),
        "own t_offset that is a group": edit_hdf5(_H5, lambda f: without(f, "t_offset").create_group("t_offset")),
        "own references": edit_hdf5(_H5, references),
        "own listed image": outside_image(write_text("images.txt", "1600000000.05 ../outside.png\n"), (60, 40), "L"),
    },
    _ESIM: {
        "npy of 10^13 rows": write_bytes("events/2.npy", npy_header("(10000000000000, 4)", "'<f8'")),
        "esim width of 64.5": lambda folder: np.save(folder / "poses_bounds.npy", np.full((3, 17), 64.5)),
    },
    _EDS: {
        "HDF5 columns of 10^12 rows": unallocated("events.h5", {**_COLUMNS, "p": "u1"}),
        "eds lists": typed_polarities(h5py.vlen_dtype("i1")),
    },
    _PAEV3D: {
        "HDF5 matrix of 10^12 rows": unallocated(_PAEV3D_EVENTS, {"events": "f8"}, shape=(10**12, 4)),
        "pickle of an array of 10^12": poses_pickle(
            _RECONSTRUCT, b"\x8a\x06" + (10**12).to_bytes(6, "little"), b"\x85C\x01b\x87R"
        ),
        "pickle with memo 2^31": poses_pickle(b"]r\xff\xff\xff\x7f"),
        "pickle of a record of 2 GB": poses_pickle(
            b"cnumpy.core.multiarray\nscalar\ncnumpy\ndtype\n", b"X\x0b\0\0\0V2000000000\x85R\x85R"
        ),
        "pickle of bytes of 2^40": poses_pickle(b"\x96" + (1 << 40).to_bytes(8, "little")),
        "pickle that multiplies": poses_pickle(nested_pickle()),
        "unbalanced header of poses": member(_OBJECTS, "object_poses", npy_header("(3", "'|O'", "")),
        "half an archive of poses": truncated(_OBJECTS),
    },
    _ECD: {
        "png of 30000 x 30000": black("images/0.png", 30000),
        "png of 12000 x 12000": black("images/0.png", 12000),
        "event lines of 8 GB": sparse("events.txt"),
        "pose at 1e200": write_text("groundtruth.txt", "0 1e200 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n"),
        "calibration of 1e300": write_text("calib.txt", "1e300 1e300 2.5 1.5 0 0 0 0 0\n"),
        "event time of 1e30": write_text("events.txt", "0.01 1 2 1\n1e30 1 2 0\n"),
        "a listed image of 5000 letters": write_text("images.txt", f"0.05 {'a' * 5000}\n"),
        "a listed image with a null": write_text("images.txt", "0.05 a\0b\n"),
        "events that are a folder": folder_for("events.txt"),
        "EPS of ECD": saved_as("EPS", "images/0.png"),
        "listed image": outside_image(write_text("images.txt", "0.05 ../outside.png\n"), mode="L"),
    },
    _EVENTNERF: {
        "matrix of 8 GB": sparse("train/pose/r_00003.txt"),
        "eventnerf intrinsics of 1e300": write_text("train/intrinsics/r_00000.txt", "1e300 0 0 0 0 1e300" + " 1" * 10),
    },
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
