"""The AE-NeRF model: two-stage event radiance field, its losses and its pictures."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import torch
import torch.nn.functional as F
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.rays import RayBundle, RaySamples
from nerfstudio.configs.config_utils import to_immutable_dict
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.field_components.encodings import NeRFEncoding
from nerfstudio.field_components.field_heads import FieldHeadNames
from nerfstudio.field_components.spatial_distortions import SceneContraction, SpatialDistortion
from nerfstudio.fields.base_field import Field
from nerfstudio.model_components.losses import distortion_loss, interlevel_loss
from nerfstudio.model_components.ray_samplers import ProposalNetworkSampler, UniformSampler
from nerfstudio.model_components.renderers import AccumulationRenderer, DepthRenderer
from nerfstudio.model_components.scene_colliders import NearFarCollider
from nerfstudio.models.base_model import Model, ModelConfig
from nerfstudio.utils import colormaps
from nerfstudio.utils.misc import scale_dict
from torch import Tensor, nn
from torch.nn import Parameter

from aenerf_ns.camera.image_encoding import ImageEncoding, decode, encode, to_channels
from aenerf_ns.camera.ray_tags import CAMERA_DIRECTIONS
from aenerf_ns.events.sensor import SensorModel
from aenerf_ns.method.box_collider import BoxCollider
from aenerf_ns.method.color_correction import COLOR_CORRECTIONS, ColorCorrection, ColorCorrectionProtocol
from aenerf_ns.method.encoding.hash_grid import HashEncoding
from aenerf_ns.method.field import DensityField, EventRadianceField, ProposalNetwork
from aenerf_ns.method.image_metrics import ImageMetrics
from aenerf_ns.method.pose_correction import PoseCorrection, PoseCorrectionConfig
from aenerf_ns.method.temporal import log_radiance_rate
from aenerf_ns.supervision.losses import log_radiance_change, reconstruction_loss, silent_change, temporal_loss
from aenerf_ns.supervision.sensor_parameters import SensorParameters

# ε of the paper's appendix "Model Architecture": the least radiance that can be rendered.
_RADIANCE_EPSILON = 1e-3


@dataclass
class AENeRFModelConfig(ModelConfig):
    """AE-NeRF. Options that begin with "hash:" or "mlp:" have no effect on the other backbone."""

    _target: type = field(default_factory=lambda: AENeRFModel)
    scene_contraction: Literal["auto", "l2", "linf", "none"] = "auto"
    """How unbounded space is contracted (paper, eq. 7: l2). "auto" is "none" for a dataset that states a scene box
    and "l2" for others."""
    near_plane: float = 0.05
    """Distance at which rays start, in scene units."""
    far_plane: float = 1000.0
    """Distance at which rays end in an unbounded scene, in scene units."""
    background: Literal["auto", "learned", "none"] = "auto"
    """Whether rays that pass the scene see a uniform background of learned radiance. "auto" is "learned" for a dataset
    that states a scene box and "none" for others."""
    backbone: Literal["hash", "mlp"] = "hash"
    """What field and proposal networks are: small networks on hash grids, with exponential density, or the paper's
    large networks on sinusoidal encodings, with softplus density."""
    num_levels: int = 16
    """hash: levels of the field's grid."""
    base_resolution: int = 16
    """hash: cells along an axis on its coarsest level."""
    max_resolution: int = 2048
    """hash: cells along an axis on its finest level."""
    log2_hashmap_size: int = 19
    """hash: binary logarithm of the entries of a level."""
    num_frequencies: int = 10
    """mlp: frequencies of the position's encoding, in octaves from one period across the box or contracted space."""
    num_hidden_layers: int = 1
    """Hidden layers of the field from the encoded position to density and feature."""
    hidden_dim: int = 64
    """Width of the field's hidden layers."""
    geometry_feature_dim: int = 15
    """Length of the feature that the radiance is computed from, with the view direction."""
    average_init_density: float = 0.01
    """Density before training."""
    num_proposal_samples_per_ray: tuple[int, ...] = (256, 96)
    """Samples of each round of proposals: of each hash proposal network, or of each evaluation of the one mlp."""
    num_nerf_samples_per_ray: int = 48
    """Samples of the field."""
    proposal_max_resolutions: tuple[int, ...] = (128, 256)
    """hash: cells along an axis on the finest level of each proposal network's grid; its length is their number."""
    proposal_num_levels: int = 5
    """hash: levels of the proposal networks' grids."""
    proposal_log2_hashmap_size: int = 17
    """hash: binary logarithm of the entries of a level there."""
    proposal_num_hidden_layers: int = 1
    """Hidden layers of the proposal networks."""
    proposal_hidden_dim: int = 16
    """Width of the proposal networks' hidden layers."""
    proposal_weights_anneal_iterations: int = 1000
    """Steps over which sampling turns from broad to following the proposal weights."""
    loss_coefficients: dict[str, float] = to_immutable_dict(
        {"reconstruction_loss": 1.0, "temporal_loss": 0.0, "interlevel_loss": 2.5e-3, "distortion_loss": 1e-3}
    )
    """Weights of the losses (paper, eq. 14: alpha, beta, gamma, eta). A weight of 0 turns a loss off. The paper's beta
    is 0.001; on hash grids it has not been seen to help."""
    learn_contrast_threshold_ratio: bool = False
    """Learn C+ / C-, from the dataset's values; C- stays."""
    learn_refractory_period: bool = False
    """Learn the time for which a pixel is blind after each event, from the dataset's value. At most the shortest
    interval between two events of a pixel."""
    camera_optimizer: PoseCorrectionConfig = field(default_factory=PoseCorrectionConfig)
    """Pose correction."""
    color_correction: ColorCorrectionProtocol = "affine"
    """How log-radiance becomes a picture: by an affine map per channel fitted on the validation views, or on the test
    views themselves (only to compare with figures that were made so), by a network fitted on the validation views
    (paper, eq. 15), or as it is."""
    color_correction_num_rays: int = 16384
    """Pixels, spread over all reference views it is fitted on, on which the colour correction is fitted."""
    lpips: bool = False
    """Also report LPIPS. It needs the AlexNet weights of torchvision, which are downloaded on first use."""
    eval_num_rays_per_chunk: int = 1 << 13
    """Rays rendered at once outside training."""


class AENeRFModel(Model):
    """Renders radiance along event rays and compares its logarithm with the events.

    Needs the dataparser's metadata: ``sensor``, ``trajectory``, ``ground_truth``, ``camera_times``,
    ``image_encoding``, ``bounded``.
    """

    config: AENeRFModelConfig

    def populate_modules(self) -> None:
        """Builds the networks, the sampler and the colour correction."""
        metadata: dict[str, Any] = self.kwargs["metadata"]
        config = self.config
        bounded: bool = metadata["bounded"]
        self.sensor: SensorModel = metadata["sensor"]
        self.image_encoding: ImageEncoding = metadata["image_encoding"]
        contraction = config.scene_contraction
        if contraction == "auto":
            contraction = "none" if bounded else "l2"
        distortion = {"l2": SceneContraction(), "linf": SceneContraction(order=float("inf")), "none": None}[contraction]
        self.collider: nn.Module
        if distortion is None:
            self.collider = BoxCollider(self.scene_box, near_plane=config.near_plane)
        else:
            self.collider = NearFarCollider(config.near_plane, config.far_plane, reset_near_plane=False)

        build = {"hash": self._hash_networks, "mlp": self._mlp_networks}[config.backbone]
        self.field, proposal_networks = build(distortion)
        self.proposal_networks = nn.ModuleList(proposal_networks)
        self.density_fns = [network.density_fn for network in proposal_networks]
        if config.backbone == "mlp":
            self.density_fns *= len(config.num_proposal_samples_per_ray)
        self.proposal_sampler = ProposalNetworkSampler(
            num_nerf_samples_per_ray=config.num_nerf_samples_per_ray,
            num_proposal_samples_per_ray=config.num_proposal_samples_per_ray,
            num_proposal_network_iterations=len(self.density_fns),
            single_jitter=True,
            # In a bounded scene samples are spread evenly; else the framework's default, evenly and then in disparity.
            initial_sampler=UniformSampler(single_jitter=True) if distortion is None else None,
        )
        background = config.background if config.background != "auto" else ("learned" if bounded else "none")
        # softplus(0.54) = 1: of the size of the radiance before training.
        self.raw_background = (
            Parameter(torch.full((self.sensor.num_channels,), 0.54)) if background == "learned" else None
        )
        self.camera_optimizer: PoseCorrection = config.camera_optimizer.setup(
            num_cameras=self.num_train_data,
            device=self.kwargs.get("device", "cpu"),
            trajectory=deepcopy(metadata["trajectory"]),
            camera_times=metadata["camera_times"],
            ground_truth=deepcopy(metadata["ground_truth"]),
        )
        self.sensor_parameters = SensorParameters(
            self.sensor, config.learn_contrast_threshold_ratio, config.learn_refractory_period
        )
        self.color_correction = self.new_color_correction(config.color_correction)
        self.renderer_accumulation = AccumulationRenderer()
        self.renderer_depth = DepthRenderer(method="median")
        self.image_metrics = ImageMetrics(with_lpips=config.lpips)

    def _hash_networks(self, distortion: SpatialDistortion | None) -> tuple[EventRadianceField, list[Field]]:
        """The field on a hash grid, and the framework's proposal networks."""
        config = self.config
        radiance_field = EventRadianceField(
            self.scene_box.aabb,
            num_channels=self.sensor.num_channels,
            spatial_distortion=distortion,
            encoding=HashEncoding(
                num_levels=config.num_levels,
                min_res=config.base_resolution,
                max_res=config.max_resolution,
                log2_hashmap_size=config.log2_hashmap_size,
            ),
            num_hidden_layers=config.num_hidden_layers,
            hidden_dim=config.hidden_dim,
            geometry_feature_dim=config.geometry_feature_dim,
            radiance_num_hidden_layers=2,
            radiance_hidden_dim=config.hidden_dim,
            density_activation="exp",
            average_init_density=config.average_init_density,
        )
        return radiance_field, [
            ProposalNetwork(
                self.scene_box.aabb,
                spatial_distortion=distortion,
                num_levels=config.proposal_num_levels,
                max_res=resolution,
                log2_hashmap_size=config.proposal_log2_hashmap_size,
                num_layers=config.proposal_num_hidden_layers + 1,
                hidden_dim=config.proposal_hidden_dim,
                average_init_density=config.average_init_density,
            )
            for resolution in config.proposal_max_resolutions
        ]

    def _mlp_networks(self, distortion: SpatialDistortion | None) -> tuple[EventRadianceField, list[Field]]:
        """The paper's vanilla e-NeRF, and its one proposal e-NeRF (appendix "Model Architecture")."""
        config = self.config
        # On a position in [0, 1], which the framework's encoding multiplies by 2π: NeRF's frequencies on [-1, 1].
        encoding = NeRFEncoding(
            in_dim=3,
            num_frequencies=config.num_frequencies,
            min_freq_exp=0.0,
            max_freq_exp=config.num_frequencies - 1.0,
            include_input=True,
            implementation="torch",
        )
        radiance_field = EventRadianceField(
            self.scene_box.aabb,
            num_channels=self.sensor.num_channels,
            spatial_distortion=distortion,
            encoding=encoding,
            num_hidden_layers=config.num_hidden_layers,
            hidden_dim=config.hidden_dim,
            geometry_feature_dim=config.geometry_feature_dim,
            # As in NeRF and Mip-NeRF 360, whatever the width of the rest.
            radiance_num_hidden_layers=1,
            radiance_hidden_dim=128,
            density_activation="softplus",
            average_init_density=config.average_init_density,
        )
        proposal_network = DensityField(
            self.scene_box.aabb,
            spatial_distortion=distortion,
            encoding=encoding,
            num_hidden_layers=config.proposal_num_hidden_layers,
            hidden_dim=config.proposal_hidden_dim,
            feature_dim=0,
            density_activation="softplus",
            average_init_density=config.average_init_density,
        )
        return radiance_field, [proposal_network]

    def get_param_groups(self) -> dict[str, list[Parameter]]:
        """Hash tables (and the background), if there are any, apart from the networks, which alone get weight decay."""
        groups: dict[str, list[Parameter]] = {"encodings": [], "networks": []}
        for module in (self.field, self.proposal_networks):
            for name, parameter in module.named_parameters():
                groups["encodings" if name.endswith("hash_table") else "networks"].append(parameter)
        if self.raw_background is not None:
            groups["encodings"].append(self.raw_background)
        if not groups["encodings"]:
            # torch.optim refuses a group without parameters.
            del groups["encodings"]
        self.camera_optimizer.get_param_groups(groups)
        learned = list(self.sensor_parameters.parameters())
        if learned:
            groups["sensor"] = learned
        return groups

    def get_training_callbacks(
        self, training_callback_attributes: TrainingCallbackAttributes
    ) -> list[TrainingCallback]:
        """Schedules the proposal sampler as the framework's own methods do."""

        def set_anneal(step: int) -> None:
            # https://arxiv.org/pdf/2111.12077.pdf, eq. 18
            progress = min(step / max(self.config.proposal_weights_anneal_iterations, 1), 1.0)
            slope = 10.0
            self.proposal_sampler.set_anneal(slope * progress / ((slope - 1) * progress + 1))

        return [
            TrainingCallback([TrainingCallbackLocation.BEFORE_TRAIN_ITERATION], set_anneal, update_every_num_iters=1),
            TrainingCallback(
                [TrainingCallbackLocation.AFTER_TRAIN_ITERATION],
                self.proposal_sampler.step_cb,
                update_every_num_iters=1,
            ),
        ]

    @property
    def uses_temporal_loss(self) -> bool:
        """Whether training batches must hold a third ray for each pair."""
        return self.config.loss_coefficients.get("temporal_loss", 0) > 0

    def forward(self, ray_bundle: RayBundle) -> dict[str, Any]:
        """Renders rays; those with times, of pairs of events, from the corrected poses."""
        learned: dict[str, Tensor] = {}
        if _is_of_pairs(ray_bundle):
            assert ray_bundle.times is not None
            # Here and not with the losses, for what the losses alone used would have no gradient on several processes.
            ratio = self.sensor_parameters.contrast_threshold_ratio
            if ratio is not None:
                learned["positive_contrast_threshold"] = ratio * self.sensor.negative_contrast_threshold
            period = self.sensor_parameters.refractory_period
            if period is not None:
                learned["interval_change"] = change = self.sensor.refractory_period * 1e-9 - period
                rays_per_pair = 3 if self.training and self.uses_temporal_loss else 2
                start, end, *within = ray_bundle.times.chunk(rays_per_pair)
                # Intervals start at the end of the refractory period, and what is drawn from them keeps its place.
                within = [end - (end - t) * (1 + change / (end - start)) for t in within]
                ray_bundle.times = torch.cat([start - change, end, *within])
            self.camera_optimizer.apply_to_raybundle(ray_bundle)
        return super().forward(ray_bundle) | learned

    def get_outputs_for_camera(self, camera: Cameras, obb_box: OrientedBox | None = None) -> dict[str, Tensor]:
        """Renders a camera; one of a reference image from where it is in the frame of the corrected poses."""
        moved = replace(camera, camera_to_worlds=self.camera_optimizer.apply_to_camera(camera))
        return super().get_outputs_for_camera(moved, obb_box)

    def get_outputs(self, ray_bundle: RayBundle) -> dict[str, Any]:
        """Renders rays.

        Returns:
            ``rgb`` (N, 3) colour-corrected display values, ``log_radiance`` (N, channels) the raw log L̂,
            ``accumulation`` (N, 1), ``depth`` (N, 1) median distance along the ray in scene units; and, while
            training, the samples and weights of both stages, and the ``log_radiance_rate`` (pairs, channels) of the
            last third of the rays.
        """
        samples, weights_list, samples_list = self.proposal_sampler(ray_bundle, density_fns=self.density_fns)
        outputs: dict[str, Any] = {}
        if self.training and self.uses_temporal_loss and _is_of_pairs(ray_bundle):
            within = slice(2 * len(ray_bundle) // 3, None)
            moving = ray_bundle[within]
            ends, weights_of_ends = self._composite(samples[: within.start])
            log_radiance, outputs["log_radiance_rate"], weights = log_radiance_rate(
                self._composite,
                samples[within],
                (moving.origins, moving.directions),
                self.camera_optimizer.ray_rates(moving),
            )
            log_radiance, weights = torch.cat([ends, log_radiance]), torch.cat([weights_of_ends, weights])
        else:
            log_radiance, weights = self._composite(samples)
        weights_list.append(weights)
        samples_list.append(samples)
        outputs["rgb"] = self.display(log_radiance.detach())
        outputs["log_radiance"] = log_radiance
        outputs["accumulation"] = self.renderer_accumulation(weights)
        with torch.no_grad():
            outputs["depth"] = self.renderer_depth(weights=weights, ray_samples=samples)
        if self.training:
            outputs["weights_list"] = weights_list
            outputs["ray_samples_list"] = samples_list
        return outputs

    def _composite(self, samples: RaySamples) -> tuple[Tensor, Tensor]:
        """Log-radiance (N, channels) and weights (N, samples, 1); in plain operations, for every differentiation."""
        field_outputs = self.field(samples)
        weights = samples.get_weights(field_outputs[FieldHeadNames.DENSITY])
        # Not the framework's RGBRenderer, which clips to [0, 1] outside training: radiance has no upper bound.
        radiance = (weights * field_outputs[FieldHeadNames.RGB]).sum(-2)
        if self.raw_background is not None:
            radiance = radiance + (1 - weights.sum(-2)) * F.softplus(self.raw_background)
        return torch.log(radiance + _RADIANCE_EPSILON), weights

    def get_loss_dict(
        self, outputs: dict[str, Any], batch: dict[str, Any], metrics_dict: dict[str, Tensor] | None = None
    ) -> dict[str, Tensor]:
        """The weighted terms of the paper's total loss (eq. 14) on a batch of the event ray sampler."""
        positive, negative = self._positive_contrast_threshold(outputs), self.sensor.negative_contrast_threshold
        mean_threshold = (positive + negative) / 2
        predicted, change = self._log_radiance_changes(outputs, batch)
        silent = silent_change(predicted, change, positive, negative)
        target = torch.where(batch["ends_between_events"], silent, change)
        losses = {"reconstruction_loss": reconstruction_loss(predicted, target, mean_threshold)}
        if self.training:
            if "log_radiance_rate" in outputs:
                rate = outputs["log_radiance_rate"].gather(1, batch["channel"][:, None])[:, 0]
                interval = batch["last_interval"] + outputs.get("interval_change", 0.0)
                change = self._change(outputs, batch["last_num_positive"], batch["last_num_negative"])
                losses["temporal_loss"] = temporal_loss(rate, change, interval)
            weights, samples = outputs["weights_list"], outputs["ray_samples_list"]
            losses["interlevel_loss"] = interlevel_loss(weights, samples) / mean_threshold**2
            losses["distortion_loss"] = distortion_loss(weights, samples)
            self.camera_optimizer.get_loss_dict(losses)
        return scale_dict(losses, self.config.loss_coefficients)

    def get_metrics_dict(self, outputs: dict[str, Any], batch: dict[str, Any]) -> dict[str, Any]:
        """How far the rendered changes of log-radiance agree with the events."""
        predicted, target = self._log_radiance_changes(outputs, batch)
        # Polarities that cancel have no sign to agree with, and what is known to a threshold may have either.
        signed = (target != 0) & ~batch["ends_between_events"]
        agreeing = (predicted.detach() * target > 0) & signed
        metrics: dict[str, Any] = {"polarity_agreement": agreeing.sum() / signed.sum().clamp_min(1)}
        self.camera_optimizer.get_metrics_dict(metrics)
        return metrics | self.sensor_parameters.learned()

    def _log_radiance_changes(self, outputs: dict[str, Any], batch: dict[str, Any]) -> tuple[Tensor, Tensor]:
        """Changes (N,) over a batch's intervals, as rendered, each of its pixel's channel, and as the events tell."""
        start, end = outputs["log_radiance"].split(len(batch["channel"]))[:2]
        predicted = (end - start).gather(1, batch["channel"][:, None])[:, 0]
        return predicted, self._change(outputs, batch["num_positive"], batch["num_negative"])

    def _change(self, outputs: dict[str, Any], num_positive: Tensor, num_negative: Tensor) -> Tensor:
        """The change of log-radiance (N,) that counts of events tell of."""
        positive, negative = self._positive_contrast_threshold(outputs), self.sensor.negative_contrast_threshold
        return log_radiance_change(num_positive, num_negative, positive, negative)

    def _positive_contrast_threshold(self, outputs: dict[str, Any]) -> Tensor | float:
        """C+, learned or given."""
        return outputs.get("positive_contrast_threshold", self.sensor.positive_contrast_threshold)

    def new_color_correction(self, protocol: ColorCorrectionProtocol) -> ColorCorrection:
        """A colour correction for this model's pictures, not yet fitted."""
        return COLOR_CORRECTIONS[protocol](self.sensor.num_channels, self.image_encoding)

    def reference_radiance(self, image: Tensor) -> Tensor:
        """Linear radiance (..., channels), as the sensor sees it, of reference image values (..., 3)."""
        return to_channels(decode(image[..., :3], self.image_encoding), self.sensor.num_channels)

    def reference_display(self, image: Tensor) -> Tensor:
        """Display values (..., 3), as the sensor sees it, of reference image values (..., 3)."""
        return _grey_to_rgb(encode(self.reference_radiance(image), self.image_encoding))

    def display(self, log_radiance: Tensor) -> Tensor:
        """Colour-corrected display values (..., 3) of rendered log-radiance (..., channels)."""
        return _grey_to_rgb(self.color_correction(log_radiance))

    def get_rgba_image(self, outputs: dict[str, Tensor], output_name: str = "rgb") -> Tensor:
        """Display values and opacity (..., 4): exporters leave out what is transparent."""
        return torch.cat([outputs[output_name], outputs["accumulation"].clamp(0, 1)], dim=-1)

    def get_image_metrics_and_images(
        self, outputs: dict[str, Tensor], batch: dict[str, Tensor]
    ) -> tuple[dict[str, float], dict[str, Tensor]]:
        """PSNR, SSIM (and LPIPS) of the display values against the reference, as the sensor sees it, side by side."""
        predicted = outputs["rgb"]
        reference = self.reference_display(batch["image"].to(predicted.device))
        images = {
            "img": torch.cat([reference, predicted], dim=1),
            "accumulation": colormaps.apply_colormap(outputs["accumulation"]),
            "depth": colormaps.apply_depth_colormap(outputs["depth"], accumulation=outputs["accumulation"]),
        }
        return self.image_metrics(predicted, reference), images

    @torch.no_grad()
    def render_log_radiance(self, rays: RayBundle) -> Tensor:
        """Log-radiance (N, channels) of rays, in evaluation mode and whatever the number of rays."""
        was_training = self.training
        self.eval()
        chunk = self.config.eval_num_rays_per_chunk
        rendered = [self(rays[begin : begin + chunk])["log_radiance"] for begin in range(0, len(rays), chunk)]
        self.train(was_training)
        return torch.cat(rendered)


def _is_of_pairs(ray_bundle: RayBundle) -> bool:
    """Whether rays are a batch of the event ray sampler. The framework's viewer gives its cameras times, too."""
    return CAMERA_DIRECTIONS in ray_bundle.metadata


def _grey_to_rgb(values: Tensor) -> Tensor:
    """(..., 3) of (..., channels), 1 or 3."""
    return values.expand(*values.shape[:-1], 3)
