"""The activation of hidden layers."""

from __future__ import annotations

from typing import Any

import torch
import torch.autograd.forward_ad as forward_ad
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from aenerf_ns.method.kernels.loader import is_float_in_memory, try_load


class SharpSoftplus(nn.Softplus):
    """Softplus with β = 100: smooth, but nearly as sharp as a rectifier, because a smaller β blurs the field.

    Float32 tensors on a CPU are computed by numba, where it works, several times faster than by torch. They have first
    derivatives, and rates (``forward_ad.make_dual``) with the first derivatives of the rates. All other tensors are
    computed by torch, in every mode of differentiation.
    """

    def __init__(self) -> None:
        super().__init__(beta=100.0)

    def forward(self, inputs: Tensor) -> Tensor:
        """Return log(1 + exp(β x)) / β."""
        fits = inputs.device.type == "cpu" and is_float_in_memory(inputs)
        kernels = try_load(f"{__package__}.kernels.activation", inputs.device) if fits else None
        if kernels is None:
            return super().forward(inputs)
        # Outside forward mode, too: there the tangent is None.
        values, tangents = forward_ad.unpack_dual(inputs)
        outputs, rates = _Softplus.apply(values, tangents, self.beta, kernels)
        return outputs if tangents is None else forward_ad.make_dual(outputs, rates)


class _Softplus(torch.autograd.Function):
    """Compute softplus and, where there are tangents, its rates."""

    @staticmethod
    def forward(
        ctx: Any, inputs: Tensor, tangents: Tensor | None, beta: float, kernels: Any
    ) -> tuple[Tensor, Tensor | None]:
        tangents = None if tangents is None else tangents.contiguous()
        outputs, rates = kernels.values(inputs.contiguous(), tangents, beta)
        ctx.save_for_backward(outputs, tangents)
        ctx.beta, ctx.kernels = beta, kernels
        return outputs, rates

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor, grad_rates: Tensor | None) -> tuple[Tensor | None, ...]:
        outputs, tangents = ctx.saved_tensors
        grad_rates = None if grad_rates is None else grad_rates.contiguous()
        return *ctx.kernels.gradients(outputs, tangents, grad.contiguous(), grad_rates, ctx.beta), None, None
