"""A simulated GPU: tensors that say they are on another device and are computed on the CPU.

It records the events that cost time on a GPU: transfers, waits, kernels, and the bytes that kernels read and write.
It refuses operations on tensors of two devices, as a GPU does. Within a ``FakeTensorMode`` shapes are computed and no
values, so a step of any size can be counted.

torch gives Python a kind of device, with streams that do nothing, for backends that are written in Python. So the real
autograd engine and the real optimizers run. No kernel of CUDA does: nothing is learned of their numerics or speed.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import pytest
import torch
import torch.utils.backend_registration
from torch import Tensor, nn
from torch._guards import active_fake_mode
from torch._subclasses.fake_tensor import FakeTensor
from torch.utils._python_dispatch import TorchDispatchMode, return_and_correct_aliasing
from torch.utils._pytree import tree_flatten, tree_map

# Torch's engine then takes the simulated device for the machine's, and a backward pass on a real GPU fails.
NEEDS_SIMULATION = pytest.mark.skipif(
    torch.cuda.is_available()
    or not hasattr(torch.utils.backend_registration, "_setup_privateuseone_for_python_backend"),
    reason="there is a CUDA device, or this version of torch has no devices that are written in Python",
)

aten = torch.ops.aten

_MAKE_VIEWS = {aten.detach.default, aten.alias.default, aten.lift_fresh.default, aten._unsafe_view.default}
_LOOK_AT_SHAPES = {aten.is_same_size.default, aten._has_same_storage_numel.default}
_ONLY_ALLOCATE = {
    aten.empty.memory_format, aten.empty_strided.default, aten.empty_like.default, aten.new_empty.default,
    aten.new_empty_strided.default, aten._efficientzerotensor.default,
}  # fmt: skip
_WITHOUT_KERNEL = _MAKE_VIEWS | _LOOK_AT_SHAPES | _ONLY_ALLOCATE
# The size of their result depends on values, so the CPU waits for them.
_WAIT = {
    aten.nonzero.default, aten.masked_select.default, aten._unique2.default,
    aten.unique_dim.default, aten.unique_consecutive.default, aten.equal.default, aten.repeat_interleave.Tensor,
}  # fmt: skip
_TAKE_INDICES = {aten.index.Tensor, aten.index_put_.default, aten.index_put.default, aten._index_put_impl_.default}


@cache
def device() -> torch.device:
    """The simulated device. Asked for first, it is made known to torch for the rest of the process."""
    from torch.utils.backend_registration import _DummyBackendModule, _setup_privateuseone_for_python_backend

    backend = _DummyBackendModule()
    # Otherwise it would become the default of data loaders and of other tests in this process.
    backend.is_available = lambda: False
    backend.get_amp_supported_dtype = lambda: [torch.float16, torch.bfloat16]
    _setup_privateuseone_for_python_backend("simulated", backend)
    return torch.device("simulated", 0)


class OnDevice(Tensor):
    """A tensor on the simulated device, with its values in ``on_cpu``."""

    on_cpu: Tensor

    @staticmethod
    def __new__(cls, on_cpu: Tensor) -> OnDevice:
        if on_cpu._is_zerotensor():
            # Forward mode makes tangents that are zero without memory, which a tensor in Python cannot stand for.
            on_cpu = torch.zeros(on_cpu.shape, dtype=on_cpu.dtype)
        made = Tensor._make_wrapper_subclass(
            cls, on_cpu.size(), strides=on_cpu.stride(), storage_offset=on_cpu.storage_offset(), dtype=on_cpu.dtype,
            device=device(),
        )  # fmt: skip
        made.on_cpu = on_cpu
        return made

    __torch_function__ = torch._C._disabled_torch_function_impl

    @classmethod
    def __torch_dispatch__(cls, operation: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        # Outside the context, where nothing is counted.
        return _run(operation, args, kwargs or {}, Counts())

    def numpy(self, *args: Any, **kwargs: Any) -> Any:
        raise TypeError("can't convert a tensor on a device to numpy. Use Tensor.cpu()")

    __array__ = numpy

    def tolist(self) -> Any:
        values = self.cpu()
        # A tensor without values is read as zeros.
        return [0.0] * len(values) if isinstance(values, FakeTensor) else values.tolist()


@dataclass
class Counts:
    """Count the uses of the device by a piece of a program.

    Attributes:
        uploads: transfers from the CPU. From pageable memory, as all here are, they wait for the device.
        downloads: transfers to the CPU, which wait for the device.
        waits: other waits for the device.
        launches: kernels by the names of their operations. An operation of torch counts as one kernel.
        bytes: how much the kernels read and write, each tensor once; of lookups, what is looked up.
    """

    uploads: int = 0
    downloads: int = 0
    waits: int = 0
    launches: Counter[str] = field(default_factory=Counter)
    bytes: int = 0

    def kernel(self, name: str, num_bytes: int) -> None:
        """Count a kernel."""
        self.launches[name] += 1
        self.bytes += num_bytes


class SimulatedCuda(TorchDispatchMode):
    """Context in which the simulated device works.

    Attributes:
        counts: since the context began, or since they were replaced.
    """

    def __init__(self) -> None:
        super().__init__()
        device()
        self.counts = Counts()

    def __enter__(self) -> SimulatedCuda:
        # torch starts a thread for every device with the first backward pass of a process, which may be over by now.
        self._one_thread = torch.autograd.set_multithreading_enabled(False)
        return super().__enter__()

    def __exit__(self, *error: Any) -> None:
        super().__exit__(*error)
        self._one_thread.__exit__(*error)

    def __torch_dispatch__(self, operation: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(operation, args, kwargs or {}, self.counts)


def to_device(value: Any) -> Any:
    """Return what a value holds on the device, uncounted: a tensor, or a dictionary or dataclass of tensors.

    A module is moved in place. Within a ``FakeTensorMode`` the tensors lose their values.
    """
    if isinstance(value, nn.Module):
        for part in value.modules():
            for name, parameter in part._parameters.items():
                if parameter is not None:
                    part._parameters[name] = nn.Parameter(to_device(parameter.detach()))
            for name, buffer in part._buffers.items():
                if buffer is not None:
                    part._buffers[name] = to_device(buffer)
        return value
    if dataclasses.is_dataclass(value):
        fields = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
        return replace(value, **{name: to_device(part) for name, part in fields.items()})
    if isinstance(value, dict):
        return {name: to_device(part) for name, part in value.items()}
    if not isinstance(value, Tensor):
        return value
    fake = active_fake_mode()
    return OnDevice(value if fake is None else fake.from_tensor(value))


def _run(operation: Any, args: Any, kwargs: dict[str, Any], counts: Counts) -> Any:
    args, kwargs = tree_map(_with_values, (args, kwargs))
    tensors = [value for value in tree_flatten((args, kwargs))[0] if isinstance(value, Tensor)]
    here = [tensor for tensor in tensors if isinstance(tensor, OnDevice)]
    target = kwargs.get("device")
    is_result_here = bool(here) if target is None else torch.device(target).type == device().type
    if not here and not is_result_here:
        return operation(*args, **kwargs)
    result = operation(*tree_map(_on_cpu, args), **{k: _on_cpu(v) for k, v in kwargs.items() if k != "device"})
    if operation is aten._to_copy.default and bool(here) != is_result_here:
        counts.uploads += is_result_here
        counts.downloads += not is_result_here
        return OnDevice(result) if is_result_here else result
    if operation is aten._local_scalar_dense.default:
        counts.downloads += 1
        return result
    if operation is aten.copy_.default and len(here) == 1:
        counts.uploads += isinstance(args[0], OnDevice)
        counts.downloads += not isinstance(args[0], OnDevice)
        return args[0]
    _refuse_two_devices(operation, args, tensors)
    counts.waits += operation in _WAIT or _takes_a_mask(operation, args)
    if not (operation.is_view or operation in _WITHOUT_KERNEL):
        name = operation._schema.name.split("::")[1]
        counts.kernel(
            name, _bytes(name, here, [value for value in tree_flatten(result)[0] if isinstance(value, Tensor)])
        )
    wrapped = tree_map(lambda value: OnDevice(value) if isinstance(value, Tensor) else value, result)
    return return_and_correct_aliasing(operation, args, kwargs, wrapped)


def _with_values(value: Any) -> Any:
    """Take a tensor of zeros without memory, which torch itself has made for the device, into the simulation."""
    if isinstance(value, Tensor) and not isinstance(value, OnDevice) and value.device.type == device().type:
        return OnDevice(torch.zeros(value.shape, dtype=value.dtype))
    return value


def _on_cpu(value: Any) -> Any:
    return value.on_cpu if isinstance(value, OnDevice) else value


def _refuse_two_devices(operation: Any, args: Any, tensors: list[Tensor]) -> None:
    """Raise a RuntimeError where a GPU would.

    A tensor on the CPU may be without dimensions, or an index of a tensor on the device.
    """
    allowed = tree_flatten(args[1])[0] if operation in _TAKE_INDICES and isinstance(args[0], OnDevice) else []
    for tensor in tensors:
        if not isinstance(tensor, OnDevice) and tensor.dim() > 0 and not any(tensor is index for index in allowed):
            raise RuntimeError(f"Expected all tensors to be on the same device, but {operation} got one on the CPU")


def _takes_a_mask(operation: Any, args: Any) -> bool:
    """Whether an operation looks up or fills in as many values as a mask is true for."""
    if operation not in _TAKE_INDICES or not any(index is not None and index.dtype == torch.bool for index in args[1]):
        return False
    # Where the same value is filled in everywhere, their number plays no part.
    return operation is aten.index.Tensor or args[2].dim() > 0


def _bytes(name: str, inputs: list[Tensor], outputs: list[Tensor]) -> int:
    """Return how many bytes an operation reads and writes."""
    integers = [tensor for tensor in inputs if tensor.dtype in (torch.int32, torch.int64)]
    if name in ("index_select", "gather", "index"):
        return sum(map(_size, integers)) + 2 * _size(outputs[0])
    if "index_put" in name or name.startswith(("index_add", "scatter_add")):
        # The kernel reads the values to add, and it reads and writes the places that they are added to.
        copied = 0 if name.endswith("_") else 2 * _size(outputs[0])
        return sum(map(_size, integers)) + 3 * _size(inputs[-1]) + copied
    return sum(map(_size, inputs)) + sum(map(_size, outputs))


def _size(tensor: Tensor) -> int:
    """Return the bytes of a tensor, in which dimensions that are only repeated count once."""
    numbers = 1
    for size, stride in zip(tensor.shape, tensor.stride(), strict=True):
        numbers *= size if stride != 0 else 1
    return numbers * tensor.element_size()
