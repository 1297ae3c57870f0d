"""The event radiance field: density and unbounded positive radiance on a hash grid."""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
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

# The framework's trunc_exp cuts gradients at the same value, but is a custom function without forward-mode derivatives,
# and overflows.
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
            implementation="torch",
        )

    def get_density(self, ray_samples: RaySamples) -> tuple[Tensor, Tensor]:
        """Density (..., 1) and the feature (..., geometry_feature_dim) for the radiance."""
        positions, inside = _unit_positions(self, ray_samples)
        raw = self.density_network(self.encoding(positions.flatten(0, -2))).unflatten(0, positions.shape[:-1])
        return _density(raw[..., :1].to(positions.dtype), self.average_init_density) * inside, raw[..., 1:]

    def get_outputs(
        self, ray_samples: RaySamples, density_embedding: Tensor | None = None
    ) -> dict[FieldHeadNames, Tensor]:
        """Radiance (rays, samples, num_channels), positive and unbounded, under the framework's name for colour."""
        assert density_embedding is not None
        # All samples of a ray have its direction.
        directions = self.direction_encoding(ray_samples.frustums.directions[..., :1, :])
        raw = self.radiance_network(
            torch.cat([directions.expand(*density_embedding.shape[:-1], -1), density_embedding], -1)
        )
        return {FieldHeadNames.RGB: F.softplus(raw.to(directions.dtype))}


class ProposalNetwork(HashMLPDensityField):
    """Nerfstudio's proposal network on this package's hash encoding, with the density of the field.

    The framework's density is an exponential that overflows, with gradients that are then not finite.

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

    def get_density(self, ray_samples: RaySamples) -> tuple[Tensor, None]:
        """Density (..., 1), and no feature."""
        positions, inside = _unit_positions(self, ray_samples)
        raw = self.mlp_base(positions.flatten(0, -2)).unflatten(0, positions.shape[:-1])
        return _density(raw.to(positions.dtype), self.average_init_density) * inside, None


def _unit_positions(field: EventRadianceField | ProposalNetwork, ray_samples: RaySamples) -> tuple[Tensor, Tensor]:
    """Positions (..., 3) of samples in the unit cube, 0 for those outside the scene, and which (..., 1) are inside."""
    positions = ray_samples.frustums.get_positions()
    if field.spatial_distortion is not None:
        positions = (field.spatial_distortion(positions) + 2) / 4
    else:
        positions = SceneBox.get_normalized_positions(positions, field.aabb)
    inside = ((positions > 0) & (positions < 1)).all(-1, keepdim=True)
    return positions * inside, inside


def _density(raw: Tensor, average_init_density: float) -> Tensor:
    """Density of a network's output, which must not be in half precision: its exponential would overflow."""
    return average_init_density * torch.exp(raw.clamp(max=_MAX_LOG_DENSITY))
