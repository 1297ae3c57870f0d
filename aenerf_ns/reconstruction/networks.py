"""E2VID's and FireNet's networks, written anew from their descriptions and their weights files' names.

Both map a voxel grid and the state after the grids before to an image and the next state. Attributes are named as in
the authors' weights files.
"""

from __future__ import annotations

from typing import Any

from torch import Tensor, nn

from aenerf_ns.reconstruction.layers import ConvGRU, ConvLayer, ConvLSTM, Recurrent, ResidualBlock, TransposedConvLayer

NUM_BINS = 5
"""Bins of time in the voxel grids that both networks were trained on."""


class E2VID(nn.Module):
    """The network of the weights file E2VID_lightweight.pth.tar (Rebecq et al., TPAMI 2021).

    A recurrent U-net: three encoders with a convolutional LSTM each, two residual blocks, and three decoders. Skip
    connections add features up.

    Attributes:
        name_in_file: under which the weights file has the network.
        multiple: height and width of the voxel grids must be multiples of this.
    """

    name_in_file = "unetrecurrent"
    multiple = 8

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
        """Reconstruct an image.

        Args:
            voxels: (N, 5, height, width) normalized voxel grids.
            state: of the encoders after the grids before; None at the start.

        Returns:
            (N, 1, height, width) display values in [0, 1], and the state.
        """
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


class FireNet(nn.Module):
    """The network of the weights file firenet_1000.pth.tar (Scheerlinck et al., WACV 2020).

    A convolution and two residual blocks of 16 channels at full resolution. A convolutional GRU follows the convolution
    and the first block.

    Attributes:
        name_in_file: see :class:`E2VID`.
        multiple: see :class:`E2VID`.
    """

    name_in_file = "net"
    multiple = 1

    def __init__(self) -> None:
        super().__init__()
        self.head = Recurrent(ConvLayer(NUM_BINS, 16, 3), ConvGRU(16))
        self.resblocks = nn.ModuleList(
            [Recurrent(ResidualBlock(16, normalize=False), ConvGRU(16)), ResidualBlock(16, normalize=False)]
        )
        self.pred = ConvLayer(16, 1, 1, activate=False)

    def forward(self, voxels: Tensor, state: Any) -> tuple[Tensor, Any]:
        """Reconstruct an image, whose values are in [0, 1] or about; see :meth:`E2VID.forward`."""
        first, second = self.resblocks
        before = state or (None, None)
        features = self.head(voxels, before[0])
        later = first(features, before[1])
        return self.pred(second(later)), (features, later)
