"""The hash grid: the plain implementation beside the framework's, the others beside the plain one, and the choice."""

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import FrameType
from typing import Any

import pytest
import torch
import torch.autograd.forward_ad as forward_ad
from nerfstudio.field_components.encodings import HashEncoding as FrameworkHashEncoding
from nerfstudio.viewer_legacy.server.viewer_utils import IOChangeException, SetTrace
from torch import Tensor

from aenerf_ns.method import hash_grid
from aenerf_ns.method.hash_grid import HashEncoding
from aenerf_ns.method.kernels import loader

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


NUMBA = "aenerf_ns.method.kernels.hash_grid_numba"


@pytest.fixture(params=["numba", "triton"])
def implementation(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """The name of a fast implementation. Without a GPU Triton's kernels are interpreted (see conftest), on the CPU."""
    pytest.importorskip(request.param)
    if request.param == "triton" and not torch.cuda.is_available():
        monkeypatch.setitem(hash_grid._BY_DEVICE, "cpu", hash_grid._BY_DEVICE["cuda"])
    return request.param


def make_pair(implementation: str, **options: int) -> tuple[HashEncoding, HashEncoding]:
    """The plain and a fast encoding with one table, on the device of the fast one."""
    device = "cuda" if implementation == "triton" and torch.cuda.is_available() else "cpu"
    assert loader.try_load(hash_grid._BY_DEVICE[device], torch.device(device)) is not None
    plain, fast = (HashEncoding(name, **{**OPTIONS, **options}).to(device) for name in ("torch", "auto"))
    torch.nn.init.uniform_(plain.hash_table, -1, 1)
    fast.load_state_dict(plain.state_dict())
    return plain, fast


def make_points(count: int) -> tuple[Tensor, Tensor]:
    """Positions, some of them at the ends and in corners of the grid, and tangents."""
    generator = torch.Generator().manual_seed(0)
    positions = torch.rand(count, 3, generator=generator)
    corners = torch.cartesian_prod(*[torch.tensor([0.0, 0.5, 1.0])] * 3)
    positions[: len(corners)] = corners[:count]
    return positions, torch.randn(count, 3, generator=generator)


def results_of(encoding: HashEncoding, positions: Tensor, tangents: Tensor | None) -> dict[str, Tensor]:
    """Features, and rates where there are tangents, with all gradients of a function of both."""
    device = encoding.hash_table.device
    inputs = {"positions": positions.to(device).requires_grad_(), "table": encoding.hash_table}
    if tangents is None:
        values = {"features": encoding(inputs["positions"])}
    else:
        inputs["tangents"] = tangents.to(device).requires_grad_()
        with forward_ad.dual_level():
            moving = forward_ad.make_dual(inputs["positions"].clone(), inputs["tangents"].clone())
            features, rates = forward_ad.unpack_dual(encoding(moving))
        values = {"features": features, "rates": rates}
    generator = torch.Generator().manual_seed(1)
    weights = [torch.randn(value.shape, generator=generator).to(device) for value in values.values()]
    gradients = torch.autograd.grad(list(values.values()), list(inputs.values()), weights)
    gradients_by_name = {f"gradient of {name}": value for name, value in zip(inputs, gradients, strict=True)}
    return {name: value.detach().cpu() for name, value in (values | gradients_by_name).items()}


def assert_same(results: dict[str, Tensor], expected: dict[str, Tensor]) -> None:
    """Tolerances are relative to the largest value: 3e-7 of values, 1e-5 of gradients, which are long sums."""
    assert results.keys() == expected.keys()
    for name, value in expected.items():
        largest = float(value.abs().max())
        assert largest > 1e-3, name
        error = float((results[name] - value).abs().max()) / largest
        assert error < (1e-5 if name.startswith("gradient") else 3e-7), f"{name}: {error}"


def is_fast(features: Tensor) -> bool:
    """Whether a fast implementation has computed the features."""
    return "_HashGrid" in features.grad_fn.name()


@pytest.mark.parametrize(
    ("points", "moving", "options"),
    # Of 300 points the last block is not full. A single one; and the full size of the grid.
    [
        (slice(300), False, {}),
        (slice(300), True, {}),
        (slice(30, 31), True, {}),
        (slice(70), True, {"num_levels": 16, "min_res": 16, "max_res": 2048, "log2_hashmap_size": 19}),
    ],
)
def test_values_and_gradients_are_those_of_the_plain_implementation(
    implementation: str, points: slice, moving: bool, options: dict[str, int]
) -> None:
    positions, tangents = (values[points] for values in make_points(300))
    plain, fast = (
        results_of(encoding, positions, tangents if moving else None)
        for encoding in make_pair(implementation, **options)
    )
    assert_same(fast, plain)


def test_no_points(implementation: str) -> None:
    _, fast = make_pair(implementation)
    features = fast(torch.zeros(0, 3, device=fast.hash_table.device))
    assert features.shape == (0, 10)
    features.sum().backward()
    assert fast.hash_table.grad.count_nonzero() == 0


def test_tensors_that_are_not_contiguous(implementation: str) -> None:
    gradients = []
    for encoding in make_pair(implementation):
        positions = make_points(40)[0].mT.contiguous().to(encoding.hash_table.device).requires_grad_()
        # The gradient of a sum is a single number, expanded.
        features = encoding(positions.mT)
        gradients.append(torch.autograd.grad(features.sum() + features[:, ::3].sum(), [positions, encoding.hash_table]))
    for plain, fast in zip(*gradients, strict=True):
        torch.testing.assert_close(fast, plain, rtol=0, atol=1e-5 * float(plain.abs().max()))


def test_positions_that_need_no_gradient(implementation: str) -> None:
    gradients = []
    for encoding in make_pair(implementation):
        with forward_ad.dual_level():
            positions, tangents = (value.to(encoding.hash_table.device) for value in make_points(40))
            features, rates = forward_ad.unpack_dual(encoding(forward_ad.make_dual(positions, tangents)))
        gradients.append(torch.autograd.grad(features.square().sum() + rates.square().sum(), encoding.hash_table)[0])
    torch.testing.assert_close(*gradients, rtol=0, atol=1e-5 * float(gradients[0].abs().max()))


def test_what_is_not_finite_stays_so(implementation: str) -> None:
    _, fast = make_pair(implementation)
    positions = torch.tensor([[0.3, 0.4, 0.5]], device=fast.hash_table.device).requires_grad_()
    features = fast(positions)
    for value in (float("nan"), float("inf")):
        for gradient in torch.autograd.grad(features, [positions, fast.hash_table], features * value, True):
            assert not gradient.isfinite().all()
    with torch.no_grad():
        fast.hash_table.fill_(float("nan"))
        assert fast(positions).isnan().all()


def test_the_number_of_threads_changes_no_byte(threads: None) -> None:
    _, fast = make_pair("numba")
    positions, tangents = make_points(1500)
    results = []
    for num_threads in (1, 2, 3, 7):
        torch.set_num_threads(num_threads)
        results.append(results_of(fast, positions, tangents))
    for other in results[1:]:
        assert all(torch.equal(other[name], value) for name, value in results[0].items())


def test_two_python_threads_at_once(threads: None) -> None:
    _, fast = make_pair("numba")
    positions, tangents = make_points(1500)
    # One trains with the temporal loss, one only renders, as the viewer does.
    arguments = [(positions, tangents), (positions.flip(0), None)] * 20
    expected = [results_of(fast, *pair) for pair in arguments[:2]] * 20
    torch.set_num_threads(2)
    # A dual level belongs to the process: only one thread may enter one.
    with ThreadPoolExecutor(1) as training, ThreadPoolExecutor(1) as viewer:
        futures = [(training, viewer)[i % 2].submit(results_of, fast, *pair) for i, pair in enumerate(arguments)]
        results = [future.result() for future in futures]
    for one, other in zip(results, expected, strict=True):
        assert all(torch.equal(one[name], value) for name, value in other.items())


_COMPILE = """
import sys
from triton import compile
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource
from aenerf_ns.method.kernels.hash_grid_triton import _add_gradients, _fill_features
types = {"num_points": "i32", "size": "i32", "block": "constexpr"}
for kernel, absent in (
    (_fill_features, ()),
    (_fill_features, ("tangents", "rates")),
    (_add_gradients, ()),
    (_add_gradients, ("tangents", "grad_rates", "to_tangents", "to_positions")),
):
    signature = {name: "constexpr" if name in absent else types.get(name, "*fp32") for name in kernel.arg_names}
    source = ASTSource(kernel, signature, {**dict.fromkeys(absent), "block": 128})
    print(len(compile(source, target=GPUTarget("cuda", 80, 32)).asm["cubin"]) > 0)
"""


def test_the_kernels_of_triton_compile_for_a_gpu(tmp_path: Path) -> None:
    pytest.importorskip("triton", minversion="3.2", reason="older versions compile by another interface")
    # In a process that does not interpret, and not from the cache.
    environment = os.environ | {"TRITON_INTERPRET": "0", "TRITON_CACHE_DIR": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", _COMPILE], capture_output=True, text=True, env=environment)
    assert done.stdout.split() == ["True"] * 4, done.stderr


def test_the_fast_implementation_is_the_default_where_it_fits() -> None:
    encoding = HashEncoding(**OPTIONS)
    positions, tangents = make_points(20)
    assert is_fast(encoding(positions))
    assert not is_fast(HashEncoding("torch", **OPTIONS)(positions))
    with forward_ad.dual_level():
        rates = forward_ad.unpack_dual(encoding(forward_ad.make_dual(positions, tangents))).tangent
        assert is_fast(rates)
        encoding.hash_table.data.uniform_(-1, 1)
        # A table that moves is for the plain implementation.
        parameters = {"hash_table": forward_ad.make_dual(encoding.hash_table, encoding.hash_table)}
        features, rates = forward_ad.unpack_dual(torch.func.functional_call(encoding, parameters, positions))
    torch.testing.assert_close(rates, features)
    assert not is_fast(encoding.double()(positions.double()))


def test_torch_func_takes_the_plain_implementation() -> None:
    plain, fast = (HashEncoding(name, **OPTIONS) for name in ("torch", "auto"))
    fast.load_state_dict(plain.state_dict())
    positions, tangents = make_points(20)
    transforms: list[Callable[[HashEncoding], Any]] = [
        lambda encoding: torch.func.jvp(encoding, (positions,), (tangents,)),
        lambda encoding: torch.func.grad(lambda x: encoding(x).sum())(positions),
        lambda encoding: torch.vmap(encoding)(positions[:, None]),
        lambda encoding: torch.vmap(
            lambda table: torch.func.functional_call(encoding, {"hash_table": table}, positions)
        )(torch.stack([plain.hash_table, 2 * plain.hash_table])),
    ]
    for transform in transforms:
        torch.testing.assert_close(transform(fast), transform(plain), rtol=0, atol=0)


@pytest.fixture
def nothing_known() -> Iterator[None]:
    """Which implementations work is not known before the test, and not afterwards."""
    caches = loader.try_load, loader._warn_once
    for cache in caches:
        cache.cache_clear()
    yield
    for cache in caches:
        cache.cache_clear()


def test_the_viewer_does_not_interrupt_the_loading_of_kernels(nothing_known: None) -> None:
    def interrupt(frame: FrameType, *_: Any) -> None:
        if frame.f_code.co_name == "self_test":
            raise IOChangeException

    with SetTrace(interrupt):
        loaded = loader.try_load(NUMBA, torch.device("cpu"))
    assert loaded is not None


@pytest.mark.parametrize(
    "error",
    [
        None,
        RuntimeError("Failed to find C compiler"),
        FileNotFoundError("no C compiler"),
        subprocess.CalledProcessError(1, "the C compiler"),
    ],
)
def test_kernels_that_do_not_work_are_said_once(
    error: Exception | None, nothing_known: None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    if error is not None:

        def features(*_: Any) -> None:
            raise error

        monkeypatch.setattr(f"{NUMBA}.features", features)
    else:
        monkeypatch.setitem(sys.modules, NUMBA, None)
    for _ in range(2):
        encoding = HashEncoding(**OPTIONS)
        assert not is_fast(encoding(make_points(20)[0]))
    (line,) = capsys.readouterr().out.splitlines()
    assert line.startswith("Plain torch computes what compiled kernels compute faster: ")
    assert ("C compiler" in line) == (error is not None)
