"""The AE-NeRF model: a two-stage event radiance field, its losses and its pictures."""

from __future__ import annotations

import dataclasses
import math
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Any

import torch
import torch.autograd.forward_ad as forward_ad
import torch.nn.functional as F
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.rays import RayBundle, RaySamples
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.field_components.field_heads import FieldHeadNames
from nerfstudio.field_components.spatial_distortions import SceneContraction
from nerfstudio.model_components import renderers
from nerfstudio.model_components.losses import interlevel_loss
from nerfstudio.model_components.ray_samplers import UniformSampler
from nerfstudio.model_components.renderers import DepthRenderer
from nerfstudio.model_components.scene_colliders import NearFarCollider
from nerfstudio.models.base_model import Model, ModelConfig
from nerfstudio.utils import colormaps
from nerfstudio.utils.misc import scale_dict
from torch import Tensor, nn
from torch.nn import Parameter

from aenerf_ns.camera.image_encoding import decode, encode, to_channels
from aenerf_ns.camera.metadata_keys import CAMERA_DIRECTIONS
from aenerf_ns.errors import DataError
from aenerf_ns.method.box_collider import BoxCollider
from aenerf_ns.method.color_correction import COLOR_CORRECTIONS, ColorCorrection
from aenerf_ns.method.color_protocol import ColorCorrectionProtocol
from aenerf_ns.method.image_metrics import ImageMetrics
from aenerf_ns.method.networks import Backbone, FieldConfig, ProposalConfig, make_networks
from aenerf_ns.method.pose_correction import PoseCorrection, PoseCorrectionConfig
from aenerf_ns.method.pose_following_warp import PoseFollowingWarp
from aenerf_ns.method.ray_losses import distortion_loss
from aenerf_ns.method.ray_samplers import ProposalSampler
from aenerf_ns.recording.scene import SCENE_KEY, SceneRecording
from aenerf_ns.supervision.base import Batch, LossCoefficients, Supervision, SupervisionConfig
from aenerf_ns.supervision.event_pairs import PairLossCoefficients, PairSupervisionConfig

# ε of the paper's appendix "Model Architecture": the least radiance that is rendered.
_RADIANCE_EPSILON = 1e-3
# Beyond some 1.7e7 units, float32 rounds the sampler's last sample to infinity, where it counts for nothing.
_MAX_FAR_PLANE = 1e7
# The error of a display value that has the last color of the error's color map.
_MAX_SHOWN_ERROR = 0.5

# Share of a run in which the warp counts rays, and the steps between two updates of its weights. An update moves the
# field a little, so the weights must stay for the rest of the run.
_ACCUMULATION_SHARE, _UPDATE_INTERVAL = 0.3, 8

# Room on each side of the scene box, as a share of its longest side, for poses that are corrected. A place that
# leaves the field's box has no density, so events at the border of a tight box would hold the poses back.
_ROOM = 0.05


@dataclass
class AENeRFModelConfig(ModelConfig):
    """AE-NeRF."""

    _target: type = dataclasses.field(default_factory=lambda: AENeRFModel)
    near_plane: float = 0.05
    """Distance at which rays start, in scene units."""
    far_plane: float = 1000.0
    """Distance at which rays end in an unbounded scene, in scene units."""
    backbone: Backbone = "hash"
    """Kind of field and proposal networks. "hash": small networks on hash grids, with exponential density. "mlp": the
    paper's kind of networks, with softplus density; their sinusoidal encodings are integrated, which the paper's are
    not."""
    field: FieldConfig = dataclasses.field(default_factory=FieldConfig)
    """The event radiance field."""
    proposal: ProposalConfig = dataclasses.field(default_factory=ProposalConfig)
    """The proposal networks."""
    average_init_density: float = 10.0
    """Density of field and proposal networks before training, per scene unit. A scene that starts nearly transparent
    sits in a fog for hundreds of steps, until matter grows out of it."""
    loss_coefficients: LossCoefficients = dataclasses.field(default_factory=PairLossCoefficients)
    """Weights of the losses (paper, eq. 14)."""
    supervision: SupervisionConfig = dataclasses.field(default_factory=PairSupervisionConfig)
    """How renderings are compared with the sensor's record. The datamanager's sampler draws the batches."""
    camera_optimizer: PoseCorrectionConfig = dataclasses.field(default_factory=PoseCorrectionConfig)
    """Correction of the estimated poses."""
    moving_field: bool = True
    """Whether field and proposal networks move along with the corrections of the poses. In the paper they do not."""
    color_correction: ColorCorrectionProtocol = "affine"
    """How log-radiance becomes a picture. "affine": by an affine map per channel, fitted on the validation views.
    "affine-test": by one fitted on the test views themselves, only to compare with figures that were made that way.
    "translated-gamma": by a power and a black level per channel, fitted on the validation views. "network": by a
    network fitted on the validation views (paper, eq. 15). "none": unchanged."""
    color_correction_num_rays: int = 16384
    """Pixels that the color correction is fitted on, spread over the reference views."""
    lpips: bool = False
    """Report LPIPS too. It needs torchvision's weights of AlexNet, which are downloaded on first use."""
    eval_num_rays_per_chunk: int = 1 << 13
    """Rays that are rendered at once outside training."""

    def options_of_weights(self) -> dict[str, Any]:
        """Return by their names the options with which weights of the same shapes show different scenes."""
        options: dict[str, Any] = {"average_init_density": self.average_init_density}
        if self.backbone == "hash":
            options["field.base_resolution"] = self.field.base_resolution
            options["field.max_resolution"] = self.field.max_resolution
            options["proposal.max_resolutions"] = tuple(self.proposal.max_resolutions)
        return options


class AENeRFModel(Model):
    """Renders radiance along event rays and compares its logarithm with the events.

    Needs the :class:`~aenerf_ns.recording.scene.SceneRecording` in the dataparser's metadata.
    """

    config: AENeRFModelConfig

    def populate_modules(self) -> None:
        """Build the networks, the samplers, the supervision and the color correction."""
        scene: SceneRecording = self.kwargs["metadata"][SCENE_KEY]
        config = self.config
        _require_possible(config, scene.trajectory.duration)
        self.sensor = scene.sensor
        self.image_encoding = scene.image_encoding
        # By the Euclidean norm (paper, eq. 7).
        distortion = None if scene.bounded else SceneContraction()
        self.collider: nn.Module
        if distortion is None:
            self.collider = BoxCollider(self.scene_box, near_plane=config.near_plane)
        else:
            self.collider = NearFarCollider(config.near_plane, config.far_plane, reset_near_plane=False)

        self.camera_optimizer: PoseCorrection = config.camera_optimizer.setup(
            num_cameras=self.num_train_data,
            device=self.kwargs.get("device", "cpu"),
            trajectory=deepcopy(scene.trajectory),
            camera_times=scene.camera_times,
            ground_truth=deepcopy(scene.ground_truth),
        )
        learned = self.camera_optimizer.is_learned
        aabb = _with_room(self.scene_box.aabb) if learned else self.scene_box.aabb
        moves = learned and config.moving_field
        self.warp = PoseFollowingWarp(self.camera_optimizer, distortion, aabb) if moves else None
        self.field, proposal_networks = make_networks(
            config.backbone,
            config.field,
            config.proposal,
            aabb,
            distortion,
            self.sensor.num_channels,
            config.average_init_density,
            self.warp,
        )
        self.proposal_networks = nn.ModuleList(proposal_networks)
        self.density_fns = [network.get_density for network in proposal_networks]
        if config.backbone == "mlp":
            self.density_fns *= len(config.proposal.num_samples_per_ray)
        self.proposal_sampler = ProposalSampler(
            num_nerf_samples_per_ray=config.field.num_samples_per_ray,
            num_proposal_samples_per_ray=config.proposal.num_samples_per_ray,
            single_jitter=True,
            # By default evenly up to a distance of 1, and then evenly in disparity.
            initial_sampler=UniformSampler(single_jitter=True) if distortion is None else None,
        )
        # The radiance that rays see behind a bounded scene. softplus(0.54) = 1 is near the radiance before training.
        self.raw_background = Parameter(torch.full((self.sensor.num_channels,), 0.54)) if scene.bounded else None
        self.supervision: Supervision = config.supervision.setup(
            sensor=self.sensor, loss_coefficients=config.loss_coefficients
        )
        self.color_correction = self.new_color_correction(config.color_correction)
        self.renderer_depth = DepthRenderer(method="median")
        self.image_metrics = ImageMetrics(with_lpips=config.lpips)

    def get_param_groups(self) -> dict[str, list[Parameter]]:
        """Return the parameters by optimizer: only the field's networks get weight decay.

        The proposal networks' gradients are small before training. Weight decay is larger, and would empty them.
        """
        groups: dict[str, list[Parameter]] = {"encodings": [], "networks": [], "proposals": []}
        for module, networks in ((self.field, "networks"), (self.proposal_networks, "proposals")):
            for name, parameter in module.named_parameters():
                groups["encodings" if name.endswith("hash_table") else networks].append(parameter)
        if self.raw_background is not None:
            groups["encodings"].append(self.raw_background)
        self.camera_optimizer.get_param_groups(groups)
        groups["sensor"] = list(self.supervision.parameters())
        # torch.optim refuses a group without parameters.
        return {name: parameters for name, parameters in groups.items() if parameters}

    def get_training_callbacks(
        self, training_callback_attributes: TrainingCallbackAttributes
    ) -> list[TrainingCallback]:
        """Return the callbacks that schedule the proposal sampler, as the framework's own methods do, and the warp."""
        last_accumulated = _ACCUMULATION_SHARE * training_callback_attributes.trainer.config.schedule_length

        def before_step(step: int) -> None:
            # https://arxiv.org/pdf/2111.12077.pdf, eq. 18
            progress = min(step / max(self.config.proposal.weights_anneal_iterations, 1), 1.0)
            slope = 10.0
            self.proposal_sampler.set_anneal(slope * progress / ((slope - 1) * progress + 1))
            if self.warp is not None:
                self.warp.accumulating = step < last_accumulated
                if self.warp.accumulating and step % _UPDATE_INTERVAL == 0:
                    self.warp.update_weights()

        places = TrainingCallbackLocation
        return [
            TrainingCallback([places.BEFORE_TRAIN_ITERATION], before_step),
            TrainingCallback([places.AFTER_TRAIN_ITERATION], self.proposal_sampler.step_cb),
        ]

    def forward(self, ray_bundle: RayBundle) -> dict[str, Any]:
        """Render rays. Rays of a batch of the supervision's sampler are rendered from the corrected poses."""
        if not _is_of_batch(ray_bundle):
            return super().forward(ray_bundle)
        learned = self.supervision.shift_ray_times(ray_bundle)
        self.camera_optimizer.apply_to_raybundle(ray_bundle)
        return super().forward(ray_bundle) | learned

    def get_outputs_for_camera(self, camera: Cameras, obb_box: OrientedBox | None = None) -> dict[str, Tensor]:
        """Render a camera. The camera of a reference image is carried over to the frame of the corrected poses."""
        moved = replace(camera, camera_to_worlds=self.camera_optimizer.apply_to_camera(camera))
        return super().get_outputs_for_camera(moved, obb_box)

    def get_outputs_for_camera_ray_bundle(self, camera_ray_bundle: RayBundle) -> dict[str, Tensor]:
        """Render the rays of a picture. Around what is in a crop box is the crop's background color, if any."""
        outputs = super().get_outputs_for_camera_ray_bundle(camera_ray_bundle)
        nears, fars = camera_ray_bundle.nears, camera_ray_bundle.fars
        if nears is not None and fars is not None:
            # Rays that miss the box start and end at 1e10. In an unbounded scene, what they render is NaN.
            missed = (nears == fars)[..., 0]
            for name, picture in outputs.items():
                picture[missed] = self.config.far_plane if name == "depth" else 0.0
            if (color := renderers.BACKGROUND_COLOR_OVERRIDE) is not None:
                outputs["rgb"] = torch.lerp(color.to(outputs["rgb"]), outputs["rgb"], outputs["accumulation"])
        return outputs

    def get_outputs(self, ray_bundle: RayBundle) -> dict[str, Any]:
        """Render rays.

        Returns:
            ``log_radiance`` (N, channels), the raw log L̂. While training, also the samples and weights of both stages,
            and the ``log_radiance_rate`` (rate rays, channels) of the rays at the end of the batch that the supervision
            needs rates of. Otherwise also ``rgb`` (N, 3) color-corrected display values, ``uncorrected_rgb`` (N, 3)
            display values of the radiance as it was rendered, ``accumulation`` (N, 1) and ``depth`` (N, 1), the median
            distance along the ray in scene units; of a color sensor also ``mean_log_radiance`` (N, 1) of its channels.
        """
        if self.warp is not None:
            self.warp.update(self.camera_optimizer)
        samples, weights_list, samples_list = self.proposal_sampler(ray_bundle, density_fns=self.density_fns)
        outputs: dict[str, Any] = {}
        is_trained_on = self.training and _is_of_batch(ray_bundle)
        num_rates = self.supervision.num_rate_rays(len(ray_bundle)) if is_trained_on else 0
        if num_rates > 0:
            within = slice(len(ray_bundle) - num_rates, None)
            ends, weights_of_ends = self._composite(samples[: within.start])
            log_radiance, outputs["log_radiance_rate"], weights = self._composite_with_rate(
                samples[within], ray_bundle[within]
            )
            log_radiance, weights = torch.cat([ends, log_radiance]), torch.cat([weights_of_ends, weights])
        else:
            log_radiance, weights = self._composite(samples)
        if is_trained_on and self.warp is not None and self.warp.accumulating:
            self.warp.accumulate(samples.frustums.get_positions(), weights[..., 0], ray_bundle.times[:, 0])
        if self.training:
            outputs["log_radiance"] = log_radiance
            outputs["weights_list"] = [*weights_list, weights]
            outputs["ray_samples_list"] = [*samples_list, samples]
        else:
            # The viewer shows the first at the start, and lists the others in this order.
            outputs["rgb"] = self.display(log_radiance.detach())
            outputs["uncorrected_rgb"] = _gray_to_rgb(encode(log_radiance.detach().exp(), self.image_encoding))
            outputs["log_radiance"] = log_radiance
            if self.sensor.num_channels > 1:
                # The viewer takes three channels for a picture: it has color maps for single channels only.
                outputs["mean_log_radiance"] = log_radiance.mean(-1, keepdim=True)
            outputs["accumulation"] = weights.sum(-2)
            outputs["depth"] = self.renderer_depth(weights=weights, ray_samples=samples)
        return outputs

    def _composite(self, samples: RaySamples) -> tuple[Tensor, Tensor]:
        """Return log-radiance (N, channels) and weights (N, samples, 1), differentiable in every mode."""
        field_outputs = self.field(samples)
        weights = samples.get_weights(field_outputs[FieldHeadNames.DENSITY])
        # Not by the framework's RGBRenderer, which clips to [0, 1] outside training: radiance has no upper bound.
        radiance = (weights * field_outputs[FieldHeadNames.RGB]).sum(-2)
        if self.raw_background is not None:
            radiance = radiance + (1 - weights.sum(-2)) * F.softplus(self.raw_background)
        return torch.log(radiance + _RADIANCE_EPSILON), weights

    def _composite_with_rate(self, samples: RaySamples, rays: RayBundle) -> tuple[Tensor, Tensor, Tensor]:
        """Return log-radiance (N, channels), G_pred of the paper (before eq. 12) and weights (N, samples, 1).

        G_pred is the total derivative d log L̂ / dt, (N, channels) per second, while the rays of a batch move with the
        corrected poses. Forward-mode automatic differentiation goes through the field and the compositing. The
        derivative is exact, but for a field that moves along: the place at which it looks up its motion is held
        constant. One ordinary backward pass then reaches the parameters of the field and of the rays' motion. The
        samples' distances along the ray are held constant.
        """
        rates = self.camera_optimizer.ray_rates(rays)
        # In full precision, because on a fine grid rates per second exceed the range of half precision.
        with torch.autocast(rays.origins.device.type, enabled=False), forward_ad.dual_level():
            origins, directions = (
                # Cloned, because the tangent of a part of a tensor would get memory for the whole.
                forward_ad.make_dual(value.clone(), rate)[:, None].expand_as(samples.frustums.origins)
                for value, rate in zip((rays.origins, rays.directions), rates, strict=True)
            )
            moving = replace(samples, frustums=replace(samples.frustums, origins=origins, directions=directions))
            log_radiance, weights = self._composite(moving)
            primal, rate = forward_ad.unpack_dual(log_radiance)
            return primal, rate, forward_ad.unpack_dual(weights).primal

    def get_loss_dict(
        self, outputs: dict[str, Any], batch: Batch, metrics_dict: dict[str, Tensor] | None = None
    ) -> dict[str, Tensor]:
        """Return the weighted terms of the paper's total loss (eq. 14) on a batch of the supervision's sampler."""
        losses = self.supervision.losses(outputs, batch)
        if self.training:
            weights, samples = outputs["weights_list"], outputs["ray_samples_list"]
            with torch.no_grad():
                # The proposals' loss must not drive thresholds that are learned.
                unit = self.supervision.loss_unit(outputs)
            losses["interlevel_loss"] = interlevel_loss(weights, samples) / unit**2
            losses["distortion_loss"] = distortion_loss(weights[-1], samples[-1])
            self.camera_optimizer.get_loss_dict(losses)
        return scale_dict(losses, vars(self.config.loss_coefficients))

    def get_metrics_dict(self, outputs: dict[str, Any], batch: Batch) -> dict[str, Any]:
        """Return the supervision's figures, the size of the pose corrections, and what is learned of the sensor."""
        metrics = self.supervision.metrics(outputs, batch)
        self.camera_optimizer.get_metrics_dict(metrics)
        return metrics | self.supervision.learned_values()

    def new_color_correction(self, protocol: ColorCorrectionProtocol) -> ColorCorrection:
        """Return a color correction for this model's pictures, not yet fitted."""
        return COLOR_CORRECTIONS[protocol](self.sensor.num_channels, self.image_encoding)

    def reference_radiance(self, image: Tensor) -> Tensor:
        """Return linear radiance (..., channels), as the sensor sees it, for reference image values (..., 3)."""
        return to_channels(decode(image[..., :3], self.image_encoding), self.sensor.num_channels)

    def reference_display(self, image: Tensor) -> Tensor:
        """Return display values (..., 3), as the sensor sees them, for reference image values (..., 3)."""
        return _gray_to_rgb(encode(self.reference_radiance(image), self.image_encoding))

    def display(self, log_radiance: Tensor) -> Tensor:
        """Return color-corrected display values (..., 3) for rendered log-radiance (..., channels)."""
        return _gray_to_rgb(self.color_correction(log_radiance))

    def get_rgba_image(self, outputs: dict[str, Tensor], output_name: str = "rgb") -> Tensor:
        """Return display values and opacity (..., 4): exporters leave out what is transparent."""
        return torch.cat([outputs[output_name], outputs["accumulation"].clamp(0, 1)], dim=-1)

    def get_image_metrics_and_images(
        self, outputs: dict[str, Tensor], batch: dict[str, Tensor]
    ) -> tuple[dict[str, float], dict[str, Tensor]]:
        """Return the metrics of the display values, and pictures with the reference beside the rendering.

        The reference is shown as the sensor sees it: gray for a monochrome sensor. The picture ``error`` shows the
        absolute difference of the display values, the mean over their channels, in the colors of viridis: from dark
        blue for 0 to yellow for 0.5 and more.
        """
        predicted = outputs["rgb"]
        reference = self.reference_display(batch["image"].to(predicted.device))
        error = (predicted - reference).abs().mean(-1, keepdim=True)
        images = {
            "img": torch.cat([reference, predicted], dim=1),
            "error": colormaps.apply_float_colormap((error / _MAX_SHOWN_ERROR).clamp(0, 1)),
            "accumulation": colormaps.apply_colormap(outputs["accumulation"]),
            "depth": colormaps.apply_depth_colormap(outputs["depth"], accumulation=outputs["accumulation"]),
        }
        return self.image_metrics(predicted, reference, batch.get("mask")), images

    @torch.no_grad()
    def render_rays(self, rays: RayBundle, *names: str) -> list[Tensor]:
        """Return the outputs (N, channels) with the given names of any number of rays, rendered in evaluation mode."""
        was_training = self.training
        self.eval()
        chunk = self.config.eval_num_rays_per_chunk
        rendered = [self(rays[begin : begin + chunk]) for begin in range(0, len(rays), chunk)]
        self.train(was_training)
        return [torch.cat([outputs[name] for outputs in rendered]) for name in names]


def _require_possible(config: AENeRFModelConfig, duration: float) -> None:
    """Raise a DataError for planes that no ray can meet, and for numbers that fit nothing.

    Args:
        config: of the model.
        duration: seconds of the trajectory.
    """
    near, far = config.near_plane, config.far_plane
    if not 0 <= near < far <= _MAX_FAR_PLANE:
        problem = f"near_plane {near:g} and far_plane {far:g}"
        raise DataError("model", problem, f"give a far plane above the near one, at most {_MAX_FAR_PLANE:g}")
    if config.color_correction_num_rays < 1:
        raise DataError("model", f"color_correction_num_rays {config.color_correction_num_rays}", "give thousands")
    rounds, networks = len(config.proposal.num_samples_per_ray), len(config.proposal.max_resolutions)
    if rounds == 0 or (config.backbone == "hash" and rounds != networks):
        problem = f"proposal.num_samples_per_ray has {rounds} values, proposal.max_resolutions {networks}"
        raise DataError("model", problem, "give as many of each, at least one")
    counts = {
        "eval_num_rays_per_chunk": config.eval_num_rays_per_chunk,
        "field.num_samples_per_ray": config.field.num_samples_per_ray,
        "field.num_levels": config.field.num_levels,
        "proposal.num_samples_per_ray": min(config.proposal.num_samples_per_ray),
        "proposal.num_levels": config.proposal.num_levels,
    }
    for name, count in counts.items():
        if count < 1:
            raise DataError("model", f"{name} {count}", "give one or more")
    if not 0 < config.camera_optimizer.knot_interval < math.inf:
        raise DataError("model", f"knot_interval {config.camera_optimizer.knot_interval:g}", "give seconds above 0")
    offset = config.camera_optimizer.clock_offset
    # Beyond it, all events would see the pose of one end.
    if offset is not None and not abs(offset) < duration:
        remedy = f"give seconds, fewer than the {duration:g} s of the trajectory"
        raise DataError("model", f"camera_optimizer.clock_offset {offset:g}", remedy)
    density = config.average_init_density
    # The start of the softplus overflows for larger ones.
    if not 0 < density < 700:
        raise DataError("model", f"average_init_density {density:g}", "give a number above 0 and below 700")


def _with_room(aabb: Tensor) -> Tensor:
    """Return a (2, 3) box that has room on each side for a scene whose poses are corrected."""
    room = _ROOM * (aabb[1] - aabb[0]).max()
    return torch.stack([aabb[0] - room, aabb[1] + room])


def _is_of_batch(ray_bundle: RayBundle) -> bool:
    """Whether rays are a batch of a sampler. Times alone do not tell: the viewer gives its cameras times, too."""
    return CAMERA_DIRECTIONS in ray_bundle.metadata


def _gray_to_rgb(values: Tensor) -> Tensor:
    """Return (..., 3) values for (..., channels) values of 1 or 3 channels."""
    return values.expand(*values.shape[:-1], 3)
