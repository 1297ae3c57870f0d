"""The sharp softplus: numba's beside torch's in float64."""

from collections.abc import Callable

import torch
import torch.autograd.forward_ad as forward_ad
import torch.nn.functional as F
from torch import Tensor

from aenerf_ns.method.activation import SharpSoftplus


def is_fast(outputs: Tensor) -> bool:
    return "_Softplus" in str(outputs.grad_fn)


def exact(inputs: Tensor) -> Tensor:
    # Torch's own threshold would cut off what is left of the exponential.
    return F.softplus(inputs, beta=100, threshold=1000)


def values_and_derivatives(
    activation: Callable[[Tensor], Tensor], inputs: Tensor, tangents: Tensor, weights: Tensor, of_rates: Tensor
) -> list[Tensor]:
    """Return values, their rates, and the gradients of inputs and tangents of a weighted sum of both."""
    inputs, tangents = inputs.clone().requires_grad_(), tangents.clone().requires_grad_()
    with forward_ad.dual_level():
        outputs, rates = forward_ad.unpack_dual(activation(forward_ad.make_dual(inputs * 1, tangents * 1)))
    (outputs * weights + rates * of_rates).sum().backward()
    return [outputs.detach(), rates.detach(), inputs.grad, tangents.grad]


def test_values_rates_and_gradients_are_those_of_softplus() -> None:
    generator = torch.Generator().manual_seed(0)
    # Around the bend, far from it, and zero.
    inputs = torch.cat([0.05 * torch.randn(20000, generator=generator), torch.linspace(-3, 3, 10001), torch.zeros(3)])
    tangents, weights, of_rates = torch.randn(3, len(inputs), generator=generator)
    assert is_fast(SharpSoftplus()(inputs.requires_grad_()))
    own = values_and_derivatives(SharpSoftplus(), inputs.detach(), tangents, weights, of_rates)
    reference = values_and_derivatives(exact, *(x.detach().double() for x in (inputs, tangents, weights, of_rates)))
    # The second derivative is up to 25.
    for name, value, true, tolerance in zip("vrgt", own, reference, (3e-7, 1e-6, 1e-4, 1e-6), strict=True):
        assert (value - true).abs().max() < tolerance, name


def test_gradients_without_rates() -> None:
    inputs = torch.linspace(-1, 1, 4001).requires_grad_()
    SharpSoftplus()(inputs).sum().backward()
    torch.testing.assert_close(inputs.grad, torch.sigmoid(100 * inputs.detach().double()).float(), rtol=0, atol=2e-7)


def test_values_that_are_not_finite_stay_so() -> None:
    outputs = SharpSoftplus()(torch.tensor([float("inf"), float("-inf"), float("nan")]))
    assert outputs[0] == torch.inf
    assert abs(outputs[1]) < 1e-18
    assert outputs[2].isnan()


def test_every_number_of_threads_gives_the_same_bytes(threads: None) -> None:
    inputs, results = torch.randn(3, 5000, generator=torch.Generator().manual_seed(1)), []
    for num_threads in (1, 3):
        torch.set_num_threads(num_threads)
        results.append(SharpSoftplus()(inputs))
    assert torch.equal(*results)


def test_other_tensors_take_torch_and_no_tensor_is_too_small() -> None:
    inputs = torch.linspace(-0.1, 0.1, 101, dtype=torch.float64).requires_grad_()
    assert not is_fast(SharpSoftplus()(inputs))
    assert torch.autograd.gradgradcheck(SharpSoftplus(), inputs)
    assert SharpSoftplus()(torch.empty(0, 4)).shape == (0, 4)
    single = inputs.detach().float()
    own, torchs = (torch.func.jvp(f, (single,), (torch.ones_like(single),)) for f in (SharpSoftplus(), exact))
    torch.testing.assert_close(own, torchs, rtol=1e-5, atol=1e-7)
