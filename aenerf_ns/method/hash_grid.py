"""The multiresolution hash grid: in plain torch, and the choice of a faster implementation where one fits."""

from __future__ import annotations

from types import ModuleType
from typing import Any, Literal

import torch
import torch.autograd.forward_ad as forward_ad
from nerfstudio.field_components.encodings import HashEncoding as FrameworkHashEncoding
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from aenerf_ns.method.kernels.loader import is_float_in_memory, try_load

# https://arxiv.org/abs/2201.05989, eq. 4; the second is 2654435761 in 32 bits, where products wrap as they should.
_PRIMES = (1, 2654435761 - 2**32, 805459861)

Implementation = Literal["auto", "torch"]

# The modules of the fast implementations, which have the same functions.
_BY_DEVICE = {"cpu": f"{__package__}.kernels.hash_grid_numba", "cuda": f"{__package__}.kernels.hash_grid_triton"}


class HashEncoding(FrameworkHashEncoding):
    """Nerfstudio's hash encoding with two features a level: the same parameters and values, computed faster.

    The plain implementation can be differentiated in every mode, on every device and with every dtype. It looks up all
    corners of all levels at once, each as one complex number in place of two real ones. A one-dimensional lookup takes
    torch's quickest path, and it makes one gradient of the table instead of eight.

    The numba and Triton implementations compute in float32. They have first derivatives, and the rates of positions
    that move (``forward_ad.make_dual``) with the first derivatives of the rates.

    Args:
        implementation: "torch" is the plain one. "auto" takes numba on the CPU and Triton on NVIDIA GPUs for float32
            tensors outside ``torch.func``, and the plain one for everything else.
        options: the other options of the framework's encoding.
    """

    def __init__(self, implementation: Implementation = "auto", **options: Any) -> None:
        super().__init__(features_per_level=2, implementation="torch", **options)
        self._implementation = implementation
        primes = torch.tensor(_PRIMES, dtype=torch.int32)[:, None, None]
        self._primes: Tensor = nn.Buffer(primes, persistent=False)
        self._scales: Tensor = nn.Buffer(self.scalings[:, None], persistent=False)
        self._offsets: Tensor = nn.Buffer(self.hash_offset.to(torch.int32)[:, None], persistent=False)

    def pytorch_fwd(self, in_tensor: Tensor) -> Tensor:
        """Return features (N, 2 levels) of positions (N, 3) in [0, 1]."""
        chosen = self._choose(in_tensor)
        if chosen is None:
            return self._plain(in_tensor)
        # Outside forward mode, too: there the tangent is None.
        positions, tangents = forward_ad.unpack_dual(in_tensor)
        features, rates = _HashGrid.apply(positions, tangents, self.hash_table, self._scales.flatten(), chosen)
        return features if tangents is None else forward_ad.make_dual(features, rates)

    def _choose(self, positions: Tensor) -> ModuleType | None:
        """Return the implementation for the positions, None for the plain one."""
        # Without points a kernel has nothing to run on.
        if self._implementation == "torch" or len(positions) == 0:
            return None
        module = _BY_DEVICE.get(positions.device.type)
        fits = (
            is_float_in_memory(positions)
            and is_float_in_memory(self.hash_table)
            and forward_ad.unpack_dual(self.hash_table).tangent is None
        )
        return try_load(module, positions.device) if module is not None and fits else None

    def _plain(self, positions: Tensor) -> Tensor:
        scaled = positions.mT[:, None] * self._scales
        lower = scaled.detach().floor()
        products = lower.to(torch.int32) * self._primes
        x, y, z = torch.stack([products, products + self._primes], 1)
        corners = x[:, None, None] ^ y[:, None] ^ z
        index = (corners & (self.hash_table_size - 1)) + self._offsets
        table = torch.view_as_complex(self.hash_table)
        features = torch.view_as_real(table.index_select(0, index.flatten())).unflatten(0, index.shape)
        # Spelled out for both features: torch is slow at broadcasting along a short last axis.
        weights = (scaled - lower)[..., None].expand(*scaled.shape, 2).contiguous()
        for weight in weights:
            near, far = features.unbind(0)
            features = torch.lerp(near, far, weight)
        return features.transpose(0, 1).flatten(1)


class _HashGrid(torch.autograd.Function):
    """Compute features (N, 2 levels) and, where there are tangents, their rates (N, 2 levels).

    The backward pass computes corners and weights again, because keeping them takes a hundred bytes for each point and
    level. Only the arguments are kept.
    """

    @staticmethod
    def forward(
        ctx: Any, positions: Tensor, tangents: Tensor | None, table: Tensor, scales: Tensor, kernels: ModuleType
    ) -> tuple[Tensor, Tensor | None]:
        positions = positions.contiguous()
        tangents = None if tangents is None else tangents.contiguous()
        ctx.save_for_backward(positions, tangents, table, scales)
        ctx.kernels = kernels
        return kernels.features(positions, tangents, table, scales)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor, grad_rates: Tensor | None) -> tuple[Tensor | None, ...]:
        positions, tangents, table, scales = ctx.saved_tensors
        of_positions = ctx.needs_input_grad[0] or ctx.needs_input_grad[1]
        grad_rates = None if grad_rates is None else grad_rates.contiguous()
        to_table, to_positions, to_tangents = ctx.kernels.gradients(
            positions, tangents, table, scales, grad.contiguous(), grad_rates, of_positions
        )
        return to_positions, to_tangents, to_table, None, None
