"""Malformed data sets by class: what is too large, of the wrong kind, not readable, absurd, or leads elsewhere."""

from __future__ import annotations

import json
import pickle
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
from PIL import Image

from helpers.dataset_faults import edit_json, edit_npz, remove, write_text
from helpers.published_datasets import WRITERS
from helpers.small_datasets import START, set_attribute, write_ecd, write_native

Change = Callable[[Path], object]

FORMAT_WRITERS: dict[str, Callable[[Path], object]] = {
    "aenerf-data": write_native,
    "ecd-data": write_ecd,
    **WRITERS,
}

_NATIVE, _ECD, _ROBUST, _EDS = "aenerf-data", "ecd-data", "robust-enerf-data", "eds-data"
_ESIM, _EVENTNERF, _PAEV3D, _OWN = "enerf-esim-data", "eventnerf-data", "paev3d-data", "event-recording-data"


def set_in(name: str, *keys: object, value: object) -> Change:
    """Set the value at a path of keys in a JSON file. A text that begins with "RAW:" is written without quotes."""

    def change(folder: Path) -> None:
        meta = json.loads((folder / name).read_text(), parse_float=lambda text: f"RAW:{text}")
        place = meta
        for key in keys[:-1]:
            place = place[key]
        place[keys[-1]] = value
        text = json.dumps(meta)
        while '"RAW:' in text:
            before, _, after = text.partition('"RAW:')
            raw, _, after = after.partition('"')
            text = before + raw + after
        (folder / name).write_text(text)

    return change


def native(*keys: object, value: object) -> Change:
    return set_in("transforms.json", *keys, value=value)


def camera(key: str, value: object) -> Change:
    return native("event_camera", key, value=value)


def all_of(*changes: Change) -> Change:
    return lambda folder: [change(folder) for change in changes]


def hdf5(name: str, edit: Callable[[h5py.File], object]) -> Change:
    def change(folder: Path) -> None:
        with h5py.File(folder / name, "r+") as file:
            edit(file)

    return change


def without(file: h5py.File, name: str) -> h5py.File:
    del file[name]
    return file


def npy_header(shape: str, descr: str = "'<i8'", end: str = ", }") -> bytes:
    """The beginning of an .npy file that states any shape."""
    text = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}{end}".encode()
    text += b" " * (-(len(text) + 11) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text


def write_bytes(name: str, content: bytes) -> Change:
    return lambda folder: (folder / name).write_bytes(content)


def member(name: str, array: str, content: bytes, compressed: bool = False) -> Change:
    """Replace an array of an .npz file by raw bytes."""

    def change(folder: Path) -> None:
        with zipfile.ZipFile(folder / name) as archive:
            others = {entry: archive.read(entry) for entry in archive.namelist()}
        others[f"{array}.npy"] = content
        kind = zipfile.ZIP_DEFLATED if compressed else zipfile.ZIP_STORED
        with zipfile.ZipFile(folder / name, "w", kind) as archive:
            for entry, data in others.items():
                archive.writestr(entry, data)

    return change


def deflated_zeros(gigabytes: int) -> bytes:
    """Zeros, compressed by a factor of 1000."""
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    block = packer.compress(bytes(1 << 24)) + packer.flush(zlib.Z_FULL_FLUSH)
    return block * (gigabytes << 6) + packer.flush()


def npz_bomb(name: str, array: str) -> Change:
    """A member of 3 GB in 3 MB, as its header says."""

    def change(folder: Path) -> None:
        packer = zlib.compressobj(9, zlib.DEFLATED, -15)
        header = npy_header(f"({3 << 27},)")
        content = packer.compress(header) + packer.flush(zlib.Z_FULL_FLUSH) + deflated_zeros(3)
        member(name, array, content)(folder)
        with zipfile.ZipFile(folder / name, "a") as archive:
            # The list at the end of the file counts.
            entry = archive.getinfo(f"{array}.npy")
            entry.compress_type, entry.file_size = zipfile.ZIP_DEFLATED, len(header) + (3 << 30)
            archive.writestr("last", b"")

    return change


def sparse(name: str, gigabytes: int = 8) -> Change:
    """A file of so many zeros that take no room on the disk."""

    def change(folder: Path) -> None:
        with (folder / name).open("r+b") as file:
            file.truncate(gigabytes << 30)

    return change


def unallocated(name: str, columns: dict[str, str], group: str = "", shape: tuple[int, ...] = (10**12,)) -> Change:
    """Columns of 10^12 rows that were never written."""

    def edit(file: h5py.File) -> None:
        for column, dtype in columns.items():
            if f"{group}{column}" in file:
                del file[f"{group}{column}"]
            file.create_dataset(f"{group}{column}", shape, dtype, chunks=(1 << 16, *shape[1:]), compression="gzip")

    return hdf5(name, edit)


_COLUMNS = {"x": "u2", "y": "u2", "t": "i8", "p": "i1"}


def huge_chunk(folder: Path) -> None:
    """One compressed piece of 2 GB."""
    with h5py.File(folder / "events.h5", "r+") as file:
        times = file["events/t"][:]
        del file["events/t"]
        column = file.create_dataset(
            "events/t", (200,), "i8", chunks=(1 << 28,), maxshape=(None,), compression="gzip", compression_opts=1
        )
        zeros = deflated_zeros(2)
        packer = zlib.compressobj(9, zlib.DEFLATED, -15)
        first = packer.compress(times.tobytes()) + packer.flush(zlib.Z_FULL_FLUSH)
        # No checksum: it is at the end.
        column.id.write_direct_chunk((0,), b"\x78\x9c" + first + zeros)


def chunk(kind: bytes, data: bytes) -> bytes:
    """A part of a PNG."""
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def animation(name: str) -> Change:
    """A picture that claims to be the first of 2^32 frames. The next frame has no size."""

    def change(folder: Path) -> None:
        content = (folder / name).read_bytes()
        parts = chunk(b"acTL", struct.pack(">II", 2**32 - 1, 0)) + chunk(b"fcTL", bytes(26))
        (folder / name).write_bytes(content[:33] + parts + content[33:])

    return change


def png(width: int, height: int) -> bytes:
    """A black picture of one bit a pixel."""
    packer = zlib.compressobj(9)
    row = bytes(1 + (width + 7) // 8)
    data = b"".join(packer.compress(row) for _ in range(height)) + packer.flush()
    header = struct.pack(">IIBBBBB", width, height, 1, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def saved_as(format: str, name: str, size: tuple[int, int] = (6, 4), mode: str = "RGB") -> Change:
    def change(folder: Path) -> None:
        Image.new(mode, size).save(folder / name, format=format)

    return change


def truncated(name: str, keep: float = 0.5) -> Change:
    def change(folder: Path) -> None:
        content = (folder / name).read_bytes()
        (folder / name).write_bytes(content[: int(len(content) * keep)])

    return change


def noisy_image(name: str, size: tuple[int, int]) -> Change:
    """A picture whose bytes do not compress, cut in the middle."""

    def change(folder: Path) -> None:
        values = np.random.default_rng(0).integers(0, 256, (size[1], size[0], 3)).astype(np.uint8)
        Image.fromarray(values).save(folder / name)
        truncated(name, 0.7)(folder)

    return change


def text_bomb(name: str, size: tuple[int, int]) -> Change:
    """A PNG whose comment is 64 MB of zeros."""

    def change(folder: Path) -> None:
        Image.new("RGB", size).save(folder / name)
        content = (folder / name).read_bytes()
        data = b"Comment\0\0" + zlib.compress(bytes(64 << 20))
        chunk = struct.pack(">I", len(data)) + b"zTXt" + data + struct.pack(">I", zlib.crc32(b"zTXt" + data))
        (folder / name).write_bytes(content[:33] + chunk + content[33:])

    return change


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
    return member("Render_info/Bunny/0003.npz", "object_poses", npy_header("(1,)", "'|O'") + stream)


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
    def change(folder: Path) -> None:
        (folder / name).unlink(missing_ok=True)
        (folder / name).symlink_to(target)

    return change


def outside_events(folder: Path) -> Path:
    """Whole events in a file beside the data set."""
    other = folder.parent / "outside.h5"
    other.write_bytes((folder / "events.h5").read_bytes())
    return other


def external_link(group: bool) -> Change:
    def change(folder: Path) -> None:
        other = outside_events(folder)
        with h5py.File(folder / "events.h5", "r+") as file:
            name = "events" if group else "events/t"
            del file[name]
            file[name] = h5py.ExternalLink(str(other), name)

    return change


def external_storage(folder: Path) -> None:
    (folder.parent / "raw.bin").write_bytes(np.sort(np.arange(200) + START).astype("<i8").tobytes())
    with h5py.File(folder / "events.h5", "r+") as file:
        del file["events/t"]
        file.create_dataset("events/t", (200,), "i8", external=[(str(folder.parent / "raw.bin"), 0, 1600)])


def virtual(folder: Path) -> None:
    other = outside_events(folder)
    layout = h5py.VirtualLayout((200,), "i8")
    layout[:] = h5py.VirtualSource(str(other), "events/t", (200,))
    with h5py.File(folder / "events.h5", "r+") as file:
        del file["events/t"]
        file.create_virtual_dataset("events/t", layout)


def moved_image(file: str, key: str) -> Change:
    """An image beside the data set that its JSON file names with two dots."""

    def change(folder: Path) -> None:
        Image.new("RGB", (6, 4)).save(folder.parent / "outside.png")
        set_in(file, "frames", 0, key, value="../outside.png")(folder)

    return change


def _named_type(file: h5py.File) -> None:
    del file["events/t"]
    file["events/t"] = np.dtype("i8")


def _soft_loop(file: h5py.File) -> None:
    del file["events/t"]
    file["events/t"] = h5py.SoftLink("/events/t2")
    file["events/t2"] = h5py.SoftLink("/events/t")


def _with(name: str, value: object) -> Callable[[h5py.File], None]:
    def edit(file: h5py.File) -> None:
        if name in file:
            del file[name]
        file[name] = value

    return edit


def _late_times(file: h5py.File) -> None:
    del file["events/t"]
    file["events/t"] = np.arange(200) + (1 << 62)
    file["events"].attrs["time_unit"] = "ms"


BIG, HUGE = int("9" * 400), "RAW:1e999999999"

MALFORMED: dict[str, dict[str, tuple[str, Change]]] = {
    "size": {
        "a sensor of 10^6 x 10^6": (_NATIVE, all_of(camera("width", 10**6), camera("height", 10**6))),
        "a sensor of 30000 x 30000": (_NATIVE, all_of(camera("width", 30000), camera("height", 30000))),
        "a sensor of 16000 x 16000": (_NATIVE, all_of(camera("width", 16000), camera("height", 16000))),
        "frames of 10^9 x 10^9": (_NATIVE, all_of(native("w", value=10**9), native("h", value=10**9))),
        "robust sensor": (_ROBUST, edit_npz("camera_calibration.npz", img_width=30000, img_height=30000)),
        "own sensor": (
            _OWN,
            all_of(*(set_in("calibration.json", "event_camera", k, value=10**6) for k in ("width", "height"))),
        ),
        "kalibr sensor": (_OWN, camchain(CAM0.replace("[60, 40]", "[1000000, 1000000]"))),
        "esim sensor": (
            _ESIM,
            lambda folder: np.save(folder / "poses_bounds.npy", np.full((3, 17), 30000.0)),
        ),
        "npz of 10^13 rows, stored": (_ROBUST, member("raw_events.npz", "timestamp", npy_header("(10000000000000,)"))),
        "npz of 10^13 rows, compressed": (
            _ROBUST,
            member("raw_events.npz", "timestamp", npy_header("(10000000000000,)") + bytes(64), compressed=True),
        ),
        "npz of 2^70 rows": (_ROBUST, member("raw_events.npz", "timestamp", npy_header(f"({2**70},)"))),
        "poses of 10^13 rows": (
            _ROBUST,
            member("camera_poses.npz", "T_wc_timestamp", npy_header("(10000000000000,)") + bytes(64), compressed=True),
        ),
        "npz bomb": (_ROBUST, npz_bomb("raw_events.npz", "timestamp")),
        "npz bomb of one number": (_ROBUST, npz_bomb("camera_calibration.npz", "img_width")),
        "npz text of 10^9 letters": (
            _ROBUST,
            member("camera_calibration.npz", "bayer_pattern", npy_header("()", "'<U1000000000'")),
        ),
        "npy of 10^13 rows": (_ESIM, write_bytes("events/2.npy", npy_header("(10000000000000, 4)", "'<f8'"))),
        "bounds of 10^13 rows": (_ESIM, write_bytes("poses_bounds.npy", npy_header("(10000000000000, 17)", "'<f8'"))),
        "HDF5 of 10^12 rows": (_NATIVE, unallocated("events.h5", _COLUMNS, "events/")),
        "HDF5 columns of 10^12 rows": (_EDS, unallocated("events.h5", {**_COLUMNS, "p": "u1"})),
        "HDF5 matrix of 10^12 rows": (
            _PAEV3D,
            unallocated("H5_Files/Bunny/event.h5", {"events": "f8"}, shape=(10**12, 4)),
        ),
        "HDF5 matrix of 10^12 columns": (
            _PAEV3D,
            hdf5("H5_Files/Bunny/event.h5", lambda f: without(f, "events").create_dataset("events", (9, 10**9), "f8")),
        ),
        "HDF5 piece of 2 GB": (_NATIVE, huge_chunk),
        "yaml that multiplies": (
            _OWN,
            camchain(
                "a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1]\n"
                + "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 12))
                + CAM0.replace("[60, 40]", "*a11")
            ),
        ),
        "yaml of 3 MB": (_OWN, camchain(CAM0 + "  rostopic: [" + "1, " * 1_000_000 + "1]\n")),
        "png of 30000 x 30000": (_ECD, write_bytes("images/0.png", png(30000, 30000))),
        "png of 12000 x 12000": (_ECD, write_bytes("images/0.png", png(12000, 12000))),
        "png of 30000 x 30000 among views": (_NATIVE, write_bytes("images/val/00000.png", png(30000, 30000))),
        "png comment of 64 MB": (_NATIVE, text_bomb("images/val/00000.png", (6, 4))),
        "pickle of an array of 10^12": (
            _PAEV3D,
            poses_pickle(_RECONSTRUCT, b"\x8a\x06" + (10**12).to_bytes(6, "little"), b"\x85C\x01b\x87R"),
        ),
        "pickle with memo 2^31": (_PAEV3D, poses_pickle(b"]r\xff\xff\xff\x7f")),
        "pickle of a record of 2 GB": (
            _PAEV3D,
            poses_pickle(b"cnumpy.core.multiarray\nscalar\ncnumpy\ndtype\n", b"X\x0b\0\0\0V2000000000\x85R\x85R"),
        ),
        "pickle of bytes of 2^40": (_PAEV3D, poses_pickle(b"\x96" + (1 << 40).to_bytes(8, "little"))),
        "pickle that multiplies": (_PAEV3D, poses_pickle(nested_pickle())),
        "json of 8 GB": (_NATIVE, sparse("transforms.json")),
        "json of 50 MB": (_NATIVE, write_text("transforms.json", '{"frames": [' + "{}, " * 13_000_000 + "{}]}")),
        "poses of 8 GB": (_NATIVE, sparse("trajectory_estimated.txt")),
        "matrix of 8 GB": (_EVENTNERF, sparse("train/pose/r_00003.txt")),
        "event lines of 8 GB": (_ECD, sparse("events.txt")),
        "npz of 8 GB": (_ROBUST, sparse("camera_poses.npz")),
        "refractory period of 400 digits": (_NATIVE, camera("refractory_period_ns", BIG)),
    },
    "number": {
        **{
            f"{name} of 400 digits": (_NATIVE, camera(name, BIG))
            for name in ("width", "fl_x", "cx", "k1", "positive_contrast_threshold")
        },
        **{
            f"{name} of 1e999999999": (_NATIVE, camera(name, HUGE))
            for name in ("width", "fl_y", "cy", "k2", "negative_contrast_threshold", "refractory_period_ns")
        },
        **{
            f"{name} of 1e30": (_NATIVE, camera(name, "RAW:1e30"))
            for name in ("width", "fl_y", "cy", "k2", "negative_contrast_threshold", "refractory_period_ns")
        },
        "timestamp of 1e999999999": (_NATIVE, native("frames", 0, "timestamp", value=HUGE)),
        "timestamp of 1e-999999999": (_NATIVE, native("frames", 0, "timestamp", value="RAW:1e-999999999")),
        "timestamp of 400 digits": (_NATIVE, native("frames", 0, "timestamp", value=BIG)),
        "timestamp of 1e30 without pose": (
            _NATIVE,
            all_of(
                native("frames", 0, "timestamp", value="RAW:1e30"),
                edit_json("transforms.json", lambda m: m["frames"][0].pop("transform_matrix")),
            ),
        ),
        "matrix of 400 digits": (_NATIVE, native("frames", 0, "transform_matrix", 0, 3, value=BIG)),
        "matrix of 1e999999999": (_NATIVE, native("frames", 0, "transform_matrix", 0, 3, value=HUGE)),
        "matrix of 1e300": (_NATIVE, native("frames", 0, "transform_matrix", 0, 3, value="RAW:1e300")),
        "max_pose_gap of 400 digits": (_NATIVE, native("max_pose_gap_ns", value=BIG)),
        "a number of 5000 digits": (_NATIVE, native("event_camera", "x", value="RAW:" + "9" * 5000)),
        "NaN": (_NATIVE, camera("fl_x", "RAW:NaN")),
        "Infinity": (_NATIVE, camera("k1", "RAW:Infinity")),
        "pose time of 1e30": (_NATIVE, write_text("trajectory_estimated.txt", "0 0 0 0 0 0 0 1\n1e30 0 0 0 0 0 0 1\n")),
        "pose time of 1e999999999": (
            _NATIVE,
            write_text("trajectory_estimated.txt", "0 0 0 0 0 0 0 1\n1e999999999 0 0 0 0 0 0 1\n"),
        ),
        "pose at 1e300": (
            _NATIVE,
            write_text("trajectory_estimated.txt", "1600000000 1e300 0 0 0 0 0 1\n1600000009 0 0 0 0 0 0 1\n"),
        ),
        "pose at 1e200": (
            _ECD,
            write_text("groundtruth.txt", "0 1e200 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n"),
        ),
        "calibration of 1e300": (_ECD, write_text("calib.txt", "1e300 1e300 2.5 1.5 0 0 0 0 0\n")),
        "calibration of 1e999": (_ECD, write_text("calib.txt", "5 5 1e999 1.5 0 0 0 0 0\n")),
        "event time of 1e30": (_ECD, write_text("events.txt", "0.01 1 2 1\n1e30 1 2 0\n")),
        "kalibr of 1e999": (_OWN, camchain(CAM0.replace("51.0", "1.0e+999"))),
        "kalibr of 400 digits": (_OWN, camchain(CAM0.replace("51.0", str(BIG)))),
        "kalibr of 5000 digits": (_OWN, camchain(CAM0.replace("51.0", "9" * 5000))),
        "robust width of 1e300": (_ROBUST, edit_npz("camera_calibration.npz", img_width=np.float64(1e300))),
        "robust refractory period of 1e300": (
            _ROBUST,
            edit_npz("camera_calibration.npz", refractory_period=np.float64(1e300)),
        ),
        "robust pose times of uint64": (
            _ROBUST,
            edit_npz("camera_poses.npz", T_wc_timestamp=np.arange(21, dtype=np.uint64) + np.uint64(2**64 - 30)),
        ),
        "time offset that overflows": (
            _NATIVE,
            all_of(set_attribute("time_offset", np.int64(2**62)), set_attribute("time_unit", "ms")),
        ),
        "times that overflow with their unit": (_NATIVE, hdf5("events.h5", _late_times)),
        "time offset of 2^63": (_NATIVE, set_attribute("time_offset", np.uint64(2**63))),
        "t_offset of 2^64 - 1": (_OWN, hdf5("events.h5", _with("t_offset", np.uint64(2**64 - 1)))),
        "esim focal length of 1e300": (
            _ESIM,
            lambda folder: np.save(folder / "poses_bounds.npy", np.full((3, 17), 1e300)),
        ),
        "eventnerf intrinsics of 1e300": (
            _EVENTNERF,
            write_text("train/intrinsics/r_00000.txt", "1e300 0 0 0 0 1e300 0 0 0 0 1 0 0 0 0 1"),
        ),
    },
    "nesting": {
        "json of depth 100000": (_NATIVE, write_text("transforms.json", '{"a":' + "[" * 100_000 + "]" * 100_000 + "}")),
        "json of depth 900": (
            _NATIVE,
            native("frames", 0, "transform_matrix", value="RAW:" + "[" * 900 + "]" * 900),
        ),
        "calibration of depth 100000": (_OWN, write_text("calibration.json", "[" * 100_000)),
        "yaml of depth 5000": (_OWN, camchain(CAM0 + "  x: " + "[" * 5000 + "]" * 5000 + "\n")),
        "npy header of depth 3000": (_ESIM, write_bytes("poses_bounds.npy", npy_header("(" * 3000 + ")" * 3000))),
    },
    "kind": {
        "a list among names": (_NATIVE, native("test_filenames", value=[["x.png"]])),
        "an object among names": (_NATIVE, native("val_filenames", value=[{}])),
        "a list for a file": (_NATIVE, camera("file", ["events.h5"])),
        "a list for an image": (_NATIVE, native("frames", 0, "file_path", value=["a.png"])),
        "a number for an image": (_NATIVE, native("frames", 0, "file_path", value=3)),
        "a list for a frame": (_NATIVE, native("frames", 0, value=["a.png"])),
        "a list for a timestamp": (_NATIVE, native("frames", 0, "timestamp", value=[1])),
        "a ragged matrix": (_NATIVE, native("frames", 0, "transform_matrix", value=[[1], [1, 2]])),
        "an object for a matrix": (_NATIVE, native("frames", 0, "transform_matrix", value={"a": 1})),
        "letters in a matrix": (_NATIVE, native("frames", 0, "transform_matrix", value=[["1"] * 4] * 4)),
        "a box of letters": (_NATIVE, native("scene_box", value="wide")),
        "a box of objects": (_NATIVE, native("scene_box", value=[{}, {}])),
        "frames that are an object": (_NATIVE, native("frames", value={"a": 1})),
        "true for a width": (_NATIVE, camera("width", True)),
        "a number for a pattern": (_NATIVE, camera("bayer_pattern", 1)),
        "robust file_path of a list": (
            _ROBUST,
            set_in("views/transforms_val.json", "frames", 0, "file_path", value=[]),
        ),
        "robust angle of 0": (_ROBUST, set_in("views/transforms_val.json", "camera_angle_x", value=0)),
        "robust angle of a list": (_ROBUST, set_in("views/transforms_val.json", "camera_angle_x", value=[])),
        "robust name of bytes": (_ROBUST, edit_npz("camera_calibration.npz", bayer_pattern=np.array(b"RGGB"))),
        "robust objects": (_ROBUST, edit_npz("camera_calibration.npz", bayer_pattern=np.array({}, dtype=object))),
        "robust complex positions": (
            _ROBUST,
            edit_npz("camera_poses.npz", T_wc_position=np.zeros((21, 3), np.complex128)),
        ),
        "robust polarity of text": (_ROBUST, edit_npz("raw_events.npz", polarity=np.full(200, "on"))),
        "robust position of records": (
            _ROBUST,
            edit_npz("raw_events.npz", position=np.zeros(200, [("x", "u2"), ("y", "u2")])),
        ),
        "text that is not UTF-8": (_NATIVE, write_bytes("transforms.json", b'{"a": "\xff\xfe"}')),
    },
    "name": {
        "a file of 5000 letters": (_NATIVE, camera("file", "a" * 5000)),
        "an image of 5000 letters": (_NATIVE, native("frames", 0, "file_path", value="a" * 5000)),
        "an image with a null": (_NATIVE, native("frames", 0, "file_path", value="a\0b")),
        "a file with a null": (_NATIVE, camera("file", "a\0b")),
        "a file without a name": (_NATIVE, camera("file", "")),
        "a folder for a file": (_NATIVE, camera("file", "images")),
        "an image without a name": (_NATIVE, native("frames", 0, "file_path", value="")),
        "a listed image of 5000 letters": (_ECD, write_text("images.txt", f"0.05 {'a' * 5000}\n")),
        "a listed image with a null": (_ECD, write_text("images.txt", "0.05 a\0b\n")),
        "robust file_path of 5000 letters": (
            _ROBUST,
            set_in("views/transforms_val.json", "frames", 0, "file_path", value="a" * 5000),
        ),
        "robust file_path with a null": (
            _ROBUST,
            set_in("views/transforms_val.json", "frames", 0, "file_path", value="a\0b"),
        ),
        "a folder for the poses": (
            _NATIVE,
            lambda folder: (remove("trajectory_estimated.txt")(folder), (folder / "trajectory_estimated.txt").mkdir()),
        ),
        "a link to itself": (_NATIVE, link("trajectory_estimated.txt", "trajectory_estimated.txt")),
        "an image that is a link to itself": (_NATIVE, link("images/val/00000.png", "00000.png")),
        "events that are a folder": (
            _ECD,
            lambda folder: (remove("events.txt")(folder), (folder / "events.txt").mkdir()),
        ),
    },
    "rights": {
        "json": (_NATIVE, unreadable("transforms.json")),
        "poses": (_NATIVE, unreadable("trajectory_estimated.txt")),
        "true poses": (_NATIVE, unreadable("trajectory_ground_truth.txt")),
        "events": (_NATIVE, unreadable("events.h5")),
        "image": (_NATIVE, unreadable("images/val/00000.png")),
        "image folder": (_NATIVE, unreadable("images/val")),
        "folder": (_NATIVE, unreadable(".")),
        "event lines": (_ECD, unreadable("events.txt")),
        "calibration": (_ECD, unreadable("calib.txt")),
        "image list": (_ECD, unreadable("images.txt")),
        "npz events": (_ROBUST, unreadable("raw_events.npz")),
        "npz poses": (_ROBUST, unreadable("camera_poses.npz")),
        "robust views": (_ROBUST, unreadable("views/transforms_val.json")),
        "npy events": (_ESIM, unreadable("events/2.npy")),
        "npy folder": (_ESIM, unreadable("events")),
        "bounds": (_ESIM, unreadable("poses_bounds.npy")),
        "matrix": (_EVENTNERF, unreadable("train/pose/r_00003.txt")),
        "matrix folder": (_EVENTNERF, unreadable("train/pose")),
        "pickle": (_PAEV3D, unreadable("Render_info/Bunny/0003.npz")),
        "yaml": (_OWN, all_of(camchain(CAM0), unreadable("camchain.yaml"))),
        "own poses": (_OWN, unreadable("trajectory.txt")),
    },
    "hdf5": {
        "soft links in a circle": (_NATIVE, hdf5("events.h5", _soft_loop)),
        "soft link to nothing": (_NATIVE, hdf5("events.h5", _with("events/t", h5py.SoftLink("/none")))),
        "named type": (_NATIVE, hdf5("events.h5", _named_type)),
        "empty dataspace": (_NATIVE, hdf5("events.h5", _with("events/t", h5py.Empty("i8")))),
        "scalar": (_NATIVE, hdf5("events.h5", _with("events/t", np.int64(3)))),
        "column that is a group": (
            _NATIVE,
            hdf5("events.h5", lambda f: without(f, "events/t").create_group("events/t")),
        ),
        "events that are a column": (_NATIVE, hdf5("events.h5", _with("events", np.arange(9)))),
        "no group": (_NATIVE, hdf5("events.h5", lambda f: without(f, "events"))),
        "text column": (_NATIVE, hdf5("events.h5", _with("events/t", ["a", "b"]))),
        "unit that is a list": (_NATIVE, set_attribute("time_unit", ["ns", "us"])),
        "unit that is empty": (_NATIVE, set_attribute("time_unit", h5py.Empty("S1"))),
        "unit that is a number": (_NATIVE, set_attribute("time_unit", 3)),
        "unit of bytes": (_NATIVE, set_attribute("time_unit", np.bytes_(b"\xff\xfe"))),
        "offset that is a list": (_NATIVE, set_attribute("time_offset", [1, 2])),
        "offset that is text": (_NATIVE, set_attribute("time_offset", "1")),
        "offset that is empty": (_NATIVE, set_attribute("time_offset", h5py.Empty("i8"))),
        "own soft links in a circle": (_OWN, hdf5("events.h5", _soft_loop)),
        "own named type": (_OWN, hdf5("events.h5", _named_type)),
        "own empty dataspace": (_OWN, hdf5("events.h5", _with("events/t", h5py.Empty("i8")))),
        "own t_offset that is text": (_OWN, hdf5("events.h5", _with("t_offset", "1"))),
        "own t_offset that is empty": (_OWN, hdf5("events.h5", _with("t_offset", h5py.Empty("i8")))),
        "own t_offset that is a list": (_OWN, hdf5("events.h5", _with("t_offset", [1, 2]))),
        "own t_offset that is a group": (
            _OWN,
            hdf5("events.h5", lambda f: without(f, "t_offset").create_group("t_offset")),
        ),
        "own t_offset in a circle": (_OWN, hdf5("events.h5", _with("t_offset", h5py.SoftLink("/t_offset")))),
        "own references": (_OWN, hdf5("events.h5", lambda f: _with("events/t", np.array([f.ref], h5py.ref_dtype))(f))),
        "eds enumeration": (
            _EDS,
            hdf5(
                "events.h5",
                lambda f: without(f, "p").create_dataset("p", (200,), h5py.enum_dtype({"A": 0, "B": 1}, "i1")),
            ),
        ),
        "eds lists": (
            _EDS,
            hdf5("events.h5", lambda f: without(f, "p").create_dataset("p", (200,), h5py.vlen_dtype("i1"))),
        ),
        "paev3d text": (_PAEV3D, hdf5("H5_Files/Bunny/event.h5", _with("events", [["a"] * 4] * 3))),
        "paev3d scalar": (_PAEV3D, hdf5("H5_Files/Bunny/event.h5", _with("events", 3.0))),
        "half a file": (_NATIVE, truncated("events.h5")),
    },
    "npy": {
        "unbalanced header": (_ESIM, write_bytes("poses_bounds.npy", npy_header("(3, 17", "'<f8'", ""))),
        "unbalanced header of events": (_ESIM, write_bytes("events/2.npy", npy_header("(3, 4", "'<f8'", ""))),
        "unbalanced header in npz": (_ROBUST, member("raw_events.npz", "timestamp", npy_header("(3", end=""))),
        "unbalanced header in compressed npz": (
            _ROBUST,
            member("camera_poses.npz", "T_wc_timestamp", npy_header("(3", end=""), compressed=True),
        ),
        "unbalanced header of poses": (
            _PAEV3D,
            member("Render_info/Bunny/0003.npz", "object_poses", npy_header("(3", "'|O'", "")),
        ),
        "open quotes": (_ESIM, write_bytes("poses_bounds.npy", npy_header("(3, 17)", "'<f8"))),
        "unknown type": (_ESIM, write_bytes("poses_bounds.npy", npy_header("(3, 17)", "'<q99'"))),
        "type of many fields": (
            _ESIM,
            write_bytes("poses_bounds.npy", npy_header("(3, 17)", "[('a', '<f8', (1000000, 1000000))]")),
        ),
        "negative shape": (_ESIM, write_bytes("poses_bounds.npy", npy_header("(-3, 17)", "'<f8'") + bytes(999))),
        "shape of decimals": (_ESIM, write_bytes("poses_bounds.npy", npy_header("(3.5, 17)", "'<f8'") + bytes(999))),
        "shape of true": (_ESIM, write_bytes("poses_bounds.npy", npy_header("(True, 17)", "'<f8'") + bytes(999))),
        "version 9": (_ESIM, write_bytes("poses_bounds.npy", b"\x93NUMPY\x09\x00" + bytes(99))),
        "header beyond the end": (_ESIM, write_bytes("poses_bounds.npy", b"\x93NUMPY\x02\x00\xff\xff\xff\x7f")),
        "pickle for npy": (_ESIM, write_bytes("poses_bounds.npy", pickle.dumps([1, 2]))),
        "half an archive": (_ROBUST, truncated("raw_events.npz")),
        "half an archive of poses": (_PAEV3D, truncated("Render_info/Bunny/0003.npz")),
        "member with a password": (
            _ROBUST,
            lambda folder: (folder / "camera_poses.npz").write_bytes(
                (folder / "camera_poses.npz")
                .read_bytes()
                .replace(b"PK\x01\x02\x2d\x03\x2d\0\0\0", b"PK\x01\x02\x2d\x03\x2d\0\1\0")
            ),
        ),
        "objects as events": (_ROBUST, edit_npz("raw_events.npz", timestamp=np.array([None] * 200))),
        "no dimensions": (_ROBUST, edit_npz("raw_events.npz", timestamp=np.int64(3))),
        "three dimensions": (_ROBUST, edit_npz("raw_events.npz", timestamp=np.zeros((2, 2, 2), np.int64))),
    },
    "physics": {
        "a lens no pixel survives": (_NATIVE, camera("k1", "RAW:1e10")),
        "a lens no pixel survives, negative": (_NATIVE, camera("k1", "RAW:-1e10")),
        "a lens of 1e300": (_NATIVE, camera("k2", "RAW:1e300")),
        "a fisheye no pixel survives": (
            _NATIVE,
            all_of(
                camera("camera_model", "OPENCV_FISHEYE"), camera("k1", "RAW:-1e6"), camera("p1", 0), camera("k3", 0)
            ),
        ),
        "a focal length of 1e-320": (_NATIVE, camera("fl_x", "RAW:1e-320")),
        "a focal length of 1e-30": (_NATIVE, camera("fl_x", "RAW:1e-30")),
        "a focal length of 1e300": (_NATIVE, camera("fl_y", "RAW:1e300")),
        "a principal point of 1e300": (_NATIVE, camera("cx", "RAW:1e300")),
        "a lens of frames that no pixel survives": (_NATIVE, native("k1", value="RAW:-1e10")),
        "a refractory period longer than the recording": (_NATIVE, camera("refractory_period_ns", 10**10)),
        "a refractory period of 292 years": (_NATIVE, camera("refractory_period_ns", 2**63 - 1)),
        "a threshold of 1e-320": (_NATIVE, camera("positive_contrast_threshold", "RAW:1e-320")),
        "a threshold of 1e300": (_NATIVE, camera("negative_contrast_threshold", "RAW:1e300")),
        "a threshold of 1e-320 of robust": (
            _ROBUST,
            edit_npz("camera_calibration.npz", pos_contrast_threshold=np.float64(1e-320)),
        ),
        "a box of 1e300": (_NATIVE, native("scene_box", value=[[-1e300] * 3, [1e300] * 3])),
        "a box of 1e-320": (_NATIVE, native("scene_box", value=[[0, 0, 0], [1e-320] * 3])),
        "a box of 1e-320 on one side": (_NATIVE, native("scene_box", value=[[0, 0, 0], [1, 1, 1e-320]])),
        "a box far away": (_NATIVE, native("scene_box", value=[[1e200] * 3, [2e200] * 3])),
        "kalibr resolution of 64.7": (_OWN, camchain(CAM0.replace("[60, 40]", "[64.7, 40]"))),
        "robust width of 60.5": (_ROBUST, edit_npz("camera_calibration.npz", img_width=60.5)),
        "esim width of 64.5": (
            _ESIM,
            lambda folder: np.save(folder / "poses_bounds.npy", np.full((3, 17), 64.5)),
        ),
    },
    "image": {
        "truncated": (_NATIVE, noisy_image("images/val/00000.png", (6, 4))),
        "truncated among the train views": (_NATIVE, noisy_image("images/train/00001.png", (6, 4))),
        "EPS": (_NATIVE, saved_as("EPS", "images/val/00000.png")),
        "EPS of ECD": (_ECD, saved_as("EPS", "images/0.png")),
        "GIF": (_NATIVE, saved_as("GIF", "images/val/00000.png")),
        "BMP": (_NATIVE, saved_as("BMP", "images/val/00000.png")),
        "TIFF among the train views": (_NATIVE, saved_as("TIFF", "images/train/00001.png")),
        "PPM": (_ECD, saved_as("PPM", "images/1.png")),
        "empty": (_NATIVE, write_text("images/val/00000.png", "")),
        "text": (_NATIVE, write_text("images/val/00000.png", "no image")),
        "16 bits": (_NATIVE, saved_as("PNG", "images/val/00000.png", mode="I;16")),
        "another size among the train views": (_NATIVE, saved_as("PNG", "images/train/00001.png", (3, 2))),
        "an animation of 2^32 pictures": (_NATIVE, animation("images/val/00000.png")),
        "half of a JPEG": (
            _NATIVE,
            all_of(
                lambda folder: Image.fromarray(
                    np.random.default_rng(0).integers(0, 256, (4, 6, 3)).astype(np.uint8)
                ).save(folder / "images/val/00000.png", format="JPEG"),
                truncated("images/val/00000.png", 0.9),
            ),
        ),
    },
    "kalibr": {
        "a camera of another name": (_OWN, camchain(CAM0.replace("cam0", "0"))),
        "two cameras, none asked for": (_OWN, camchain(CAM0 + CAM0.replace("cam0", "cam1"))),
        "an alias of itself": (_OWN, camchain(CAM0.replace("[60, 40]", "&a [*a, 40]"))),
        "a camera that is itself": (_OWN, camchain("cam0: &a\n  intrinsics: *a\n")),
        "a number for a name": (_OWN, camchain("0: {}\n1: {}\n")),
        "an unknown tag": (_OWN, camchain("cam0: !!python/object/apply:os.getcwd []\n")),
        "a timestamp that is none": (_OWN, camchain(CAM0 + "  x: !!timestamp never\n")),
        "a whole number that is none": (_OWN, camchain(CAM0 + "  x: !!int many\n")),
        "a character beyond Unicode": (_OWN, camchain(CAM0 + '  x: "\\UFFFFFFFF"\n')),
        "a distortion of 1e200": (_OWN, camchain(CAM0.replace("[0.0, 0.0, 0.0, 0.0]", "[1.0e+200, 0, 0, 0]"))),
        "a date": (_OWN, camchain(CAM0.replace("[60, 40]", "2020-01-01"))),
        "a set": (_OWN, camchain(CAM0.replace("[60, 40]", "!!set {60, 40}"))),
        "letters": (_OWN, camchain(CAM0.replace("[60, 40]", "[a, b]"))),
        "a key that is a list": (_OWN, camchain("? [a, b]\n: {}\n")),
        "merge keys": (_OWN, camchain("a: &a {b: 1}\ncam0:\n  <<: [*a, *a]\n")),
    },
    "elsewhere": {
        "events": (_NATIVE, lambda folder: (outside_events(folder), camera("file", "../outside.h5")(folder))),
        "events with a whole path": (
            _NATIVE,
            lambda folder: camera("file", str(outside_events(folder)))(folder),
        ),
        "image": (_NATIVE, moved_image("transforms.json", "file_path")),
        "listed image": (
            _ECD,
            lambda folder: (
                Image.new("L", (6, 4)).save(folder.parent / "outside.png"),
                (folder / "images.txt").write_text("0.05 ../outside.png\n"),
            ),
        ),
        "own listed image": (
            _OWN,
            lambda folder: (
                Image.new("L", (60, 40)).save(folder.parent / "outside.png"),
                (folder / "images.txt").write_text("1600000000.05 ../outside.png\n"),
            ),
        ),
        "robust image": (
            _ROBUST,
            lambda folder: (
                Image.new("RGBA", (50, 30)).save(folder.parent / "outside.png"),
                set_in("views/transforms_val.json", "frames", 0, "file_path", value="../../outside")(folder),
            ),
        ),
        "external link to a group": (_NATIVE, external_link(True)),
        "external link to a column": (_NATIVE, external_link(False)),
        "external storage": (_NATIVE, external_storage),
        "virtual column": (_NATIVE, virtual),
    },
}
