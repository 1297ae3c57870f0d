"""The event radiance field, with density and unbounded positive radiance, and a field of density alone."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
import torch.nn.functional as F
from nerfstudio.cameras.rays import RaySamples
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.field_components.encodings import Encoding, NeRFEncoding
from nerfstudio.field_components.field_heads import FieldHeadNames
from nerfstudio.field_components.mlp import MLP
from nerfstudio.field_components.spatial_distortions import SpatialDistortion
from nerfstudio.fields.base_field import Field
from nerfstudio.fields.density_fields import HashMLPDensityField
from torch import Tensor, nn

from aenerf_ns.method.activation import SharpSoftplus
from aenerf_ns.method.hash_grid import HashEncoding, Implementation

# The framework's trunc_exp cuts gradients at the same value, but it overflows, and it is a custom function without
# forward-mode derivatives.
_MAX_LOG_DENSITY = 15.0

ToFieldSpace = Callable[[Tensor], Tensor]
"""Maps positions (..., 3) in the scene to those at which a field is looked up."""

# The hidden layer whose output the encoding is joined to (NeRF, https://arxiv.org/abs/2003.08934, fig. 7).
_SKIP_LAYER = 5


class IntegratedEncoding(NeRFEncoding):
    """Sines and cosines of positions in the unit cube, with 1, 2, 4, ... periods across it, and the positions.

    They are the mean values over the part of space that a sample stands for, as in Mip-NeRF: what varies within a
    sample averages out. Otherwise a field learns the highest frequencies first, as noise, because a change between two
    events is a derivative along the motion.

    The framework's own integration scales the positions by 2π, and the variances not.

    Args:
        num_frequencies: of the encoding, in octaves.
    """

    def __init__(self, num_frequencies: int) -> None:
        super().__init__(3, num_frequencies, 0.0, num_frequencies - 1.0, include_input=True)
        # Checkpoints of fields with a plain encoding fit otherwise, and would show other pictures.
        self.is_integrated: Tensor = nn.Buffer(torch.tensor(True))

    def pytorch_fwd(self, in_tensor: Tensor, covs: Tensor | None = None) -> Tensor:
        """Return features (N, 6 num_frequencies) of positions (N, 3), for Gaussians with variances (N, 3) by axis."""
        frequencies = 2 * math.pi * 2.0 ** torch.arange(self.num_frequencies, device=in_tensor.device)
        phases = (in_tensor[..., None] * frequencies).flatten(-2)
        values = torch.sin(torch.cat([phases, phases + math.pi / 2], -1))
        if covs is None:
            return values
        # Smaller exponents give denormal numbers, which slow a CPU down.
        exponents = (-0.5 * covs[..., None] * frequencies.square()).clamp_min(-40).flatten(-2)
        return values * exponents.exp().repeat(1, 2)


class DensityField(Field):
    """Density of space: an encoding of the position (γ_x of the paper, eq. 1) and a network.

    It can be differentiated as often as the encoding and the activation can. Weights start as those of PyTorch's own
    linear layers do, unless the maker starts them by another rule.

    Args:
        aabb: (2, 3) scene box, which bounds the scene where there is no spatial distortion.
        spatial_distortion: contraction of space to a ball or cube of radius 2, or None for a bounded scene.
        encoding: of positions in the contracted space or box, which is scaled to [0, 1] along each axis. With a hash
            encoding the density is an exponential, which is cut off at large exponents, else a softplus.
        to_field_space: of a :class:`.pose_following_warp.PoseFollowingWarp`; None for a field fixed in the scene.
        num_hidden_layers: number of hidden layers. Where there are more than five, the encoding is joined to the output
            of the fifth, as in NeRF.
        hidden_dim: width of the hidden layers.
        average_init_density: density where the network's output is 0, as it nearly is before training.
        feature_dim: length of the feature that is handed on with the density, 0 for none.
    """

    def __init__(
        self,
        aabb: Tensor,
        spatial_distortion: SpatialDistortion | None,
        encoding: Encoding,
        to_field_space: ToFieldSpace | None,
        num_hidden_layers: int,
        hidden_dim: int,
        average_init_density: float,
        feature_dim: int = 0,
    ) -> None:
        super().__init__()
        self.aabb: Tensor = nn.Buffer(aabb)
        self.to_field_space = to_field_space
        self.spatial_distortion = spatial_distortion
        self.average_init_density = average_init_density
        self.encoding = encoding
        self.density_network = MLP(
            in_dim=encoding.get_out_dim(),
            num_layers=num_hidden_layers + 1,
            layer_width=hidden_dim,
            out_dim=1 + feature_dim,
            skip_connections=(_SKIP_LAYER,) if num_hidden_layers > _SKIP_LAYER else None,
            activation=SharpSoftplus(),
        )

    def get_density(self, ray_samples: RaySamples) -> tuple[Tensor, Tensor]:
        """Return density (..., 1), zero outside the box of a bounded scene, and the feature (..., feature_dim)."""
        positions, inside = _unit_positions(self, ray_samples)
        inputs = [positions]
        if isinstance(self.encoding, IntegratedEncoding):
            inputs.append(_unit_variances(self, ray_samples))
        encoded = self.encoding(*(values.flatten(0, -2) for values in inputs))
        raw = self.density_network(encoded).unflatten(0, positions.shape[:-1])
        raw_density, feature = raw.split([1, raw.shape[-1] - 1], dim=-1)
        raw_density = raw_density.to(positions.dtype)
        if isinstance(self.encoding, HashEncoding):
            density = _exponential_density(raw_density, self.average_init_density)
        else:
            density = F.softplus(raw_density + math.log(math.expm1(self.average_init_density)))
        return density * inside, feature


class EventRadianceField(DensityField):
    """F_θ of the paper (eq. 1).

    The encoding of the view direction is sinusoidal, because the framework's spherical harmonics run without gradients.

    Args:
        feature_dim: length of the feature that is handed on with the density.
        num_channels: radiance channels of the sensor, 1 or 3.
        num_radiance_layers: hidden layers of the network from feature and view direction to radiance.
        radiance_dim: width of these layers.
        of_density: see :class:`DensityField`.
    """

    def __init__(
        self, *, feature_dim: int, num_channels: int, num_radiance_layers: int, radiance_dim: int, **of_density: Any
    ) -> None:
        super().__init__(feature_dim=feature_dim, **of_density)
        self.direction_encoding = NeRFEncoding(
            in_dim=3, num_frequencies=4, min_freq_exp=0.0, max_freq_exp=3.0, include_input=True
        )
        self.radiance_network = MLP(
            in_dim=self.direction_encoding.get_out_dim() + feature_dim,
            num_layers=num_radiance_layers + 1,
            layer_width=radiance_dim,
            out_dim=num_channels,
            activation=SharpSoftplus(),
        )

    def get_outputs(self, ray_samples: RaySamples, density_embedding: Tensor) -> dict[FieldHeadNames, Tensor]:
        """Return radiance (rays, samples, num_channels), positive and unbounded, by the framework's name for color."""
        # All samples of a ray have its direction, so the first layer's part for it is computed once a ray.
        directions = self.direction_encoding(ray_samples.frustums.directions[..., :1, :])
        first, *others = self.radiance_network.layers
        of_direction, of_feature = first.weight.split([directions.shape[-1], density_embedding.shape[-1]], dim=1)
        raw = F.linear(density_embedding, of_feature) + F.linear(
            directions.to(first.weight.dtype), of_direction, first.bias
        )
        for layer in others:
            raw = layer(self.radiance_network.activation(raw))
        return {FieldHeadNames.RGB: F.softplus(raw.to(directions.dtype))}


class ProposalNetwork(HashMLPDensityField):
    """Nerfstudio's proposal network on this package's hash encoding, with the density of the field.

    The framework's density is an exponential that overflows, and then its gradients are not finite.

    Args:
        aabb: (2, 3) scene box.
        grid_implementation: how the hash grid is computed, see :class:`.hash_grid.HashEncoding`.
        to_field_space: see :class:`DensityField`.
        options: of the framework's network, with ``num_levels``, ``max_res`` and ``log2_hashmap_size`` of its grid.
    """

    def __init__(
        self, aabb: Tensor, grid_implementation: Implementation, to_field_space: ToFieldSpace | None, **options: Any
    ) -> None:
        super().__init__(aabb, implementation="torch", **options)
        grid = {name: options[name] for name in ("num_levels", "max_res", "log2_hashmap_size")}
        self.encoding = self.mlp_base[0] = HashEncoding(grid_implementation, **grid)
        self.to_field_space = to_field_space

    def get_density(self, ray_samples: RaySamples) -> tuple[Tensor, None]:
        """Return density (..., 1), and no feature."""
        positions, inside = _unit_positions(self, ray_samples)
        raw = self.mlp_base(positions.flatten(0, -2)).unflatten(0, positions.shape[:-1])
        return _exponential_density(raw.to(positions.dtype), self.average_init_density) * inside, None


def _unit_positions(field: DensityField | ProposalNetwork, ray_samples: RaySamples) -> tuple[Tensor, Tensor]:
    """Return positions (..., 3) of samples in the unit cube, 0 outside the scene, and which (..., 1) are inside."""
    positions = ray_samples.frustums.get_positions()
    if field.to_field_space is not None:
        positions = field.to_field_space(positions)
    positions = to_unit_cube(positions, field.spatial_distortion, field.aabb)
    inside = ((positions > 0) & (positions < 1)).all(-1, keepdim=True)
    return positions * inside, inside


def _unit_variances(field: DensityField, ray_samples: RaySamples) -> Tensor:
    """Return variances (..., 3) along the unit cube's axes of the parts of space that samples stand for.

    A part is a segment of the ray, as wide as a pixel. Its length and width there are distances between mapped places.
    """
    frustums = ray_samples.frustums
    to_unit = partial(to_unit_cube, spatial_distortion=field.spatial_distortion, aabb=field.aabb)
    # Neighbors share an end.
    ends = torch.cat([frustums.starts, frustums.ends[..., -1:, :]], -2)
    along = to_unit(frustums.origins[..., :1, :] + frustums.directions[..., :1, :] * ends).diff(dim=-2)
    middles = frustums.get_positions()
    width = frustums.pixel_area.sqrt() * (frustums.starts + frustums.ends) / 2
    beside = to_unit(middles[..., None, :] + width[..., None] * torch.eye(3, device=width.device))
    across = beside - to_unit(middles)[..., None, :]
    # The variance of an even distribution is a twelfth of its squared length.
    return (along.square() + across.square().sum(-2)) / 12


def to_unit_cube(positions: Tensor, spatial_distortion: SpatialDistortion | None, aabb: Tensor) -> Tensor:
    """Return positions (..., 3) scaled to the unit cube: of the contracted space, or of the scene box without one."""
    if spatial_distortion is not None:
        return (spatial_distortion(positions) + 2) / 4
    return SceneBox.get_normalized_positions(positions, aabb)


def _exponential_density(raw: Tensor, average_init_density: float) -> Tensor:
    """Return the density for a network's output, not in half precision, whose exponential would overflow."""
    return average_init_density * torch.exp(raw.clamp(max=_MAX_LOG_DENSITY))
