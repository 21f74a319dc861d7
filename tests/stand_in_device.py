"""A device that holds no values, so that a machine with CPUs alone tells where a GPU would fail.

The meta device plays it. Its kernels know shapes, dtypes and devices; asking it for a value
raises, and tensors of the host keep their values, as beside a GPU. FakeTensorMode with "cuda"
would be the tool, but on a build of PyTorch without CUDA its tensors can be neither indexed nor
differentiated, and it takes the values of the host's tensors away as well.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

DEVICE = torch.device("meta")

# What takes tensors of two devices, on a GPU too. All of it but the copies to the device waits.
_COPIES = ("aten::_to_copy", "aten::copy_", "aten::index", "aten::index_put", "aten::index_put_")
_LITERALS = (torch.tensor, torch.as_tensor, Tensor.new_tensor)


class MixedDevices(RuntimeError):
    """An operation was given tensors of two devices."""


class _OneDevice(TorchDispatchMode):
    """Raises where an operation mixes devices; meta kernels often let that pass."""

    def __init__(self, copies: list[str]) -> None:
        super().__init__()
        self.copies = copies

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Any = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        kwargs = kwargs or {}
        given = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, Tensor)]
        # A number of the host, as a tensor without dims, goes with any device.
        devices = {tensor.device.type for tensor in given if tensor.dim() > 0}
        name = func._schema.name
        if len(devices) > 1 and name not in _COPIES:
            raise MixedDevices(f"{name} of tensors on {' and '.join(sorted(devices))}")
        out = func(*args, **kwargs)
        made = {leaf.device.type for leaf in tree_leaves(out) if isinstance(leaf, Tensor)}
        if name in _COPIES and len(devices | made) > 1:
            self.copies.append(name)
        return out


class _Literals(TorchFunctionMode):
    """Notes where numbers of the host are copied to the device, which waits for all before."""

    def __init__(self, copies: list[str]) -> None:
        super().__init__()
        self.copies = copies

    def __torch_function__(
        self, func: Any, types: Any, args: Any = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        out = func(*args, **(kwargs or {}))
        listed = func is Tensor.__getitem__ and _holds_list(args[1])
        if (func in _LITERALS or listed) and on_device(out):
            self.copies.append(func.__name__)
        return out


def _holds_list(index: Any) -> bool:
    return any(isinstance(part, list) for part in (index if isinstance(index, tuple) else [index]))


def on_device(value: Any) -> bool:
    """Are all tensors in it, however nested, on the device?"""
    tensors = [leaf for leaf in tree_leaves(value) if isinstance(leaf, Tensor)]
    return all(tensor.device == DEVICE for tensor in tensors)


def to_device(value: Any) -> Any:
    """The same with all its tensors on the device; they need gradients if they did."""

    def moved(leaf: Any) -> Any:
        if not isinstance(leaf, Tensor):
            return leaf
        return leaf.detach().to(DEVICE).requires_grad_(leaf.requires_grad)

    return tree_map(moved, value)


@contextmanager
def one_device() -> Iterator[list[str]]:
    """Raises inside where an operation mixes devices.

    Yields:
        The copies between host and device that happen inside, each of which stalls a GPU.
    """
    copies: list[str] = []
    real: Callable[..., Any] = torch.autocast

    def autocast(device: str, *args: Any, **kwargs: Any) -> Any:
        return nullcontext() if device == DEVICE.type else real(device, *args, **kwargs)

    with pytest.MonkeyPatch.context() as patch, _OneDevice(copies), _Literals(copies):
        patch.setattr(torch, "autocast", autocast)  # there is none of the meta device
        yield copies
