"""E2VID's and FireNet's networks, written anew from their descriptions and their weights files' names.

Both map a voxel grid and the state after the grids before to an image and the next state. Attributes, and the members
of sequences, are named as in the authors' weights files.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

NUM_BINS = 5
"""Bins of time in the voxel grids that both networks were trained on."""


def conv_layer(
    num_inputs: int, num_outputs: int, size: int, stride: int = 1, normalize: bool = False, activate: bool = True
) -> nn.Sequential:
    """Make a convolution, then batch normalization in place of a bias if asked for, then ReLU if asked for.

    The input is padded by half of the kernel's odd size.
    """
    conv2d = nn.Conv2d(num_inputs, num_outputs, size, stride, size // 2, bias=not normalize)
    norm_layer = nn.BatchNorm2d(num_outputs) if normalize else nn.Identity()
    return nn.Sequential(
        OrderedDict(conv2d=conv2d, norm_layer=norm_layer, relu=nn.ReLU() if activate else nn.Identity())
    )


def transposed_conv_layer(num_inputs: int, num_outputs: int) -> nn.Sequential:
    """Make a transposed convolution that doubles height and width, batch normalization, and ReLU."""
    conv = nn.ConvTranspose2d(num_inputs, num_outputs, 5, 2, 2, output_padding=1, bias=False)
    return nn.Sequential(OrderedDict(transposed_conv2d=conv, norm_layer=nn.BatchNorm2d(num_outputs), relu=nn.ReLU()))


class ResidualBlock(nn.Module):
    """Two convolutions of size 3 beside a shortcut, then ReLU."""

    def __init__(self, num_channels: int, normalize: bool) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(num_channels, num_channels, 3, padding=1, bias=not normalize)
        self.conv2 = nn.Conv2d(num_channels, num_channels, 3, padding=1, bias=not normalize)
        # Identities have no parameters, so that a file without normalization fits strictly.
        self.bn1 = nn.BatchNorm2d(num_channels) if normalize else nn.Identity()
        self.bn2 = nn.BatchNorm2d(num_channels) if normalize else nn.Identity()

    def forward(self, features: Tensor) -> Tensor:
        """Compute features of the same shape."""
        return F.relu(features + self.bn2(self.conv2(F.relu(self.bn1(self.conv1(features))))))


class ConvLSTM(nn.Module):
    """A convolutional long short-term memory, with a kernel of size 3."""

    def __init__(self, num_channels: int) -> None:
        super().__init__()
        self.Gates = nn.Conv2d(2 * num_channels, 4 * num_channels, 3, padding=1)

    def forward(self, features: Tensor, state: tuple[Tensor, Tensor] | None) -> tuple[Tensor, Tensor]:
        """Compute the new state (hidden, cell). The hidden state is the output. None begins with zeros."""
        hidden, cell = (torch.zeros_like(features),) * 2 if state is None else state
        take, keep, show, new = self.Gates(torch.cat([features, hidden], 1)).chunk(4, 1)
        cell = keep.sigmoid() * cell + take.sigmoid() * new.tanh()
        return show.sigmoid() * cell.tanh(), cell


class ConvGRU(nn.Module):
    """A convolutional gated recurrent unit, with kernels of size 3."""

    def __init__(self, num_channels: int) -> None:
        super().__init__()
        self.reset_gate = nn.Conv2d(2 * num_channels, num_channels, 3, padding=1)
        self.update_gate = nn.Conv2d(2 * num_channels, num_channels, 3, padding=1)
        self.out_gate = nn.Conv2d(2 * num_channels, num_channels, 3, padding=1)

    def forward(self, features: Tensor, state: Tensor | None) -> Tensor:
        """Compute the new state, which is the output too. None begins with zeros."""
        state = torch.zeros_like(features) if state is None else state
        both = torch.cat([features, state], 1)
        update, reset = self.update_gate(both).sigmoid(), self.reset_gate(both).sigmoid()
        new = self.out_gate(torch.cat([features, reset * state], 1)).tanh()
        return (1 - update) * state + update * new


class Recurrent(nn.Module):
    """A feed-forward layer ``conv``, then a recurrent one ``recurrent_block``, under the names of the weights files."""

    def __init__(self, conv: nn.Module, recurrent_block: nn.Module) -> None:
        super().__init__()
        self.conv = conv
        self.recurrent_block = recurrent_block

    def forward(self, features: Tensor, state: Any) -> Any:
        """Compute the recurrent layer's new state."""
        return self.recurrent_block(self.conv(features), state)


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
        self.head = conv_layer(NUM_BINS, 32, 5)
        self.encoders = nn.ModuleList(
            Recurrent(conv_layer(small, large, 5, stride=2, normalize=True), ConvLSTM(large)) for small, large in sizes
        )
        self.resblocks = nn.ModuleList(ResidualBlock(256, normalize=True) for _ in range(2))
        self.decoders = nn.ModuleList(transposed_conv_layer(large, small) for small, large in reversed(sizes))
        self.pred = conv_layer(32, 1, 1, normalize=True, activate=False)

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
    and the first block. For its attributes see :class:`E2VID`.
    """

    name_in_file = "net"
    multiple = 1

    def __init__(self) -> None:
        super().__init__()
        self.head = Recurrent(conv_layer(NUM_BINS, 16, 3), ConvGRU(16))
        self.resblocks = nn.ModuleList(
            [Recurrent(ResidualBlock(16, normalize=False), ConvGRU(16)), ResidualBlock(16, normalize=False)]
        )
        self.pred = conv_layer(16, 1, 1, activate=False)

    def forward(self, voxels: Tensor, state: Any) -> tuple[Tensor, Any]:
        """Reconstruct an image, whose values are in [0, 1] or about; see :meth:`E2VID.forward`."""
        first, second = self.resblocks
        before = state or (None, None)
        features = self.head(voxels, before[0])
        later = first(features, before[1])
        return self.pred(second(later)), (features, later)
