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
    with open_image(file) as image:
        if image.size != (camera.width, camera.height):
            raise DataError(
                file,
                f"the image has {image.width} x {image.height} pixels, its camera {camera.width} x {camera.height}",
                "give the intrinsics of the images as they are",
            )
        require_8_bits(image, file)
        image.load()


def require_8_bits(image: Image.Image, source: str | Path) -> None:
    """Raise a DataError unless an image has 8 bits of gray or RGB, with or without an alpha channel."""
    if image.mode not in ("L", "RGB", "RGBA"):
        raise DataError(source, f"the image is of PIL's mode {image.mode}", "store 8 bits of gray or RGB")


def read_image(file: Path) -> Image.Image:
    """Read an image with its pixels.

    Raises:
        DataError: the file is missing, incomplete, or not a PNG or JPEG image.
    """
    with open_image(file) as image:
        image.load()
        return image


@contextmanager
def open_image(file: Path) -> Iterator[Image.Image]:
    """Open an image, whose pixels are not read. Errors of reading it within the context become a DataError.

    Raises:
        DataError: the file is missing or is not a PNG or JPEG image.
    """
    try:
        with warnings.catch_warnings():
            # A warning of PIL is either harmless, or an error a moment later.
            warnings.simplefilter("ignore")
            with Image.open(file, formats=_FORMATS) as image:
                yield image
    except DataError:
        raise
    # PIL's readers raise whatever they stumble over.
    except Exception as error:
        remedy = "save it as PNG or JPEG, or copy it again if it is one"
        raise DataError(file, f"not a PNG or JPEG image that can be read ({error})", remedy) from None
