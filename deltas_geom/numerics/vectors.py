"""Vectors and symmetric matrices of many points as structs of arrays: one tensor a component.

Elementwise arithmetic over the points is an order of magnitude faster than a batched library call,
never raises and compiles. Components broadcast.
"""

from collections.abc import Sequence
from typing import Any, TypeVar

import torch
from numpy.typing import NDArray
from torch import Tensor

from deltas_geom.numerics.arithmetic import values_at_hand

Array = NDArray[Any]
Numbers = TypeVar("Numbers", Tensor, Array)
"""What is written once for torch and NumPy."""
Vector3 = tuple[Tensor, ...]
"""x y z."""
Vector4 = tuple[Tensor, ...]
"""x y z w."""
Symmetric3 = tuple[Tensor, ...]
"""m00 m01 m02 m11 m12 m22."""
Symmetric4 = tuple[Tensor, ...]
"""m00 m01 m02 m03 m11 m12 m13 m22 m23 m33."""


def dot(a: tuple[Tensor, ...], b: tuple[Tensor, ...]) -> Tensor:
    """a · b."""
    total = a[0] * b[0]
    for i in range(1, len(a)):
        total = torch.addcmul(total, a[i], b[i])
    return total


def unit(x: Vector4) -> Vector4:
    """x / |x|."""
    return scaled(x, dot(x, x).rsqrt())


def scaled(x: tuple[Tensor, ...], scale: Tensor) -> tuple[Tensor, ...]:
    """Vectors, each times its number."""
    return tuple([component * scale for component in x])


def plus(a: tuple[Tensor, ...], scale: Tensor, b: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    """a + scale b."""
    return tuple([torch.addcmul(p, scale, q) for p, q in zip(a, b, strict=True)])


def minus(a: tuple[Tensor, ...], scale: Tensor, b: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    """a - scale b."""
    return tuple([less(p, scale, q) for p, q in zip(a, b, strict=True)])


def less(a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    """a - b c in one pass over memory, which is what elimination costs."""
    return torch.addcmul(a, b, c, value=-1)


def either(where: Tensor, a: Sequence[Tensor], b: Sequence[Tensor | float]) -> tuple[Tensor, ...]:
    """a where that holds, elsewhere b."""
    return tuple([torch.where(where, p, q) for p, q in zip(a, b, strict=True)])


def matrix3(*entries: Tensor) -> Tensor:
    """``(*B, 3, 3)`` from nine ``(*B)``, row by row."""
    return torch.stack(entries, dim=-1).reshape(*entries[0].shape, 3, 3)


def as_one(parts: Sequence[Tensor], dtype: torch.dtype) -> Tensor:
    """Components ``(*B, N)`` as vectors ``(*B, N, K)`` in a dtype."""
    derived = torch.is_grad_enabled() and any(part.requires_grad for part in parts)
    if derived or not values_at_hand(parts[0]):
        return torch.stack(list(parts), dim=-1).to(dtype)
    # A stack of many short rows takes three times as long.
    vectors = parts[0].new_empty((*parts[0].shape, len(parts)), dtype=dtype)
    for k, part in enumerate(parts):
        vectors.select(-1, k).copy_(part)
    return vectors
