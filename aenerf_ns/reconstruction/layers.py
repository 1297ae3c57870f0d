"""The layers that E2VID and FireNet are made of.

Names of attributes are those of the authors' weights files, because a state dict names parameters by them.
"""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn


class ConvLayer(nn.Module):
    """A convolution, then batch normalization in place of a bias if asked for, then ReLU if asked for.

    The input is padded by half of the kernel's odd size.
    """

    def __init__(
        self, num_inputs: int, num_outputs: int, size: int, stride: int = 1, normalize: bool = False,
        activate: bool = True,
    ) -> None:  # fmt: skip
        super().__init__()
        self.conv2d = nn.Conv2d(num_inputs, num_outputs, size, stride, size // 2, bias=not normalize)
        self.norm_layer = nn.BatchNorm2d(num_outputs) if normalize else None
        self._activate = activate

    def forward(self, features: Tensor) -> Tensor:
        """Compute (N, num_outputs, height / stride, width / stride) features."""
        features = self.conv2d(features)
        if self.norm_layer is not None:
            features = self.norm_layer(features)
        return F.relu(features) if self._activate else features


class TransposedConvLayer(nn.Module):
    """A transposed convolution that doubles height and width, batch normalization, and ReLU."""

    def __init__(self, num_inputs: int, num_outputs: int) -> None:
        super().__init__()
        self.transposed_conv2d = nn.ConvTranspose2d(num_inputs, num_outputs, 5, 2, 2, output_padding=1, bias=False)
        self.norm_layer = nn.BatchNorm2d(num_outputs)

    def forward(self, features: Tensor) -> Tensor:
        """Compute (N, num_outputs, 2 height, 2 width) features."""
        return F.relu(self.norm_layer(self.transposed_conv2d(features)))


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
