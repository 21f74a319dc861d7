"""The precision that arguments are worked on in, and numbers that are none."""

from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager, nullcontext
from functools import partial, reduce, wraps
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor
from torch.autograd import forward_ad
from torch.nn import Parameter

from deltas_geom.checks import tracing
from deltas_geom.records import mapped, tensors_of

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")
_HALF = (torch.float16, torch.bfloat16)


def promoted(*tensors: Tensor) -> tuple[Tensor, ...]:
    """All in the dtype to which they promote, as a product of matrices does not by itself."""
    dtypes = [tensor.dtype for tensor in tensors]
    if dtypes[1:] == dtypes[:-1]:
        return tensors
    dtype = reduce(torch.promote_types, dtypes)
    return tuple(tensor.to(dtype) for tensor in tensors)


def at_least_single(tensor: Tensor) -> Tensor:
    """In float32 if it is of half precision, otherwise as it is."""
    return in_dtype(tensor, torch.promote_types(tensor.dtype, torch.float32))


def in_dtype(tensor: Tensor, dtype: torch.dtype) -> Tensor:
    """As :meth:`Tensor.to`, which leaves two nodes in a trace where nothing changes."""
    return tensor if tensor.dtype == dtype else tensor.to(dtype)


def surely_below(tensor: Tensor, limit: float = torch.inf) -> bool:
    """Whether all numbers are smaller in size, and none NaN, where that may be asked at no cost.

    What holds of all items need not be told from item to item, twice in each direction.
    """
    # One pass, and three for the largest. Where the sum of squares overflows the answer is no.
    return values_at_hand(tensor) and torch.linalg.vector_norm(tensor.detach()).item() < limit


def finite_or_zero(
    tensor: Tensor, dims: int = 1, limit: float = torch.inf
) -> tuple[Tensor, Tensor | None]:
    """The items that are finite, 0 without gradient in place of others, and which are.

    An operation that takes these, and puts its own 0 where the item is not finite, has a finite
    value there and passes nothing: a NaN would be in the product of a zero gradient with it, and
    so in the gradient of every camera that the item shares with others.

    Args:
        tensor: ``(*B, ...)``, an item being its last ``dims`` dims.
        dims: 0 if an item is one number.
        limit: of what counts as finite.

    Returns:
        Second, for :func:`only`: ``(*B, 1, ...)``, or None where all are known to be finite.

    Example:
        >>> finite_or_zero(torch.tensor([[torch.nan, 1.0], [2.0, 3.0]]))
        (tensor([[0., 0.],
                [2., 3.]]), tensor([[False],
                [ True]]))
    """
    if surely_below(tensor, limit):
        return tensor, None
    size = tensor.detach().abs()
    # NaN is not below infinity either, and the largest of numbers and NaN is NaN.
    finite = (size.amax(dim=tuple(range(-dims, 0)), keepdim=True) if dims else size) < limit
    return torch.where(finite, tensor, 0.0), finite


def numbers_or_zero(tensor: Tensor) -> Tensor:
    """Each number that is finite, 0 without gradient in place of others."""
    return tensor if surely_below(tensor) else tensor.nan_to_num(0.0, 0.0, 0.0)


def only(values: Tensor, *masks: Tensor | None, other: float = 0.0) -> Tensor:
    """The values where all masks are True, a mask that is None being so; elsewhere ``other``."""
    for mask in masks:
        if mask is not None:
            # Of two masks: onnxruntime knows no "where" of bools.
            values = values & mask if other is False else torch.where(mask, values, other)
    return values


def both(mask: Tensor | None, other: Tensor | None) -> Tensor | None:
    """Where two masks of :func:`finite_or_zero` are True; None where both are."""
    return other if mask is None else mask if other is None else mask & other


def without_autocast(operation: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Compute in the dtypes of the arguments, in float32 where these are of half precision.

    ``torch.autocast`` is kept out: it multiplies matrices in half precision. In bfloat16 a pixel
    at 600 is known to 4 px, and triangulation by cameras so rounded takes good points as at
    infinity. Results are in the dtype to which the arguments promote; where that is of half
    precision they are rounded to it, and numbers beyond its range to the largest of it. A record's
    ``covariance`` stays in float32: rounded entry by entry it may be no covariance.
    """
    return _called(operation, rounds=True)


def at_least_in_single(operation: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """:func:`without_autocast`, but results stay in float32: half precision cannot hold them."""
    return _called(operation, rounds=False)


def _called(
    operation: Callable[_Arguments, _Result], *, rounds: bool
) -> Callable[_Arguments, _Result]:
    @wraps(operation)
    def called(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Result:
        if torch.compiler.is_compiling() or torch._C._is_any_autocast_enabled():
            kind = next((x.device.type for x in tensors_of((*args, *kwargs.values()))), "meta")
            if autocasts(kind):
                with torch.autocast(kind, enabled=False):
                    return called(*args, **kwargs)
        if not (_any_half(args) or _any_half(kwargs.values())):
            return operation(*args, **kwargs)
        tensors = tensors_of((*args, *kwargs.values()))
        options: Any = {name: mapped(_widened, value) for name, value in kwargs.items()}
        result = operation(*mapped(_widened, args), **options)
        kinds = [tensor.dtype for tensor in tensors if tensor.is_floating_point()]
        dtype = reduce(torch.promote_types, kinds)
        half = rounds and dtype in _HALF
        return mapped(partial(_rounded, dtype=dtype), result, "covariance") if half else result

    return called


def autocasts(kind: str) -> bool:
    """Whether ``torch.autocast`` is on for a kind of device.

    It is turned off only where it is on: an exported program that holds a region without autocast
    cannot be loaded, and is traced in pieces, which takes twice as long.
    """
    return torch.amp.is_autocast_available(kind) and torch.is_autocast_enabled(kind)


def outside_autocast(kind: str) -> AbstractContextManager[object]:
    """A region without ``torch.autocast``."""
    return torch.autocast(kind, enabled=False) if autocasts(kind) else nullcontext()


def outside_gradients() -> AbstractContextManager[object]:
    """A region without gradients, and none where they are off: programs are traced in pieces."""
    return torch.no_grad() if torch.is_grad_enabled() else nullcontext()


def without_gradients(operation: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Compute :func:`outside_gradients`."""

    @wraps(operation)
    def called(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Result:
        with outside_gradients():
            return operation(*args, **kwargs)

    return called


def _any_half(values: Iterable[Any]) -> bool:
    """Is any tensor in a nest of tuples of half precision? No list of them, which takes longer."""
    for value in values:
        if isinstance(value, Tensor):
            if value.dtype in _HALF:
                return True
        elif isinstance(value, tuple) and _any_half(value):
            return True
    return False


def _widened(tensor: Tensor) -> Tensor:
    return at_least_single(tensor) if tensor.dtype in _HALF else tensor


def _rounded(tensor: Tensor, dtype: torch.dtype) -> Tensor:
    if not tensor.is_floating_point():
        return tensor
    largest = torch.finfo(dtype).max
    kept = tensor.abs() == torch.inf  # what an item that is not finite holds, as NaN
    return torch.where(kept, tensor, tensor.clamp(-largest, largest)).to(dtype)


def solver_dtype(tensor: Tensor) -> torch.dtype:
    """The type to compute in: float64, whatever the input, where the device has it."""
    # Apple's devices have no float64; there the rig frame alone keeps float32 usable.
    return torch.float32 if tensor.device.type == "mps" else torch.float64


def values_at_hand(tensor: Tensor) -> bool:
    """May what is computed depend on values: nobody traces it, and no other device has them?

    In forward mode they have tangents, which are lost where values leave torch.
    """
    if torch.compiler.is_compiling() or tracing():
        return False
    if torch._C._are_functorch_transforms_active() or forward_ad._current_level >= 0:
        return False
    # NumPy does not know numbers whose sign is turned when they are read, as of a conjugate.
    return type(tensor) in (Tensor, Parameter) and tensor.is_cpu and not tensor.is_neg()


def unless_all(mask: Tensor) -> Tensor | None:
    """The mask for :func:`only`, or None where it is known to be True everywhere."""
    return None if surely_all(mask) else mask


def surely_all(mask: Tensor) -> bool:
    """Whether all is true, where that may be asked at no cost; elsewhere False.

    What holds for all points need not be told from point to point.
    """
    # NumPy looks at many bits at a time.
    return values_at_hand(mask) and bool(mask.numpy().all())
