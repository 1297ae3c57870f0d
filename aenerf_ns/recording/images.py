"""Checks of images: of those that are used as frames, and of reference images before Nerfstudio reads them."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from PIL import Image

from aenerf_ns.camera.intrinsics import CameraIntrinsics
from aenerf_ns.errors import DataError

# PIL reads many more formats. Some run other programs, such as Ghostscript.
_FORMATS = ("PNG", "JPEG")


def check_image(file: Path, camera: CameraIntrinsics) -> None:
    """Raise a DataError for an image that Nerfstudio cannot read, or would read wrongly."""
    size, mode = image_size_and_mode(file)
    if size != (camera.width, camera.height):
        raise DataError(
            file,
            f"the image has {size[0]} x {size[1]} pixels, its camera {camera.width} x {camera.height}",
            "give the intrinsics of the images as they are",
        )
    require_8_bits(mode, file)
    read_image(file)


def require_8_bits(mode: str, source: str | Path) -> None:
    """Raise a DataError unless PIL's mode of an image is 8 bits of gray or RGB, with or without an alpha channel."""
    if mode not in ("L", "RGB", "RGBA"):
        raise DataError(source, f"the image is of PIL's mode {mode}", "store 8 bits of gray or RGB")


def read_image(file: Path) -> Image.Image:
    """Return an image with its pixels.

    Raises:
        DataError: the file is missing, incomplete, or not a PNG or JPEG image.
    """
    with _opened(file) as image:
        image.load()
        return image


def image_size_and_mode(file: Path) -> tuple[tuple[int, int], str]:
    """Return width and height in pixels, and PIL's name of the pixels' format (such as "RGB").

    Raises:
        DataError: the file is missing or is not a PNG or JPEG image.
    """
    with _opened(file) as image:
        return image.size, image.mode


@contextmanager
def _opened(file: Path) -> Iterator[Image.Image]:
    try:
        with warnings.catch_warnings():
            # A warning of PIL is either harmless, or an error a moment later.
            warnings.simplefilter("ignore")
            with Image.open(file, formats=_FORMATS) as image:
                yield image
    # PIL's readers raise whatever they stumble over.
    except Exception as error:
        raise DataError(file, f"not a PNG or JPEG image that can be read ({error})", "copy it again") from None
