"""The multiresolution hash encoding in plain torch, several times as fast as the framework's."""

from __future__ import annotations

from typing import Any

import torch
from nerfstudio.field_components.encodings import HashEncoding as FrameworkHashEncoding
from torch import Tensor

# https://arxiv.org/abs/2201.05989, eq. 4; the second is 2654435761 in 32 bits, where products wrap as they should.
_PRIMES = (1, 2654435761 - 2**32, 805459861)


class HashEncoding(FrameworkHashEncoding):
    """Nerfstudio's hash encoding with two features a level: the same parameters and values, computed in fewer passes.

    All corners of all levels are looked up at once, each as one complex number in place of two real ones. A
    one-dimensional lookup takes torch's quickest path, and it makes one gradient of the table instead of eight. All
    operations are plain, so the encoding can be differentiated in every mode.
    """

    _scales: Tensor
    _primes: Tensor
    _offsets: Tensor

    def __init__(self, **options: Any) -> None:
        super().__init__(features_per_level=2, implementation="torch", **options)
        for name, value in (
            ("_scales", self.scalings[:, None]),
            ("_primes", torch.tensor(_PRIMES, dtype=torch.int32)[:, None, None]),
            ("_offsets", self.hash_offset.to(torch.int32)[:, None]),
        ):
            self.register_buffer(name, value, persistent=False)

    def pytorch_fwd(self, in_tensor: Tensor) -> Tensor:
        """Return features (N, 2 levels) of positions (N, 3) in [0, 1]."""
        scaled = in_tensor.mT[:, None] * self._scales
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
