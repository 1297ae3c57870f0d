"""The event radiance field: density and unbounded positive radiance on a hash grid."""

from __future__ import annotations

from typing import Any

import torch
from nerfstudio.cameras.rays import RaySamples
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.field_components.encodings import NeRFEncoding
from nerfstudio.field_components.field_heads import FieldHeadNames
from nerfstudio.field_components.mlp import MLP
from nerfstudio.field_components.spatial_distortions import SpatialDistortion
from nerfstudio.fields.base_field import Field
from nerfstudio.fields.density_fields import HashMLPDensityField
from torch import Tensor, nn

from aenerf_ns.hash_encoding import HashEncoding

# Larger exponents overflow half precision; the framework's trunc_exp cuts gradients at the same value, but is a custom
# function without forward-mode derivatives.
_MAX_LOG_DENSITY = 15.0


class EventRadianceField(Field):
    """F_θ of the paper (eq. 1), with a hash grid for γ_x.

    Differentiable as often as the hash grid is: hidden units are softplus with β = 100, which is smooth but as sharp
    as a rectifier, and the view direction's encoding is sinusoidal (the framework's spherical harmonics run without
    gradients).

    Args:
        aabb: (2, 3) scene box, which bounds the scene where there is no spatial distortion.
        num_channels: radiance channels of the sensor, 1 or 3.
        spatial_distortion: contraction of space to a ball or cube of radius 2, or None for a bounded scene.
        num_levels: levels of the hash grid.
        base_resolution: cells along an axis on the coarsest level.
        max_resolution: cells along an axis on the finest level.
        log2_hashmap_size: binary logarithm of the entries of a level.
        hidden_dim: width of the hidden layers.
        geometry_feature_dim: length of the feature handed from density to radiance.
        average_init_density: density before training.
    """

    aabb: Tensor

    def __init__(
        self,
        aabb: Tensor,
        num_channels: int,
        spatial_distortion: SpatialDistortion | None,
        num_levels: int,
        base_resolution: int,
        max_resolution: int,
        log2_hashmap_size: int,
        hidden_dim: int,
        geometry_feature_dim: int,
        average_init_density: float,
    ) -> None:
        super().__init__()
        self.register_buffer("aabb", aabb)
        self.spatial_distortion = spatial_distortion
        self.average_init_density = average_init_density
        self.encoding = HashEncoding(
            num_levels=num_levels,
            min_res=base_resolution,
            max_res=max_resolution,
            log2_hashmap_size=log2_hashmap_size,
        )
        self.direction_encoding = NeRFEncoding(
            in_dim=3, num_frequencies=4, min_freq_exp=0.0, max_freq_exp=3.0, include_input=True, implementation="torch"
        )
        self.density_network = MLP(
            in_dim=self.encoding.get_out_dim(),
            num_layers=2,
            layer_width=hidden_dim,
            out_dim=1 + geometry_feature_dim,
            activation=nn.Softplus(beta=100),
            implementation="torch",
        )
        self.radiance_network = MLP(
            in_dim=self.direction_encoding.get_out_dim() + geometry_feature_dim,
            num_layers=3,
            layer_width=hidden_dim,
            out_dim=num_channels,
            activation=nn.Softplus(beta=100),
            out_activation=nn.Softplus(),
            implementation="torch",
        )

    def get_density(self, ray_samples: RaySamples) -> tuple[Tensor, Tensor]:
        """Density (..., 1) and the feature (..., geometry_feature_dim) for the radiance."""
        positions = ray_samples.frustums.get_positions()
        if self.spatial_distortion is not None:
            positions = (self.spatial_distortion(positions) + 2) / 4
        else:
            positions = SceneBox.get_normalized_positions(positions, self.aabb)
        inside = ((positions > 0) & (positions < 1)).all(-1, keepdim=True)
        encoded = self.encoding((positions * inside).flatten(0, -2))
        raw = self.density_network(encoded).unflatten(0, positions.shape[:-1])
        log_density, feature = raw[..., :1], raw[..., 1:]
        density = self.average_init_density * torch.exp(log_density.clamp(max=_MAX_LOG_DENSITY))
        return density * inside, feature

    def get_outputs(
        self, ray_samples: RaySamples, density_embedding: Tensor | None = None
    ) -> dict[FieldHeadNames, Tensor]:
        """Radiance (..., num_channels), positive and unbounded, under the framework's name for colour."""
        assert density_embedding is not None
        # All samples of a ray have its direction.
        directions = self.direction_encoding(ray_samples.frustums.directions[..., :1, :])
        directions = directions.expand(*density_embedding.shape[:-1], -1)
        return {FieldHeadNames.RGB: self.radiance_network(torch.cat([directions, density_embedding], -1))}


class ProposalNetwork(HashMLPDensityField):
    """Nerfstudio's proposal network on this package's hash encoding.

    Args:
        aabb: (2, 3) scene box.
        num_levels: levels of the hash grid.
        max_res: cells along an axis on the finest level.
        log2_hashmap_size: binary logarithm of the entries of a level.
        options: the framework's others.
    """

    def __init__(self, aabb: Tensor, num_levels: int, max_res: int, log2_hashmap_size: int, **options: Any) -> None:
        grid = {"num_levels": num_levels, "max_res": max_res, "log2_hashmap_size": log2_hashmap_size}
        super().__init__(aabb, implementation="torch", **grid, **options)
        self.encoding = self.mlp_base[0] = HashEncoding(**grid)
