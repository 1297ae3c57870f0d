"""The hash encoding, beside the framework's."""

from __future__ import annotations

import pytest
import torch
from nerfstudio.field_components.encodings import HashEncoding as FrameworkHashEncoding

from aenerf_ns.method.encoding.hash_grid import HashEncoding

OPTIONS = {"num_levels": 5, "min_res": 4, "max_res": 200, "log2_hashmap_size": 9}


@pytest.fixture
def encodings() -> tuple[HashEncoding, FrameworkHashEncoding]:
    """Two float64 encodings with one table."""
    own, framework = HashEncoding(**OPTIONS).double(), FrameworkHashEncoding(implementation="torch", **OPTIONS).double()
    torch.nn.init.uniform_(own.hash_table, -1, 1)
    framework.load_state_dict(own.state_dict())
    return own, framework


def test_values_and_all_derivatives_are_those_of_the_framework(encodings: tuple) -> None:
    generator = torch.Generator().manual_seed(0)
    inside = torch.rand(200, 3, generator=generator, dtype=torch.float64)
    tangent, *weights = torch.randn(3, 200, 3, generator=generator, dtype=torch.float64)
    results = []
    for encoding in encodings:
        positions = inside.clone().requires_grad_()
        value, rate = torch.func.jvp(encoding, (positions,), (tangent,))
        loss = (value.square().sum(-1, keepdim=True) * weights[0] + rate.square().sum(-1, keepdim=True)).sum()
        results.append([value, rate, *torch.autograd.grad(loss, [positions, encoding.hash_table])])
    for own, framework in zip(*results, strict=True):
        assert framework.abs().max() > 1e-3
        torch.testing.assert_close(own, framework, rtol=1e-10, atol=1e-9)


def test_values_at_the_corners_of_the_grid_are_those_of_the_framework(encodings: tuple) -> None:
    own, framework = encodings
    # All levels have a corner at 0 and at 1; 0.5 is one where the resolution is even.
    corners = torch.cartesian_prod(*[torch.tensor([0.0, 0.5, 1.0], dtype=torch.float64)] * 3)
    torch.testing.assert_close(own(corners), framework(corners), rtol=1e-12, atol=1e-12)


def test_nothing_but_the_table_is_in_checkpoints(encodings: tuple) -> None:
    assert set(encodings[0].state_dict()) == {"hash_table"}
