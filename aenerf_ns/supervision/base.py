"""The seam between events and the field: how a batch is drawn, and what its renderings are compared with.

A sampler and a supervision belong together: they share one kind of batch. The sampler draws rays and tells what the
sensor recorded of them; the supervision compares the rendered log-radiance with that. Everything else, the field, the
poses, the compositing and the evaluation, knows neither.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import torch
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.configs.base_config import InstantiateConfig
from torch import Tensor, nn

from aenerf_ns.errors import DataError
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.recording.dataset import EventDataset


@dataclass
class SupervisionConfig(InstantiateConfig):
    """How renderings are compared with the sensor's record."""

    _target: type = field(default_factory=lambda: Supervision)


class Supervision(nn.Module, ABC):
    """Compares the renderings of a batch with what the sensor recorded.

    Its parameters are those that are learned of the sensor. They get the optimizer named ``sensor``.

    Args:
        config: the options of the supervision.
        sensor: the dataset's contrast thresholds, refractory period and Bayer pattern.
        loss_coefficients: weights of all losses by their names; a loss that is not named has the weight 1.

    Attributes:
        batch: the kind of batch that is understood.
    """

    batch: ClassVar[str]

    def __init__(self, config: SupervisionConfig, sensor: SensorModel, loss_coefficients: Mapping[str, float]) -> None:
        super().__init__()
        self.config = config
        self.sensor = sensor
        self.loss_coefficients = loss_coefficients

    def prepare(self, dataset: EventDataset) -> None:
        """Take from the training data what the supervision needs before the first step.

        Raises:
            DataError: the data cannot be used.
        """

    def place(self, rays: RayBundle) -> dict[str, Tensor]:
        """Move the rays of a batch in time, before pose correction moves them in space.

        Called in the model's ``forward``: DistributedDataParallel synchronises the gradients of parameters that
        ``forward`` used, and of no others.

        Args:
            rays: of one batch, in the camera's frame; changed in place.

        Returns:
            Values with gradients that :meth:`losses` needs. They become outputs of the model.
        """
        return {}

    def num_rate_rays(self, num_rays: int) -> int:
        """Return how many rays at the end of a training batch of ``num_rays`` need the rate of their log-radiance."""
        return 0

    @abstractmethod
    def unit(self, outputs: Mapping[str, Any]) -> Tensor | float:
        """Return the change of log-radiance that counts as one: the mean contrast threshold."""

    @abstractmethod
    def losses(self, outputs: Mapping[str, Any], batch: Mapping[str, Any]) -> dict[str, Tensor]:
        """Return the losses of a batch, without their weights.

        Args:
            outputs: of the model: ``log_radiance`` (rays, channels), while training ``log_radiance_rate``
                (rate rays, channels) per second if any were asked for, and what :meth:`place` returned.
            batch: as the sampler drew it.
        """

    def metrics(self, outputs: Mapping[str, Any], batch: Mapping[str, Any]) -> dict[str, Any]:
        """Return figures for the log that are no losses."""
        return {}

    def learned(self) -> dict[str, float]:
        """Return the values that are learned of the sensor, for logs and evaluations."""
        return {}


@dataclass
class SamplerConfig(InstantiateConfig):
    """How batches are drawn."""

    _target: type = field(default_factory=lambda: Sampler)


class Sampler(ABC):
    """Draws batches of rays with what the sensor recorded of them.

    Args:
        config: the options of the sampler.
        dataset: the training data. It is read when :meth:`prepare` is called or the first batch is drawn.
        supervision: the supervision that the batches are for.
        device: of the batches.

    Raises:
        DataError: the supervision needs another kind of batch.

    Attributes:
        batch: the kind of batch that is drawn.
    """

    batch: ClassVar[str]

    def __init__(
        self, config: SamplerConfig, dataset: EventDataset, supervision: Supervision, device: torch.device | str
    ) -> None:
        if self.batch != supervision.batch:
            raise DataError(
                "the method's configuration",
                f"its sampler draws {self.batch} and its supervision compares {supervision.batch}",
                "give it a sampler and a supervision that belong together",
            )
        self.config = config
        self.dataset = dataset
        self.device = device

    @abstractmethod
    def prepare(self) -> None:
        """Read the data now rather than with the first batch.

        Raises:
            DataError: the data cannot be used.
        """

    @abstractmethod
    def sample(self, num_rays: int, training: bool = True) -> tuple[RayBundle, dict[str, Any]]:
        """Draw a batch.

        Args:
            num_rays: the most rays that the batch may have.
            training: whether the batch is trained on, or its loss only logged, without the rays that need rates.

        Returns:
            The rays, and what the sensor recorded of them. The rays are in the camera's frame: pose correction moves
            them to the world by their ``times`` (N, 1), in float64 seconds since the trajectory's start, and the
            :data:`~aenerf_ns.camera.metadata_keys.CAMERA_DIRECTIONS` among their metadata.
        """
