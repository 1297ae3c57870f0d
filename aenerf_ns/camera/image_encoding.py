"""Convert image values between linear radiance and its sRGB encoding for display (IEC 61966-2-1)."""

from __future__ import annotations

from typing import Any, Literal, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

# A monochrome sensor sees the Rec. 709 luminance of linear RGB.
LUMINANCE = (0.2126, 0.7152, 0.0722)


ImageEncoding = Literal["srgb", "linear"]
_Image = TypeVar("_Image", Tensor, NDArray[np.float64])


def decode(image: _Image, encoding: ImageEncoding) -> _Image:
    """Return linear radiance in [0, 1] of image values in [0, 1], a tensor or an array of any shape."""
    if encoding == "linear":
        return image
    where: Any = torch.where if isinstance(image, Tensor) else np.where
    return where(image <= 0.04045, image / 12.92, ((image + 0.055) / 1.055) ** 2.4)


def encode(radiance: Tensor, encoding: ImageEncoding) -> Tensor:
    """Return the image values in [0, 1] of linear radiance, which is clipped to [0, 1]."""
    radiance = radiance.clamp(0, 1)
    if encoding == "linear":
        return radiance
    return torch.where(
        radiance <= 0.0031308, radiance * 12.92, 1.055 * radiance.clamp_min(0.0031308) ** (1 / 2.4) - 0.055
    )


def to_channels(radiance: Tensor, num_channels: int) -> Tensor:
    """Return linear (..., 3) RGB as a sensor of 1 (luminance) or 3 channels sees it: (..., ``num_channels``)."""
    if num_channels == 3:
        return radiance
    return (radiance * radiance.new_tensor(LUMINANCE)).sum(-1, keepdim=True)
