"""E2VID's and FireNet's networks, written anew from their descriptions and their weights files' names."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar

from torch import Tensor, nn

from aenerf_ns.reconstruction.layers import ConvGRU, ConvLayer, ConvLSTM, Recurrent, ResidualBlock, TransposedConvLayer

NUM_BINS = 5
"""Bins of time in the voxel grids that both networks were trained on."""


class ReconstructionNetwork(nn.Module, ABC):
    """Maps a voxel grid and the state after the grids before to an image and the next state.

    Attributes:
        multiple: height and width of the voxel grids must be multiples of this.
    """

    multiple: ClassVar[int]

    @abstractmethod
    def forward(self, voxels: Tensor, state: Any) -> tuple[Tensor, Any]:
        """Return an image and the state after it.

        Args:
            voxels: (N, 5, height, width) normalised voxel grids.
            state: after the grids before; None at the start.

        Returns:
            (N, 1, height, width) display values, in [0, 1] or about, and the state.
        """


class E2VID(ReconstructionNetwork):
    """The network of the weights file E2VID_lightweight.pth.tar (Rebecq et al., TPAMI 2021).

    A recurrent U-net: three encoders with a convolutional LSTM each, two residual blocks, and three decoders. Skip
    connections add features up.
    """

    multiple = 8

    def __init__(self) -> None:
        super().__init__()
        self.unetrecurrent = _RecurrentUNet()

    def forward(self, voxels: Tensor, state: Any) -> tuple[Tensor, Any]:
        """Return the image, in [0, 1], and the three encoders' states; see :class:`ReconstructionNetwork`."""
        return self.unetrecurrent(voxels, state)


class _RecurrentUNet(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        sizes = [(32, 64), (64, 128), (128, 256)]
        self.head = ConvLayer(NUM_BINS, 32, 5)
        self.encoders = nn.ModuleList(
            Recurrent(ConvLayer(small, large, 5, stride=2, normalize=True), ConvLSTM(large)) for small, large in sizes
        )
        self.resblocks = nn.ModuleList(ResidualBlock(256, normalize=True) for _ in range(2))
        self.decoders = nn.ModuleList(TransposedConvLayer(large, small) for small, large in reversed(sizes))
        self.pred = ConvLayer(32, 1, 1, normalize=True, activate=False)

    def forward(self, voxels: Tensor, state: Any) -> tuple[Tensor, Any]:
        features = self.head(voxels)
        skipped, states = [features], []
        for encoder, before in zip(self.encoders, state or [None] * len(self.encoders), strict=True):
            states.append(encoder(features, before))
            features = states[-1][0]
            skipped.append(features)
        for block in self.resblocks:
            features = block(features)
        for decoder in self.decoders:
            features = decoder(features + skipped.pop())
        return self.pred(features + skipped.pop()).sigmoid(), states


class FireNet(ReconstructionNetwork):
    """The network of the weights file firenet_1000.pth.tar (Scheerlinck et al., WACV 2020).

    A convolution and two residual blocks of 16 channels at full resolution. A convolutional GRU follows the convolution
    and the first block.
    """

    multiple = 1

    def __init__(self) -> None:
        super().__init__()
        self.net = _FireLayers()

    def forward(self, voxels: Tensor, state: Any) -> tuple[Tensor, Any]:
        """Return the image, about in [0, 1], and the two units' states; see :class:`ReconstructionNetwork`."""
        return self.net(voxels, state)


class _FireLayers(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.head = Recurrent(ConvLayer(NUM_BINS, 16, 3), ConvGRU(16))
        self.resblocks = nn.ModuleList(
            [Recurrent(ResidualBlock(16, normalize=False), ConvGRU(16)), ResidualBlock(16, normalize=False)]
        )
        self.pred = ConvLayer(16, 1, 1, activate=False)

    def forward(self, voxels: Tensor, state: Any) -> tuple[Tensor, Any]:
        first, second = self.resblocks
        before = state or (None, None)
        features = self.head(voxels, before[0])
        later = first(features, before[1])
        return self.pred(second(later)), (features, later)
