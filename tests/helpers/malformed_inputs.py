"""Malformed datasets: what is too large, of the wrong kind, unreadable, absurd, or elsewhere, and plain faults."""

from __future__ import annotations

import os
import shutil
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import yaml
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
    replace_line,
    saved_as,
    set_attribute,
    set_in,
    sparse,
    without,
    write_bytes,
    write_text,
)
from helpers.published_datasets import CAMCHAIN, N_EVENTS, N_POSES, WRITERS, make_poses, write_colmap
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


def robust_poses(**arrays: object) -> Change:
    return edit_npz("camera_poses.npz", **arrays)


def robust_events(**arrays: object) -> Change:
    return edit_npz("raw_events.npz", **arrays)


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


def unallocated(name: str, columns: dict[str, str], group: str = "", shape: tuple[int, ...] = (10**12,)) -> Change:
    """Columns of 10^12 rows that were never written."""

    def edit(file: h5py.File) -> None:
        for column, dtype in columns.items():
            key, chunks = f"{group}{column}", (1 << 16, *shape[1:])
            without(file, key).create_dataset(key, shape, dtype, chunks=chunks, compression="gzip")

    return edit_hdf5(name, edit)


_COLUMNS = {"x": "u2", "y": "u2", "t": "i8", "p": "i1"}


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
    return member(_OBJECTS, "object_poses", npy_header("(1,)", "'|O'") + stream)


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
    "a key that is a list": "? [a, b]\n: {}\n",
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
        "a sensor of 16000 x 16000": camera(width=16000, height=16000),
        "HDF5 of 10^12 rows": unallocated("events.h5", _COLUMNS, "events/"),
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
    _OWN: {
        "own t_offset that is a group": edit_hdf5(_H5, lambda f: without(f, "t_offset").create_group("t_offset")),
    },
    _ESIM: {"width of 64.5": lambda folder: np.save(folder / "poses_bounds.npy", np.full((3, 17), 64.5))},
    _EDS: {
        "HDF5 columns of 10^12 rows": unallocated("events.h5", {**_COLUMNS, "p": "u1"}),
        "eds lists": edit_hdf5(_H5, lambda file: without(file, "p").create_dataset("p", (200,), h5py.vlen_dtype("i1"))),
    },
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

# Each fault: a change of the dataset, the end of the path that the error names, and words of its problem or remedy.
Fault = tuple[Change, str, str]

DTYPES = {"x": np.uint16, "y": np.uint16, "t": np.int64, "p": np.int8}
MIRRORED, SCALED = np.diag([1.0, 1, -1, 1]).tolist(), np.diag([2.0, 2, 2, 1]).tolist()


def native(edit: Callable[[dict], object]) -> Change:
    return edit_json("transforms.json", edit)


def top(**values: object) -> Change:
    return native(lambda meta: meta.update(values))


def frame(**values: object) -> Change:
    return native(lambda meta: meta["frames"][0].update(values))


def column(name: str, values: np.ndarray | None) -> Change:
    return put("events.h5", f"events/{name}", values)


_NATIVE_FAULTS: dict[str, Fault] = {
    "no transforms": (remove("transforms.json"), "transforms.json", "no such file"),
    "no event camera": (native(lambda m: m.pop("event_camera")), "transforms.json", "`event_camera`"),
    "no focal length": (native(lambda m: m["event_camera"].pop("fl_x")), "transforms.json", "event_camera: "),
    "no threshold": (camera(positive_contrast_threshold=None), "transforms.json", "positive_contrast"),
    "negative threshold": (camera(negative_contrast_threshold=-1), "transforms.json", "negative_contrast"),
    "unknown Bayer pattern": (camera(bayer_pattern="RGBG"), "transforms.json", '"RGBG"'),
    "unknown lens": (camera(camera_model="KB4"), "transforms.json", "event_camera: the lens model is 'KB4'"),
    "p1 of a fisheye": (camera(camera_model="OPENCV_FISHEYE", p1=0.1), "transforms.json", "event_camera: p1 is 0.1"),
    "k4 without a fisheye": (top(k4=-0.1), "transforms.json", "k4 is -0.1, which camera_model OPENCV does not have"),
    "Kalibr's distortion": (camera(distortion_coeffs=[0.1]), "transforms.json", "distortion_coeffs, which is not read"),
    "model of distortion": (top(distortion_model="kb4"), "transforms.json", "distortion_model, which is not read"),
    "image of another size": (saved_as("PNG", "images/val/00000.png", (3, 2)), "val/00000.png", "3 x 2 pixels"),
    "BMP": (saved_as("BMP", "images/val/00000.png"), "val/00000.png", "save it as PNG or JPEG, or copy it again if"),
    "mirrored pose": (frame(transform_matrix=MIRRORED), "frames[0].transform_matrix", "not a rigid motion"),
    "scaled mount": (camera(T_frame_event=SCALED), "event_camera.T_frame_event", "not a rigid motion"),
    "frame twice": (native(lambda m: m["frames"].append(m["frames"][0])), "transforms.json", "train/00000.png again"),
    "box inside out": (top(scene_box=[[1] * 3, [0] * 3]), "transforms.json", "scene_box"),
    "missing image": (remove("images/val/00000.png"), "transforms.json", "val/00000.png, which does not exist"),
    "unknown image": (top(test_filenames=["x.png"]), "transforms.json", "test_filenames"),
    "no pose and time": (frame(transform_matrix=None, timestamp=None), "transforms.json", "frames[0] has neither"),
    "no event file": (remove("events.h5"), "events.h5", "no such file"),
    "no name of events": (camera(file=None), "transforms.json", "file"),
    "no column": (column("p", None), "events.h5", "/events/p"),
    "wrong dtype": (column("t", np.zeros(200)), "events.h5", "/events/t has type float64"),
    "no events": (all_of(*(column(n, np.zeros(0, dtype)) for n, dtype in DTYPES.items())), "events.h5", "no events"),
    "fractional offset": (set_attribute("time_offset", 0.5), "events.h5", "time_offset is 0.5"),
    "offset is NaN": (set_attribute("time_offset", np.nan), "events.h5", "time_offset is nan"),
    "unknown unit": (set_attribute("time_unit", "fortnight"), "events.h5", "time unit is 'fortnight'"),
    "polarity 0": (column("p", np.zeros(200, np.int8)), "events.h5", "polarity 0"),
    "no overlap": (column("t", np.arange(200)), "trajectory_estimated.txt", "do not overlap"),
    "no poses": (remove("trajectory_estimated.txt"), "trajectory_estimated.txt", "no such poses"),
}


def pose(line: str) -> Change:
    return replace_line("groundtruth.txt", 2, line)


def image_times(ticks: int) -> Change:
    """The times of the images, in ticks of a second."""
    lines = [f"{(2 * index + 1) * ticks // 20} images/{index}.png\n" for index in range(4)]
    return write_text("images.txt", "".join(lines))


LATE = write_text("groundtruth.txt", "5 0 0 0 0 0 0 1\n6 1 0 0 0 0 0 1\n")
_ECD_FAULTS: dict[str, Fault] = {
    "no folder": (shutil.rmtree, "made", "no such folder"),
    "no poses": (remove("groundtruth.txt"), "groundtruth.txt", "no such poses"),
    "no calibration": (remove("calib.txt"), "calib.txt", "no such file"),
    "missing image": (remove("images/1.png"), "images.txt", "images/1.png, which does not exist"),
    "image times in ms": (image_times(10**3), "images", "images were in milliseconds"),
    "image times in us": (image_times(10**6), "images", "images were in microseconds"),
    "image times in ns": (image_times(10**9), "images", "images were in nanoseconds"),
    "NaN pose": (pose("0.2 nan 0 0 0 0 0 1"), "groundtruth.txt", "pose 2 holds nan"),
    "long quaternion": (pose("0.2 0 0 0 0 0 1 1"), "groundtruth.txt", "pose 2 holds 0 0 0 0 0 1 1"),
    "seven numbers": (pose("0.2 0 0 0 0 0 1"), "groundtruth.txt", "line 3 has 7 fields"),
    "pose is a word": (pose("0.2 x 0 0 0 0 0 1"), "groundtruth.txt", "'x'"),
    "pose time is a word": (pose("now 0 0 0 0 0 0 1"), "groundtruth.txt", "now is not a time in seconds"),
    "unsorted poses": (pose("0.05 0 0 0 0 0 0 1"), "groundtruth.txt", "pose 2 is at 50000000 ns, not after"),
    "one pose": (write_text("groundtruth.txt", "0 0 0 0 0 0 0 1\n"), "groundtruth.txt", "1 poses"),
    "no pose": (write_text("groundtruth.txt", "# nothing\n"), "groundtruth.txt", "no poses"),
    "no overlap": (LATE, "groundtruth.txt", "do not overlap the events from 10000000 to 310000000 ns"),
    "short calibration": (write_text("calib.txt", "5 5.5 2.5 1.5\n"), "calib.txt", "line 1 has 4 fields"),
    "empty calibration": (write_text("calib.txt", ""), "calib.txt", "empty"),
    "no focal length": (write_text("calib.txt", "0 5 2 1 0 0 0 0 0\n"), "calib.txt", "fx must be from 0.01"),
}

CALIBRATION, POSES, VIEWS = "camera_calibration.npz", "camera_poses.npz", "views/transforms_val.json"


def views(edit: Callable[[dict], object]) -> Change:
    return edit_json(VIEWS, edit)


_ROBUST_FAULTS: dict[str, Fault] = {
    "no intrinsics": (edit_npz(CALIBRATION, intrinsics=None), CALIBRATION, "no array intrinsics"),
    "flat intrinsics": (edit_npz(CALIBRATION, intrinsics=np.ones(9)), CALIBRATION, "intrinsics: expected `array`"),
    "unknown lens": (edit_npz(CALIBRATION, distortion_model="fov"), CALIBRATION, "the lens model is 'fov'"),
    "six distortions": (edit_npz(CALIBRATION, distortion_params=np.zeros(6)), CALIBRATION, "takes 5 numbers, not 6"),
    "NaN threshold": (edit_npz(CALIBRATION, pos_contrast_threshold=np.nan), CALIBRATION, "positive_contrast"),
    "decimal times": (edit_npz(POSES, T_wc_timestamp=np.zeros(N_POSES)), POSES, "T_wc_timestamp has type float64"),
    "fewer times": (edit_npz(POSES, T_wc_timestamp=np.arange(3)), POSES, "T_wc_position has type float64 and shape"),
    "no image": (remove("views/val/r_1.png"), VIEWS, "frames[1] names ./val/r_1"),
    "no angle": (views(lambda m: m.pop("camera_angle_x")), VIEWS, "neither camera_angle_x nor intrinsics"),
    "angle is 0": (views(lambda m: m.update(camera_angle_x=0)), VIEWS, "camera_angle_x"),
    "other angle": (views(lambda m: m.update(camera_angle_x=1)), "transforms_test.json", "that of the other split"),
}

CAMERAS, MOCAP, TRUTH = "camera-calibrationA.json", "mocap-imu-calibrationA.json", "mocap-desk2-vi_gt_data"


def tum_cameras(edit: Callable[[dict], object]) -> Change:
    return edit_json(CAMERAS, lambda meta: edit(meta["value0"]))


_TUM_VIE_FAULTS: dict[str, Fault] = {
    "no calibration": (remove("camera-*"), CAMERAS, "no such file"),
    "pinhole": (tum_cameras(lambda m: m["intrinsics"][2].update(camera_type="ds")), CAMERAS, "[2].camera_type"),
    "a word": (replace_line(f"{TRUTH}/mocap_data.txt", 1, "early 0 0 0 0 0 0 1"), "mocap_data.txt", "in microseconds"),
    "lost image": (remove(f"{TRUTH}/left_images/00001.jpg"), "image_timestamps_left.txt", "3 times for 2 images"),
}

TIMES, SECONDS = "images_timestamps.txt", "1600000000.1\n1600000000.8\n1600000001.7\n"
_EDS_FAULTS: dict[str, Fault] = {
    "image times in seconds": (write_text(TIMES, SECONDS), "images", "images were 1,000,000 times too small"),
    "huge time": (write_text(TIMES, "1\n2\n1e99999999\n"), TIMES, "1e99999999 is not a time"),
}


def bounds(array: np.ndarray) -> Change:
    return lambda folder: np.save(folder / "poses_bounds.npy", array)


_ESIM_FAULTS: dict[str, Fault] = {
    "empty folder": (remove("events/*"), "events", "no *.npy"),
    "two lists": (write_text("other_poses_all.txt", ""), "made", "2 files *poses_all*.txt"),
    "small bounds": (bounds(np.zeros((12, 4))), "poses_bounds.npy", "shape (12, 4)"),
    "NaN bounds": (bounds(np.full((12, 17), np.nan)), "poses_bounds.npy", "width must be a whole number"),
    "unsorted files": (lambda folder: (folder / "events/2.npy").rename(folder / "events/20.npy"), "events", "before"),
}

MATRIX = "train/pose/r_00003.txt"
ONE_TIME = edit_npz("train/events/test_lego.npz", t=np.zeros(N_EVENTS, int))
_EVENTNERF_FAULTS: dict[str, Fault] = {
    "no events": (remove("train/events"), "events.npz", "no such file"),
    "two event files": (lambda folder: np.savez(folder / "train/events/b.npz"), "train/events", "2 files *.npz"),
    "no split": (remove("train"), "made", "0 training splits"),
    "no intrinsics": (remove("train/intrinsics/*"), "train/intrinsics", "no *.txt"),
    "3 x 4": (write_text(MATRIX, "1 " * 12), MATRIX, "12 numbers"),
    "NaN pose": (write_text(MATRIX, "nan " * 16), MATRIX, "not finite"),
    "mirrored": (write_text(MATRIX, "1 0 0 0  0 1 0 0  0 0 -1 0  0 0 0 1"), "train/pose", "pose 3 is not a rigid"),
    "lost image": (remove("train/rgb/00003.png"), "train/rgb", "20 images for 21 poses"),
    "one event time": (ONE_TIME, "train/pose", "pose 1 is at 0 ns, not after"),
}


def objects(*values: dict) -> Change:
    return lambda folder: np.savez(folder / _OBJECTS, object_poses=list(values))


_PAEV3D_FAULTS: dict[str, Fault] = {
    "no poses": (remove("Render_info/Bunny/*.npz"), "Render_info/Bunny", "no *.npz"),
    "no camera": (objects({"name": "Bunny"}), "0003.npz", "no 'Camera'"),
    "pose of words": (objects({"name": "Camera", "pose": np.full((4, 4), "1")}), "0003.npz", "no 'Camera' with a pose"),
    "small pose": (objects({"name": "Camera", "pose": np.eye(3)}), "0003.npz", "no 'Camera' with a pose"),
    "NaN pose": (objects({"name": "Camera", "pose": np.full((4, 4), np.nan)}), "0003.npz", "not a rigid motion"),
}


def kalibr(name: str, **values: object) -> Change:
    return camchain(yaml.dump({**CAMCHAIN, name: {**CAMCHAIN[name], **values}}))


def colmap(make: Change = lambda folder: None) -> Change:
    return all_of(remove("trajectory.txt"), lambda folder: (folder / "colmap").mkdir(), make)


def other_images(folder: Path) -> None:
    write_colmap(folder / "colmap/sparse/0", make_poses(2), ["00000.png", "other.png"])


INFINITE = np.full((4, 4), np.inf).tolist()
_OWN_FAULTS: dict[str, Fault] = {
    "no folder": (shutil.rmtree, "made", "no such folder"),
    "no events": (remove("events.h5"), "made", "0 files events{.raw,"),
    "two event files": (write_text("events.csv", ""), "made", "2 files events"),
    "no calibration": (remove("calibration.json"), "events.h5", "does not state the size of its sensor"),
    "offset is a word": (put("events.h5", "t_offset", "late"), "events.h5", "late"),
    "image without time": (write_text("images.txt", "00001.png\n"), "images.txt", "line 1 has 1 fields"),
    "COLMAP without times": (all_of(remove("images.txt"), colmap()), "images.txt", "no such list"),
    "empty COLMAP": (colmap(), "colmap", "no COLMAP model"),
    "COLMAP of other images": (colmap(other_images), "images.txt", "it lists other.png 0 times"),
    "broken COLMAP": (colmap(write_bytes("colmap/images.bin", b"\1")), "images.bin", "not a COLMAP model"),
    "unknown distortion": (kalibr("cam0", distortion_model="fov", distortion_coeffs=[1]), "camchain.yaml", "is 'fov'"),
    "unknown camera": (kalibr("cam0", camera_model="omni"), "camchain.yaml", "calibrate again with pinhole-radtan or"),
    "three distortions": (kalibr("cam0", distortion_coeffs=[0.1, 0, 0]), "camchain.yaml", "3 distortion_coeffs"),
    "infinite mount": (kalibr("cam1", T_cn_cnm1=INFINITE), "cam1.T_cn_cnm1", "not a rigid motion"),
    "camchain of numbers": (camchain("cam0: 3"), "camchain.yaml", "no camera"),
    "no YAML": (camchain("{:"), "camchain.yaml", "not valid YAML"),
}

_FAULTS = {
    _NATIVE: _NATIVE_FAULTS,
    _ECD: _ECD_FAULTS,
    _ROBUST: _ROBUST_FAULTS,
    "tum-vie-data": _TUM_VIE_FAULTS,
    _EDS: _EDS_FAULTS,
    _ESIM: _ESIM_FAULTS,
    _EVENTNERF: _EVENTNERF_FAULTS,
    _PAEV3D: _PAEV3D_FAULTS,
    _OWN: _OWN_FAULTS,
}
FAULTS = {f"{kind}: {name}": (kind, *fault) for kind, faults in _FAULTS.items() for name, fault in faults.items()}
"""By a name: the format of a whole dataset, the change, the end of the error's source, and a part of what it says."""
