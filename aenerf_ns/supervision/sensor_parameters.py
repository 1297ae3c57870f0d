"""The sensor's parameters that are learned with the scene: ratio of contrast thresholds, and refractory period."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from aenerf_ns.events.sensor import SensorModel


class SensorParameters(nn.Module):
    """Contrast threshold C+ and refractory period τ, each a parameter or a constant.

    Events leave the scale of log-radiance open, so only the ratio C+ / C− can be learned. C− keeps the given value.
    The ratio is a softplus, so it is positive. τ is a sigmoid times the shortest interval between two events of a
    pixel, because no refractory period can exceed that interval.

    Args:
        sensor: initial values.
        learn_contrast_threshold_ratio: whether C+ / C− is learned.
        learn_refractory_period: whether τ is learned.
    """

    def __init__(
        self, sensor: SensorModel, learn_contrast_threshold_ratio: bool, learn_refractory_period: bool
    ) -> None:
        super().__init__()
        self._sensor = sensor
        self.raw_ratio: nn.Parameter | None = None
        self.raw_refractory_period: nn.Parameter | None = None
        if learn_contrast_threshold_ratio:
            ratio = sensor.positive_contrast_threshold / sensor.negative_contrast_threshold
            # The inverse of softplus, exact for large ratios too.
            self.raw_ratio = nn.Parameter(torch.tensor(ratio + math.log(-math.expm1(-ratio))))
        if learn_refractory_period:
            self.raw_refractory_period = nn.Parameter(torch.tensor(0.0))
            # Kept in checkpoints, because events are read for training only.
            self._longest_refractory_period: Tensor = nn.Buffer(torch.tensor(torch.nan, dtype=torch.float64))

    @property
    def contrast_threshold_ratio(self) -> Tensor | None:
        """C+ / C−, a scalar with a gradient, or None where it is not learned."""
        return None if self.raw_ratio is None else F.softplus(self.raw_ratio)

    @property
    def refractory_period(self) -> Tensor | None:
        """τ in seconds, a float64 scalar with a gradient, or None where it is not learned."""
        if self.raw_refractory_period is None:
            return None
        return self._longest_refractory_period * torch.sigmoid(self.raw_refractory_period.double())

    def learned_values(self) -> dict[str, float]:
        """Return the values that are learned, by their names, for logs and evaluations."""
        values = {}
        if self.contrast_threshold_ratio is not None:
            values["contrast_threshold_ratio"] = self.contrast_threshold_ratio.item()
        if self.refractory_period is not None:
            values["refractory_period_ns"] = 1e9 * self.refractory_period.item()
        return values

    def bound_refractory_period(self, shortest_interval: int) -> None:
        """Set the bound of τ. Set τ to the sensor's value where that is positive, else to half of the bound.

        Args:
            shortest_interval: nanoseconds between two consecutive events of a pixel. It is longer than the sensor's
                refractory period.
        """
        assert self.raw_refractory_period is not None
        self._longest_refractory_period.fill_(shortest_interval * 1e-9)
        part = self._sensor.refractory_period / shortest_interval
        self.raw_refractory_period.data.fill_(math.log(part / (1 - part)) if part > 0 else 0.0)
