"""The seam between events and the field: how a batch is drawn, and what its renderings are compared with.

A sampler and a supervision belong together: they share one type of batch. The sampler draws rays and says what the
sensor recorded of them; the supervision compares the rendered log-radiance with that. Everything else, the field, the
poses, the compositing and the evaluation, knows neither.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar

import torch
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.configs.base_config import InstantiateConfig
from torch import Tensor, nn

from aenerf_ns.errors import DataError
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.recording.dataset import EventDataset
from aenerf_ns.supervision.pixel_rays import PixelRays


@dataclass
class Batch:
    """What the sensor recorded of a batch's rays. Every field is a tensor with one row for each item of the batch."""

    def __len__(self) -> int:
        return len(getattr(self, fields(self)[0].name))

    def __getitem__(self, index: Tensor | slice) -> Any:
        """Return some of the items, as a batch of the same type."""
        return type(self)(**{entry.name: getattr(self, entry.name)[index] for entry in fields(self)})


@dataclass
class ChangeBatch(Batch):
    """The events of N pixels, each between two times. The rays at the first times come first, then those at the second.

    Attributes:
        num_positive: (N,) float, positive events after the first time up to the second; may be fractional.
        num_negative: (N,) float, negative events in the same time.
        channel: (N,) index of the radiance channel that the pixel sees.
    """

    num_positive: Tensor
    num_negative: Tensor
    channel: Tensor


@dataclass
class LossCoefficients:
    """Weights of the losses (paper, eq. 14), by their names. Losses that are not named have the weight 1."""

    reconstruction_loss: float = 1.0
    """Weight of the supervision's main loss (paper: alpha)."""
    interlevel_loss: float = 2.5e-3
    """Weight of the loss that trains the proposal networks (paper: gamma). It is divided by the squared mean contrast
    threshold."""
    distortion_loss: float = 1e-3
    """Weight of the loss that draws matter together along a ray (paper: eta)."""


@dataclass
class SupervisionConfig(InstantiateConfig):
    """How renderings are compared with the sensor's record."""

    _target: type = field(default_factory=lambda: Supervision)


class Supervision(nn.Module, ABC):
    """Compares the renderings of a batch with what the sensor recorded.

    Its parameters are those that are learned of the sensor. They get the optimizer named ``sensor``.

    Args:
        config: the options of the supervision.
        sensor: the dataset's.
        loss_coefficients: weights of the losses.

    Attributes:
        batch_type: the batches that are understood.
    """

    batch_type: ClassVar[type[Batch]]

    def __init__(self, config: SupervisionConfig, sensor: SensorModel, loss_coefficients: LossCoefficients) -> None:
        super().__init__()
        self.config = config
        self.sensor = sensor
        self.loss_coefficients = loss_coefficients

    def prepare(self, dataset: EventDataset) -> None:
        """Take from the training data what the supervision needs before the first step.

        Raises:
            DataError: the data cannot be used.
        """

    def shift_ray_times(self, rays: RayBundle) -> dict[str, Tensor]:
        """Move the rays of a batch in time, before pose correction moves them in space.

        Called in the model's ``forward``: DistributedDataParallel synchronizes the gradients of parameters that
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
    def loss_unit(self, outputs: Mapping[str, Any]) -> Tensor | float:
        """Return the change of log-radiance that counts as one: the mean contrast threshold."""

    @abstractmethod
    def losses(self, outputs: Mapping[str, Any], batch: Any) -> dict[str, Tensor]:
        """Return the losses of a batch, without their weights.

        Args:
            outputs: of the model: ``log_radiance`` (rays, channels), while training ``log_radiance_rate``
                (rate rays, channels) per second if any were asked for, and what :meth:`shift_ray_times` returned.
            batch: as the sampler drew it, of type ``batch_type``.
        """

    def metrics(self, outputs: Mapping[str, Any], batch: Any) -> dict[str, Any]:
        """Return figures for the log that are no losses."""
        return {}

    def learned_values(self) -> dict[str, float]:
        """Return the values that are learned of the sensor, for logs and evaluations."""
        return {}


class ChangeSupervision(Supervision):
    """Compares rendered changes of log-radiance with the events of a pixel between two times."""

    @property
    def sensor_thresholds(self) -> tuple[float, float]:
        """The sensor's C₊ and C₋."""
        return self.sensor.positive_contrast_threshold, self.sensor.negative_contrast_threshold

    def thresholds(self, outputs: Mapping[str, Any]) -> tuple[Tensor | float, Tensor | float]:
        """Return the changes of log-radiance that a positive and a negative event stand for, both positive."""
        return self.sensor_thresholds

    def loss_unit(self, outputs: Mapping[str, Any]) -> Tensor | float:
        """Return C̄, the mean of the two contrast thresholds."""
        return sum(self.thresholds(outputs)) / 2

    def changes(self, outputs: Mapping[str, Any], batch: Any) -> tuple[Tensor, Tensor]:
        """Return the (N,) changes Δ between the two times: as rendered in the pixel's channel, and as the events say.

        They say Δ = n₊ C₊ − n₋ C₋ (paper, eq. 5).
        """
        first, second = outputs["log_radiance"].split(len(batch))[:2]
        rendered = (second - first).gather(1, batch.channel[:, None])[:, 0]
        positive, negative = self.thresholds(outputs)
        return rendered, batch.num_positive * positive - batch.num_negative * negative

    def has_sign(self, change: Tensor, batch: Any) -> Tensor:
        """Return whether the signs of (N,) changes are known. Polarities that cancel have none."""
        return change != 0

    def metrics(self, outputs: Mapping[str, Any], batch: ChangeBatch) -> dict[str, Any]:
        """Return the share of the pixels whose rendered change has the sign of their events."""
        rendered, change = self.changes(outputs, batch)
        signed = self.has_sign(change, batch)
        agreeing = (rendered.detach() * change > 0) & signed
        return {"polarity_agreement": agreeing.sum() / signed.sum().clamp_min(1)}


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
        DataError: the supervision needs batches of another type.

    Attributes:
        batch_type: the batches that are drawn.
        pixel_rays: the directions of the pixels, and the trajectory that times count from.
        num_rays_per_batch: the most rays of a training batch, which the datamanager sets.
    """

    batch_type: ClassVar[type[Batch]]
    num_rays_per_batch: int

    def __init__(
        self, config: SamplerConfig, dataset: EventDataset, supervision: Supervision, device: torch.device | str
    ) -> None:
        if self.batch_type is not supervision.batch_type:
            raise DataError(
                "the method's configuration",
                f"its sampler draws a {self.batch_type.__name__}, and its supervision compares a "
                f"{supervision.batch_type.__name__}",
                "give it a sampler and a supervision that belong together",
            )
        self.config = config
        self.dataset = dataset
        self.device = device
        self.pixel_rays = PixelRays(dataset.scene, device)

    def require_between(self, low: int, high: int, *options: str) -> None:
        """Raise a DataError unless each of the named options is a number from ``low`` to ``high``."""
        for option in options:
            value = getattr(self.config, option)
            if not low <= value <= high:
                name = option.replace("_", "-")
                raise DataError("the sampler", f"{name} is {value}", f"give a number from {low} to {high}")

    @abstractmethod
    def prepare(self) -> None:
        """Read the data now rather than with the first batch.

        Raises:
            DataError: the data cannot be used.
        """

    @abstractmethod
    def sample(self, num_rays: int, training: bool = True) -> tuple[RayBundle, Batch]:
        """Draw a batch.

        Args:
            num_rays: the most rays that the batch may have.
            training: whether the batch is trained on, or its loss only logged, without the rays that need rates.

        Returns:
            The rays, and what the sensor recorded of them. The rays are in the camera's frame: pose correction moves
            them to the world by their ``times`` (N, 1), in float64 seconds since the trajectory's start, and the
            :data:`~aenerf_ns.camera.metadata_keys.CAMERA_DIRECTIONS` among their metadata.
        """

    def residual_batch(self, num_rays: int) -> tuple[RayBundle, Any] | None:
        """Draw pairs of events to compare with renderings, the same in every call.

        Returns:
            As :meth:`sample` does, of pairs; None where batches are not of pairs.
        """
        return None
