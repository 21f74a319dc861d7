"""The precision that arguments are worked on in: their own, never less."""

from collections.abc import Callable, Iterable
from functools import reduce, wraps
from typing import ParamSpec, TypeVar

import torch
from torch import Tensor

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")


def promoted(*tensors: Tensor) -> tuple[Tensor, ...]:
    """All in the dtype to which they promote, as a product of matrices does not by itself."""
    dtype = reduce(torch.promote_types, (tensor.dtype for tensor in tensors))
    return tuple(tensor.to(dtype) for tensor in tensors)


def at_least_single(tensor: Tensor) -> Tensor:
    """In float32 if it is of half precision, otherwise as it is.

    Example:
        >>> at_least_single(torch.ones(1, dtype=torch.bfloat16)).dtype
        torch.float32
        >>> at_least_single(torch.ones(1, dtype=torch.float64)).dtype
        torch.float64
    """
    return tensor.to(torch.promote_types(tensor.dtype, torch.float32))


def without_autocast(operation: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Keep ``torch.autocast`` out of an operation: it computes in the dtypes of its arguments.

    Autocast multiplies matrices in half precision. In bfloat16 a pixel at 600 is known to 4 px, and
    triangulation by cameras so rounded takes good points as at infinity.
    """

    @wraps(operation)
    def called(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Result:
        device = _device_type((*args, *kwargs.values()))
        # Asked first: an exported program that holds a region without autocast cannot be loaded.
        if device is None or not torch.is_autocast_enabled(device):
            return operation(*args, **kwargs)
        with torch.autocast(device, enabled=False):
            return operation(*args, **kwargs)

    return called


def _device_type(values: Iterable[object]) -> str | None:
    """Of the first tensor, also in tuples of tensors; None if its device has no autocast."""
    for value in values:
        if isinstance(value, Tensor):
            kind: str = value.device.type
            return kind if torch.amp.is_autocast_available(kind) else None
        if isinstance(value, tuple):
            found = _device_type(value)
            if found is not None:
                return found
    return None
