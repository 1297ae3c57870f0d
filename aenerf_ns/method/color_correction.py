"""Color correction: from rendered log-radiance to a picture, by five named protocols.

Events determine log-radiance only up to an affine map per channel, so that map has to come from elsewhere.
"""

from __future__ import annotations

from itertools import pairwise
from typing import ClassVar, Literal

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.utils import skip_init

from aenerf_ns.camera.image_encoding import ImageEncoding, encode
from aenerf_ns.method.color_protocol import ColorCorrectionProtocol

# Added to radiance in [0, 1] before the logarithm, so that black reference pixels stay finite.
_EPSILON = 1e-3
# Without reference images: the share of pixels that may clip at either end, and the radiance the ends are mapped to.
_CLIPPED = 0.01
_DARK, _BRIGHT = 0.02, 0.9
# The network's hidden layers and how it is fitted.
_HIDDEN = (64, 64)
_STEPS = 300
_LEARNING_RATE = 1e-2


class NoColorCorrection(nn.Module):
    """Protocol ``none``: radiance is shown as it was rendered.

    Args:
        num_channels: radiance channels, 1 or 3.
        encoding: of the display values.
    """

    protocol: ClassVar[ColorCorrectionProtocol] = "none"
    description: ClassVar[str] = "none"
    """The protocol and what it was fitted on, in words."""
    fitted_on: ClassVar[str] = "nothing"
    """The views that the map was fitted on, in words: none."""

    def __init__(self, num_channels: int, encoding: ImageEncoding) -> None:
        super().__init__()
        self.encoding = encoding

    def forward(self, log_radiance: Tensor) -> Tensor:
        """Return display values in [0, 1] (..., channels) for rendered log-radiance (..., channels)."""
        return encode(torch.exp(log_radiance), self.encoding)


class AffineColorCorrection(nn.Module):
    """Protocol ``affine``: an affine map of log-radiance per channel (paper, "Color Correction of Synthesized Views").

    The map is fitted on the validation views and kept in checkpoints.

    Args:
        num_channels: radiance channels, 1 or 3.
        encoding: of the display values.
    """

    protocol: ClassVar[ColorCorrectionProtocol] = "affine"
    split: ClassVar[Literal["val", "test"]] = "val"
    """The reference views to fit on."""

    def __init__(self, num_channels: int, encoding: ImageEncoding) -> None:
        super().__init__()
        self.encoding = encoding
        self.scale: Tensor = nn.Buffer(torch.ones(num_channels))
        self.offset: Tensor = nn.Buffer(torch.zeros(num_channels))
        # Reference views the map was fitted on; 0 for the percentile stretch.
        self.num_views: Tensor = nn.Buffer(torch.zeros((), dtype=torch.int64))

    def forward(self, log_radiance: Tensor) -> Tensor:
        """Return display values in [0, 1] (..., channels) for rendered log-radiance (..., channels)."""
        return encode(torch.exp(self.scale * log_radiance + self.offset) - _EPSILON, self.encoding)

    @property
    def description(self) -> str:
        """The protocol and what it was fitted on, in words."""
        if self.num_views == 0:
            name = {"val": "validation", "test": "test"}[self.split]
            return f"percentile stretch, no {name} views (protocol {self.protocol})"
        warning = ", with a negative slope, as if the events' polarities were reversed" if self.is_reversed else ""
        return f"{self.protocol}, fitted on {self.fitted_on}{warning}"

    @property
    def is_reversed(self) -> bool:
        """Whether bright references were rendered dark, as they are if the polarities of the events are reversed."""
        return int(self.num_views) > 0 and float(self.scale.mean()) < 0

    @property
    def fitted_on(self) -> str:
        """The views that the map was fitted on, in words."""
        return f"{int(self.num_views)} validation views"

    @torch.no_grad()
    def fit(self, log_radiance: Tensor, reference: Tensor, num_views: int, rough: bool = False) -> None:
        """Fit log(reference + ε) to log-radiance by least squares, per channel, in float64.

        Args:
            log_radiance: (N, channels) rendered.
            reference: (N, channels) linear radiance in [0, 1] of the same pixels.
            num_views: number of reference views these pixels are from.
            rough: leave out whatever takes time. The affine fit takes next to none, so it is the same either way.
        """
        x, y = log_radiance.double(), torch.log(reference.double() + _EPSILON)
        x_mean, y_mean = x.mean(0), y.mean(0)
        # A constant rendering, such as before training, has no slope. Then only the offset is fitted.
        scale = ((x - x_mean) * (y - y_mean)).sum(0) / (x - x_mean).square().sum(0).clamp_min(1e-12)
        self.scale.copy_(scale)
        self.offset.copy_(y_mean - scale * x_mean)
        self.num_views.fill_(num_views)
        self._reset_rest()

    @torch.no_grad()
    def stretch(self, log_radiance: Tensor) -> None:
        """Map the 1st and the 99th percentile over all channels to dark and bright, without reference images.

        Args:
            log_radiance: (N, channels) rendered.
        """
        low, high = torch.quantile(
            log_radiance.double().flatten(), log_radiance.new_tensor([_CLIPPED, 1 - _CLIPPED]).double()
        )
        ends = torch.log(low.new_tensor([_DARK, _BRIGHT]) + _EPSILON)
        scale = (ends[1] - ends[0]) / (high - low).clamp_min(1e-6)
        self.scale.fill_(scale)
        self.offset.fill_(ends[0] - scale * low)
        self.num_views.zero_()
        self._reset_rest()

    def _reset_rest(self) -> None:
        """Set what a protocol adds to the affine map so that it adds nothing."""


class AffineTestColorCorrection(AffineColorCorrection):
    """Protocol ``affine-test``: the affine map, fitted on the views that are evaluated, as Robust e-NeRF does.

    Use it only to compare with figures that were made that way.
    """

    protocol = "affine-test"
    split = "test"

    @property
    def fitted_on(self) -> str:
        """The views that the map was fitted on, in words."""
        return f"the {int(self.num_views)} test views themselves"


class TranslatedGammaColorCorrection(AffineColorCorrection):
    """Protocol ``translated-gamma``: L_ref = b L̂ᵃ − c per channel, in linear radiance, as Deblur e-NeRF does.

    Cameras add a black level c to their images, which no affine map of log-radiance can express. The affine map is this
    map with c = ε, its ``scale`` is a and its ``offset`` is log b.
    """

    protocol = "translated-gamma"

    def __init__(self, num_channels: int, encoding: ImageEncoding) -> None:
        super().__init__(num_channels, encoding)
        self.black: Tensor = nn.Buffer(torch.full((num_channels,), _EPSILON))

    def forward(self, log_radiance: Tensor) -> Tensor:
        """Return display values in [0, 1] (..., channels) for rendered log-radiance (..., channels)."""
        return encode(torch.exp(self.scale * log_radiance + self.offset) - self.black, self.encoding)

    @property
    def description(self) -> str:
        """The protocol, what it was fitted on, and the exponents that were found, in words."""
        exponents = ", ".join(f"{exponent:.3f}" for exponent in self.scale.tolist())
        return super().description + (f", exponent a = {exponents}" if self.num_views else "")

    @torch.no_grad()
    def fit(self, log_radiance: Tensor, reference: Tensor, num_views: int, rough: bool = False) -> None:
        """Fit the reference radiance by least squares with the algorithm of Levenberg and Marquardt, per channel.

        The affine fit is the start. This takes milliseconds, so a rough fit is the same.
        """
        super().fit(log_radiance, reference, num_views)
        if len(reference) < 3:
            # Fewer pixels than unknowns.
            return
        start = torch.stack([self.scale, self.offset, self.black]).double().cpu().numpy()
        for channel, (x, y) in enumerate(zip(log_radiance.double().T, reference.double().T, strict=True)):
            fitted = _fit_translated_gamma(x.cpu().numpy(), y.cpu().numpy(), start[:, channel])
            for buffer, value in zip((self.scale, self.offset, self.black), fitted.tolist(), strict=True):
                buffer[channel] = value

    def _reset_rest(self) -> None:
        self.black.fill_(_EPSILON)


def _fit_translated_gamma(
    log_radiance: NDArray[np.float64], reference: NDArray[np.float64], start: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return a, log b and c of reference ≈ exp(a log_radiance + log b) − c, by least squares over (N,) values."""
    # Imported lazily: every ns-* command imports this module.
    from scipy.optimize import least_squares

    def residuals(unknowns: NDArray[np.float64]) -> NDArray[np.float64]:
        a, log_b, c = unknowns
        # A step that overflows is refused, because its sum of squares is infinite.
        with np.errstate(over="ignore"):
            return np.exp(a * log_radiance + log_b) - c - reference

    return least_squares(residuals, start, method="lm").x


class NetworkColorCorrection(AffineColorCorrection):
    """Protocol ``network``: the paper's learned F (eq. 15), from a pixel's log-radiance to its display values.

    F is the affine map plus a small network, whose output is added to the display values of the affine map.

    The weights of the network require no gradient, because :meth:`fit` learns them and training does not.
    """

    protocol = "network"

    def __init__(self, num_channels: int, encoding: ImageEncoding) -> None:
        super().__init__(num_channels, encoding)
        self.input_mean: Tensor = nn.Buffer(torch.zeros(num_channels))
        self.input_deviation: Tensor = nn.Buffer(torch.ones(num_channels))
        widths = (num_channels, *_HIDDEN, num_channels)
        layers: list[nn.Module] = []
        for num_inputs, num_outputs in pairwise(widths):
            # Bounded, so that radiance outside the range of the reference views is not sent astray.
            layers += [skip_init(nn.Linear, num_inputs, num_outputs), nn.Tanh()]
        self.network = nn.Sequential(*layers[:-1]).requires_grad_(False)
        self._reset_rest()

    def forward(self, log_radiance: Tensor) -> Tensor:
        """Return display values in [0, 1] (..., channels) for rendered log-radiance (..., channels)."""
        return (super().forward(log_radiance) + self._residual(log_radiance)).clamp(0, 1)

    @property
    def fitted_on(self) -> str:
        """The views that the map was fitted on, in words."""
        views = super().fitted_on
        *_, last_weight, _ = self.network.parameters()
        return views if last_weight.any() else f"{views}, its affine part only"

    def _residual(self, log_radiance: Tensor) -> Tensor:
        return self.network((log_radiance - self.input_mean) / self.input_deviation)

    @torch.no_grad()
    def fit(self, log_radiance: Tensor, reference: Tensor, num_views: int, rough: bool = False) -> None:
        """Fit the affine map, then, unless ``rough``, the network to the error of display values left, by Adam."""
        super().fit(log_radiance, reference, num_views)
        if rough:
            return
        log_radiance = log_radiance.detach()
        self.input_mean.copy_(log_radiance.mean(0))
        self.input_deviation.copy_(log_radiance.std(0, unbiased=False).clamp_min(1e-6))
        missing = encode(reference, self.encoding) - super().forward(log_radiance)
        with torch.enable_grad():
            parameters = self.network.requires_grad_().parameters()
            optimizer = torch.optim.Adam(parameters, lr=_LEARNING_RATE, fused=True)
            scheduler = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, _STEPS)
            for _ in range(_STEPS):
                F.mse_loss(self._residual(log_radiance), missing).backward()
                optimizer.step()
                scheduler.step()
                optimizer.zero_grad()
        self.network.requires_grad_(False)

    def _reset_rest(self) -> None:
        """Set the output to zero, which leaves the affine map, and the hidden layers to always the same weights."""
        # With a generator of its own: the choice of the protocol must not change the numbers that training draws.
        generator = torch.Generator().manual_seed(0)
        parameters = list(self.network.parameters())
        for weight, bias in zip(parameters[::2], parameters[1::2], strict=True):
            weight.copy_(torch.randn(weight.shape, generator=generator) / weight.shape[1] ** 0.5)
            bias.zero_()
        parameters[-2].zero_()


ColorCorrection = NoColorCorrection | AffineColorCorrection

COLOR_CORRECTIONS: dict[ColorCorrectionProtocol, type[ColorCorrection]] = {
    "affine": AffineColorCorrection,
    "affine-test": AffineTestColorCorrection,
    "translated-gamma": TranslatedGammaColorCorrection,
    "network": NetworkColorCorrection,
    "none": NoColorCorrection,
}
