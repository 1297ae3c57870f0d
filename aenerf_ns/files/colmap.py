"""The poses of images in a COLMAP model: images.bin or images.txt, in COLMAP's binary and text format.

https://colmap.github.io/format.html

pycolmap is not used: of 24 damaged models, pycolmap 4.2 took more than 40 s for three and 6 GB for three others.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch
from torch import Tensor

from aenerf_ns.errors import DataError, reading
from aenerf_ns.files.limits import MAX_TABLE_BYTES, require_at_most
from aenerf_ns.files.tum_trajectory import poses_from_quaternions

# The image's number, its world-to-camera rotation as qw qx qy qz and translation, and its camera's number.
_IMAGE = struct.Struct("<I7dI")
_COUNT = struct.Struct("<Q")
# The camera's number, the number of its model, width, height, and the first parameter, which is a focal length.
_CAMERA = struct.Struct("<IiQQd")
# Parameters of the models that begin with a focal length, by their numbers.
_NUM_PARAMETERS = (3, 4, 4, 5, 8, 8, 12, 5, 4, 5, 12, 16, 4, 5, 3, 4, 6)
# A feature holds x, y and the number of its 3D point.
_FEATURE_BYTES = 24
_MAX_NAME = 4096
# An image of 100,000 features has 5 MB in a line of text.
_MAX_LINE = 1 << 24
_MAX_IMAGES = 200_000
_MAX_TEXT_BYTES = 1 << 32

Row = tuple[str, list[float], int]


def read_colmap_poses(model: Path) -> dict[str, Tensor]:
    """Read the poses of the images in a model.

    Args:
        model: the folder that holds images.bin or images.txt. If it holds both, images.bin is read, as COLMAP does.

    Returns:
        (4, 4) float64 camera-to-world poses with OpenCV axes, by the names of the images.

    Raises:
        DataError: there is no such file, it is damaged, or a pose is no pose.
    """
    with reading(model):
        binary, text = model / "images.bin", model / "images.txt"
        path = binary if binary.is_file() else text
        if not path.is_file():
            raise DataError(model, "there is no COLMAP model", "give the folder that holds images.bin or images.txt")
        with path.open("rb") as file:
            rows = list(_read_binary(path, file) if path == binary else _read_text(path, file))
    if not rows:
        raise DataError(path, "it has no image", "reconstruct again")
    names, columns, cameras = zip(*rows, strict=True)
    if len(set(names)) < len(names):
        raise _damaged(path, "it names an image twice")
    # Each image has its own camera where COLMAP was not told that there is one.
    num_cameras = len(set(cameras))
    if 1 < num_cameras < len(names):
        problem = f"its images are of {num_cameras} cameras, and how these are mounted on the event camera is not known"
        raise DataError(path, problem, "give a model of the images of one camera")
    values = np.array(columns)
    world_to_camera = poses_from_quaternions(path, values[:, 4:7], values[:, [1, 2, 3, 0]])
    return dict(zip(names, torch.linalg.inv(world_to_camera), strict=True))


def read_colmap_focal_shares(model: Path) -> list[float]:
    """Return the focal length of each camera in a model, as a share of the width of its images.

    Raises:
        DataError: the file is damaged. There are no cameras if it is missing, and none from one of an unknown model on.
    """
    with reading(model):
        binary, text = model / "cameras.bin", model / "cameras.txt"
        path = binary if binary.is_file() else text
        if not path.is_file():
            return []
        require_at_most(path, MAX_TABLE_BYTES)
        content = path.read_bytes()
    try:
        if path == text:
            rows = [line.split() for line in content.decode("utf-8", "replace").splitlines()]
            return [float(row[4]) / int(row[2]) for row in rows if row and not row[0].startswith("#")]
        shares, position = [], _COUNT.size
        for _ in range(*_COUNT.unpack_from(content)):
            _, kind, width, _, focal = _CAMERA.unpack_from(content, position)
            if not 0 <= kind < len(_NUM_PARAMETERS):
                break
            shares.append(focal / width)
            position += _CAMERA.size + 8 * (_NUM_PARAMETERS[kind] - 1)
        return shares
    except (struct.error, ValueError, IndexError, ArithmeticError) as error:
        raise _damaged(path, f"a camera cannot be read: {error}") from None


def _read_binary(path: Path, file: BinaryIO) -> Iterator[Row]:
    size = path.stat().st_size
    try:
        (count,) = _COUNT.unpack(file.read(_COUNT.size))
        if count > min(_MAX_IMAGES, size // _IMAGE.size):
            raise _damaged(path, f"its header states {count:,} images, but it has {size:,} bytes")
        for index in range(count):
            _, *values, camera = _IMAGE.unpack(file.read(_IMAGE.size))
            if not any(values[:4]):
                raise _damaged(path, f"image {index + 1} has no rotation")
            begin = file.tell()
            name, end, _ = file.read(_MAX_NAME).partition(b"\0")
            if not end:
                raise _damaged(path, f"the name of image {index + 1} does not end")
            file.seek(begin + len(name) + 1)
            (num_features,) = _COUNT.unpack(file.read(_COUNT.size))
            end_of_image = file.tell() + _FEATURE_BYTES * num_features
            if end_of_image > size:
                raise _damaged(path, f"it ends within the {num_features:,} features of image {index + 1}")
            file.seek(end_of_image)
            yield name.decode("utf-8", "replace"), values, camera
    except struct.error:
        raise _damaged(path, "it ends within an image") from None


def _read_text(path: Path, file: BinaryIO) -> Iterator[Row]:
    require_at_most(path, _MAX_TEXT_BYTES)
    is_pose = True
    # With room for comments.
    for number in range(1, 2 * _MAX_IMAGES + 100):
        line = file.readline(_MAX_LINE)
        if not line:
            return
        if len(line) == _MAX_LINE:
            raise _damaged(path, f"line {number} has more than {_MAX_LINE:,} bytes")
        if line.startswith(b"#"):
            continue
        # The line of the features, which may be empty, follows each line of a pose.
        if is_pose:
            fields = line.decode("utf-8", "replace").strip().split(maxsplit=9)
            if not fields:
                continue
            try:
                _, *values, camera = (float(field) for field in fields[:9])
                yield fields[9], values, int(camera)
            except (ValueError, IndexError, OverflowError):
                raise _damaged(path, f"line {number} is not an image: {line[:40]!r}") from None
        elif (words := line.split()) and (len(words) % 3 or not words[-1].lstrip(b"-").isdigit()):
            remedy = "write the features of an image, or an empty line, below its pose"
            raise DataError(path, f"line {number} holds no features x y POINT3D_ID: {line[:40]!r}", remedy)
        is_pose = not is_pose
    raise _damaged(path, f"it has more than {_MAX_IMAGES:,} images")


def _damaged(path: Path, problem: str) -> DataError:
    return DataError(path, f"not a COLMAP model ({problem})", "copy it again")
