"""What arguments must be, in the words of every error."""

from collections.abc import Sized
from typing import Any

import numpy as np
import torch
from torch import Tensor

_NUMBERS = {str(number): number for number in range(1000)}
_MASKS = ("mask", "used")
_WHOLE = int | np.integer | torch.SymInt | Tensor
_OPTIONAL = ("mask", "weights", "pose_covariance")


class ShapeError(ValueError):
    """A tensor's trailing shape differs from what the operation documents."""


def check_shapes(**named: tuple[Tensor, str]) -> None:
    """Raise :class:`ShapeError` unless every tensor ends in its documented dims.

    A dim is a number, which must match, or a letter, which must have one size in all
    tensors of the call; after "+" it must not be 0. Leading batch dims are free.

    What is named ``mask`` or ``used`` is bool, ``..._index`` holds integers, and all else real
    numbers: integers, to which results would be rounded without a word, are refused.

    Args:
        **named: ``name=(tensor, "+V 3 4")``.

    Raises:
        ShapeError: a trailing shape differs, or two tensors disagree on a letter.
        TypeError: not a tensor, or one that holds something else.

    Example:
        >>> import torch
        >>> check_shapes(pixels=(torch.zeros(7, 3), "N 2"))
        Traceback (most recent call last):
        ...
        deltas_geom.checks.ShapeError: pixels must have shape (*B, N, 2), got (7, 3)
    """
    sizes: dict[str, int] = {}
    for name, (tensor, spec) in named.items():
        if not isinstance(tensor, Tensor):
            check_tensor(**{name: tensor})
        if name in _MASKS:
            check_bool(**{name: tensor})
        elif name.endswith("_index"):
            if tensor.is_floating_point() or tensor.is_complex() or tensor.dtype == torch.bool:
                raise TypeError(f"{name} must hold integers, got {tensor.dtype}")
        elif not tensor.is_floating_point():
            cure = f"use {name}.float()"
            raise TypeError(f"{name} must be floating point, got {tensor.dtype}: {cure}")
        dims = spec.replace("+", "").split()
        tail = tensor.shape[-len(dims) :]
        fits = len(tail) == len(dims)
        for dim, size in zip(dims, tail, strict=False):
            wanted = _NUMBERS.get(dim) or sizes.setdefault(dim, size)
            if size != wanted or (size == 0 and f"+{dim}" in spec):
                fits = False
        if not fits:
            raise ShapeError(_misfit(named, name, sizes))


def _misfit(named: dict[str, tuple[Tensor, str]], name: str, sizes: dict[str, int]) -> str:
    """Why a tensor does not go with the sizes that those before it have."""
    tensor, spec = named[name]
    dims, shape = spec.replace("+", "").split(), tuple(tensor.shape)
    tail, wanted = shape[-len(dims) :], f"must have shape (*B, {', '.join(dims)}), got {shape}"
    if len(tail) < len(dims):
        return f"{name} {wanted}"
    pairs = list(zip(dims, tail, strict=True))
    if any(_NUMBERS.get(dim, size) != size for dim, size in pairs):
        return f"{name} {wanted}"
    for dim, size in pairs:
        if size == 0 and f"+{dim}" in spec:
            return f"{name} must have {dim} >= 1, got {shape}"
        if size != sizes.get(dim, size):
            break
    first = next(other for other, (_, its) in named.items() if dim in its.replace("+", "").split())
    return f"{name} has {dim} = {size} but {first} has {dim} = {sizes[dim]}; {name} {wanted}"


def check_tensor(**named: object) -> None:
    """Raise ``TypeError`` with the cure unless all are tensors."""
    for name, value in named.items():
        if not isinstance(value, Tensor):
            kind, cure = type(value).__name__, _cure(name, value)
            cure = f": use {cure}" if cure else ""
            raise TypeError(f"{name} must be a torch.Tensor, got {kind}{cure}")


def _cure(name: str, value: object) -> str:
    """What to give instead of what is no tensor; empty where nobody knows."""
    if type(value).__name__ == "ndarray":
        return f"torch.from_numpy({name})"
    fields: tuple[str, ...] = getattr(value, "_fields", ())
    if fields:  # a record; PosedViews.proj is none of its fields
        own = hasattr(value, name)
        return f"{name}.{name}" if own else f"one of its fields, {', '.join(fields)}"
    return f"torch.stack({name}) or torch.tensor({name})" if isinstance(value, list | tuple) else ""


def check_kind(name: str, value: object, kind: type, cure: str) -> None:
    """Raise ``TypeError`` with the cure unless ``value`` is of our ``kind``."""
    if not isinstance(value, kind):
        given = type(value).__name__
        raise TypeError(f"{name} must be {kind.__name__}, got {given}: use {cure}")


def check_bool(**named: Tensor | None) -> None:
    """Raise ``TypeError`` unless every mask given is bool: numbers may mean weights, or indices."""
    for name, mask in named.items():
        if mask is not None and mask.dtype != torch.bool:
            cure = f"use {name} != 0, unless its numbers are weights or indices"
            raise TypeError(f"{name} must be bool, True = used, got {mask.dtype}: {cure}")


def check_given(**named: tuple[Tensor | None, str]) -> dict[str, tuple[Tensor, str]]:
    """Raise as :func:`check_shapes`, and leave out what need not be given, and is None."""
    given: dict[str, Any] = {
        name: one for name, one in named.items() if one[0] is not None or name not in _OPTIONAL
    }
    check_shapes(**given)
    return given


def check_batch(**named: tuple[Tensor | None, str]) -> torch.Size:
    """The batch dims to which all tensors of :func:`check_given` broadcast.

    Raises:
        ShapeError, TypeError: as :func:`check_shapes`, or batch dims do not broadcast.

    Example:
        >>> import torch
        >>> cameras, pixels = torch.zeros(5, 1, 2, 3, 4), torch.zeros(3, 2, 7, 2)
        >>> check_batch(proj=(cameras, "V 3 4"), pixels=(pixels, "V N 2"), mask=(None, "V N"))
        torch.Size([5, 3])
    """
    given = check_given(**named)
    # Of "+V 3 4" there are as many dims as words.
    return batch_shape(*(x.shape[: x.ndim - len(spec.split())] for x, spec in given.values()))


def tracing() -> bool:
    """Does ``torch.jit.trace`` look on?"""
    return bool(torch.jit.is_tracing())  # type: ignore[no-untyped-call,attr-defined]


def batch_shape(*shapes: tuple[int, ...]) -> torch.Size:
    """The shape to which leading batch dims broadcast; raise ``ShapeError`` where they do not."""
    if torch.compiler.is_compiling():
        return torch.Size(torch.broadcast_shapes(*shapes))  # type: ignore[no-untyped-call]
    if tracing():
        # Sizes are tensors there, and no two of these are equal: a trace is for one batch shape.
        shapes = tuple(tuple(map(int, shape)) for shape in shapes)
    batches = {*shapes} - {()}
    if len(batches) < 2:
        return torch.Size(*batches)
    # Its first call imports a computer algebra system, which takes half a second.
    most = max(map(len, batches))
    aligned = [(1,) * (most - len(shape)) + tuple(shape) for shape in batches]
    wanted = [{*sizes} - {1} for sizes in zip(*aligned, strict=True)]
    if any(len(sizes) > 1 for sizes in wanted):
        listed = ", ".join(str(tuple(shape)) for shape in shapes)
        raise ShapeError(f"leading batch dims must broadcast, got {listed}")
    return torch.Size(next(iter(sizes)) if sizes else 1 for sizes in wanted)


def check_positive(**named: float) -> None:
    """Raise ``ValueError`` unless every number is above 0."""
    for name, value in named.items():
        if not value > 0:
            raise ValueError(f"{name} must be positive, got {value}")


def check_counts(least: int, **counts: int | tuple[int, ...]) -> None:
    """Raise unless every count, or every one of a tuple, is a whole number of ``least`` or more."""
    for name, count in counts.items():
        each = count if isinstance(count, tuple) else (count,)
        # Traces have tensors and symbols for sizes.
        if not all(isinstance(number, _WHOLE) for number in each):
            raise TypeError(f"{name} must be whole, got {count!r}")
        if any(number < least for number in each):
            raise ValueError(f"{name} must be {least} or more, got {count}")


def check_depth_range(depth_range: tuple[float, float]) -> None:
    """Raise ``ValueError`` unless ``0 < near < far`` (far may be infinite)."""
    if not _is_pair(depth_range) or not 0 < depth_range[0] < depth_range[1]:
        raise ValueError(f"depth_range must be (near, far) with 0 < near < far, got {depth_range}")


def check_image_size(image_size: tuple[int, int]) -> None:
    """Raise unless ``image_size`` is (height, width) of at least one pixel.

    Raises:
        TypeError: they are floats, which would fail, or be rounded, far from here.
        ValueError: all else.
    """
    if not _is_pair(image_size) or min(image_size) < 1:
        raise ValueError(f"image_size must be (height, width) >= (1, 1), got {image_size}")
    if any(isinstance(side, float | np.floating) for side in image_size):
        cure = "use int(height), int(width)"
        raise TypeError(f"image_size must hold whole numbers, got {image_size}: {cure}")


def _is_pair(value: object) -> bool:
    return isinstance(value, Sized) and len(value) == 2
