"""The field and the proposal networks of each backbone, and their options."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Literal

from nerfstudio.field_components.spatial_distortions import SpatialDistortion
from nerfstudio.fields.base_field import Field
from torch import Tensor, nn

from aenerf_ns.method.field import DensityField, EventRadianceField, IntegratedEncoding, ProposalNetwork
from aenerf_ns.method.hash_grid import HashEncoding, Implementation
from aenerf_ns.method.pose_following_warp import PoseFollowingWarp

Backbone = Literal["hash", "mlp"]


@dataclass
class FieldConfig:
    """The event radiance field. Options that begin with "hash:" or "mlp:" have no effect on the other backbone."""

    num_samples_per_ray: int = 48
    """Samples along a ray."""
    num_levels: int = 16
    """hash: levels of the grid."""
    base_resolution: int = 16
    """hash: cells along an axis on the coarsest level."""
    max_resolution: int = 2048
    """hash: cells along an axis on the finest level."""
    log2_hashmap_size: int = 19
    """hash: binary logarithm of the entries of a level."""
    grid_implementation: Implementation = "auto"
    """hash: how the grids of field and proposal networks are computed. "auto": by numba on the CPU and by Triton on
    NVIDIA GPUs where they are installed, else by torch. "torch": by torch, more slowly."""
    num_frequencies: int = 10
    """mlp: frequencies of the position's encoding, in octaves from one period across the box or contracted space."""
    num_hidden_layers: int = 1
    """Hidden layers from the encoded position to density and feature."""
    hidden_dim: int = 64
    """Width of the hidden layers."""
    geometry_feature_dim: int = 15
    """Length of the feature that the radiance is computed from, with the view direction."""
    xavier_initialization: bool = False
    """mlp: start the layers up to density and feature by Xavier's rule. PyTorch's own start, which is the paper's, lets
    hardly any gradient through many layers."""


@dataclass
class ProposalConfig:
    """The proposal networks. Options that begin with "hash:" have no effect on the other backbone."""

    num_samples_per_ray: tuple[int, ...] = (256, 96)
    """Samples of each round of proposals: of each hash network, or of each evaluation of the one mlp."""
    max_resolutions: tuple[int, ...] = (128, 256)
    """hash: cells along an axis on the finest level of each network's grid; there are as many networks."""
    num_levels: int = 5
    """hash: levels of the grids."""
    log2_hashmap_size: int = 17
    """hash: binary logarithm of the entries of a level."""
    num_hidden_layers: int = 1
    """Hidden layers of each network."""
    hidden_dim: int = 16
    """Width of the hidden layers."""
    weights_anneal_iterations: int = 1000
    """Steps over which sampling turns from broad to following the proposal weights."""


def make_networks(
    backbone: Backbone,
    field: FieldConfig,
    proposal: ProposalConfig,
    aabb: Tensor,
    spatial_distortion: SpatialDistortion | None,
    num_channels: int,
    average_init_density: float,
    warp: PoseFollowingWarp | None,
) -> tuple[EventRadianceField, list[Field]]:
    """Make the field, and the proposal networks in the order in which they are evaluated.

    Args:
        backbone: "hash", small networks on hash grids with exponential density; or "mlp", the paper's vanilla e-NeRF
            and its one proposal e-NeRF (appendix "Model Architecture"), with softplus density.
        field: options of the field.
        proposal: options of the proposal networks.
        aabb: (2, 3) scene box.
        spatial_distortion: contraction of space, or None for a bounded scene.
        num_channels: radiance channels of the sensor, 1 or 3.
        average_init_density: density before training.
        warp: moves the field along with the corrections of the poses, or None where poses are not corrected.
    """
    # The proposal networks only follow the field: gradients reach the motion of space by the field alone.
    field_warp, proposal_warp = (None, None) if warp is None else (warp.forward, partial(warp.forward, detached=True))
    encoding: HashEncoding | IntegratedEncoding
    if backbone == "hash":
        encoding = HashEncoding(
            num_levels=field.num_levels,
            min_res=field.base_resolution,
            max_res=field.max_resolution,
            log2_hashmap_size=field.log2_hashmap_size,
            implementation=field.grid_implementation,
        )
        num_radiance_layers, radiance_dim = 2, field.hidden_dim
    else:
        encoding = IntegratedEncoding(field.num_frequencies)
        # As in NeRF and Mip-NeRF 360, whatever the width of the rest.
        num_radiance_layers, radiance_dim = 1, 128
    radiance_field = EventRadianceField(
        aabb=aabb,
        spatial_distortion=spatial_distortion,
        encoding=encoding,
        to_field_space=field_warp,
        num_hidden_layers=field.num_hidden_layers,
        hidden_dim=field.hidden_dim,
        average_init_density=average_init_density,
        feature_dim=field.geometry_feature_dim,
        num_channels=num_channels,
        num_radiance_layers=num_radiance_layers,
        radiance_dim=radiance_dim,
    )
    if backbone == "hash":
        return radiance_field, [
            ProposalNetwork(
                aabb,
                spatial_distortion=spatial_distortion,
                num_levels=proposal.num_levels,
                max_res=resolution,
                log2_hashmap_size=proposal.log2_hashmap_size,
                grid_implementation=field.grid_implementation,
                to_field_space=proposal_warp,
                num_layers=proposal.num_hidden_layers + 1,
                hidden_dim=proposal.hidden_dim,
                average_init_density=average_init_density,
            )
            for resolution in proposal.max_resolutions
        ]
    if field.xavier_initialization:
        for layer in radiance_field.density_network.layers:
            nn.init.xavier_uniform_(layer.weight)
            nn.init.zeros_(layer.bias)
    # One network, which every round of proposals evaluates again.
    layers, width = proposal.num_hidden_layers, proposal.hidden_dim
    proposals = DensityField(aabb, spatial_distortion, encoding, proposal_warp, layers, width, average_init_density)
    return radiance_field, [proposals]
