"""PSNR, SSIM and LPIPS, which is reported as absent where its weights cannot be had."""

from __future__ import annotations

import math

import torch
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor, nn

from aenerf_ns.errors import DataError

# SSIM's window of 11 pixels is mirrored at the edges.
_MIN_SIDE = 6
# PSNR, in dB, of pictures that are equal to the last bit. With infinity, the mean over views would be no number.
_MAX_PSNR = 100.0


class ImageMetrics:
    """PSNR, SSIM and, when asked for, LPIPS of an image.

    Args:
        with_lpips: whether to report LPIPS where its weights can be had. Its network is built on first use.

    Attributes:
        lpips_absent: why LPIPS is not reported, or None.
    """

    def __init__(self, with_lpips: bool) -> None:
        self._lpips: nn.Module | None = None
        self.lpips_absent: str | None = None if with_lpips else "not asked for (--pipeline.model.lpips True)"

    def __call__(self, predicted: Tensor, reference: Tensor, mask: Tensor | None = None) -> dict[str, float]:
        """Return the metrics of display values in [0, 1] by their names.

        Args:
            predicted: (H, W, 3).
            reference: (H, W, 3).
            mask: (H, W, 1) the pixels that count, by default all.

        Raises:
            DataError: the image is smaller than SSIM's window.
        """
        height, width = reference.shape[:2]
        if min(height, width) < _MIN_SIDE:
            remedy = f"give {_MIN_SIDE} or more, which SSIM needs"
            raise DataError("evaluation", f"images of {width} x {height} pixels", remedy)
        # Imported lazily: every ns-* command imports this module, and torchmetrics is slow to import.
        from torchmetrics.functional.image import peak_signal_noise_ratio, structural_similarity_index_measure

        # Pixels that do not count become equal to the reference. The means are then scaled to the other pixels.
        share = 1.0
        if mask is not None:
            predicted, share = torch.where(mask.to(predicted.device), predicted, reference), float(mask.float().mean())
        predicted, reference = (image.moveaxis(-1, 0)[None].float() for image in (predicted, reference))
        psnr = float(peak_signal_noise_ratio(predicted, reference, data_range=1.0)) + 10 * math.log10(share)
        ssim = float(torch.as_tensor(structural_similarity_index_measure(predicted, reference, data_range=1.0)))
        metrics = {"psnr": min(psnr, _MAX_PSNR), "ssim": 1 - (1 - ssim) / share if share < 1 else ssim}
        if self._lpips is None and self.lpips_absent is None:
            self._build_lpips(predicted.device)
        if self._lpips is not None:
            metrics["lpips"] = float(self._lpips(predicted, reference)) / share
        return metrics

    def _build_lpips(self, device: torch.device) -> None:
        from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

        try:
            # Building LPIPS draws random weights before it loads the trained ones, and draws more of them where the
            # trained ones can be had. The numbers that training draws must not depend on that.
            with torch.random.fork_rng(devices=[]):
                self._lpips = LearnedPerceptualImagePatchSimilarity(normalize=True).to(device)
        except Exception as error:
            # torch.hub passes on every error of its connection.
            self.lpips_absent = f"the weights of AlexNet could not be had ({error})"
            CONSOLE.print(f"[yellow]LPIPS is not reported: {self.lpips_absent}.")
