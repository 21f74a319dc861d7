"""Sums over views and over points: products of small matrices, for which no threads are started.

Torch's product starts threads for a few thousand multiplications. They wait for each other at every
call, for milliseconds where another program keeps a core busy. NumPy's starts none below
`_SERIAL_PRODUCT` multiplications (OpenBLAS), and is as fast.
"""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from deltas_geom.numerics.arithmetic import values_at_hand

SERIAL = 32767
"""Elements up to which torch computes an element-wise operation or a sum in the calling thread."""
_SERIAL_PRODUCT = 2**18  # multiplications


def over_views(coefficients: Tensor, *values: Tensor) -> tuple[Tensor, ...]:
    """For K coefficients ``(*B, K, V)`` of views, K sums ``(*B, N)`` of values ``(*B, V, N)``.

    Values may come in parts, some of the V each.
    """
    # A program that is exported is not fused, but run as it stands.
    if torch.compiler.is_compiling() and not torch.compiler.is_exporting():
        # Joined they would be carried through memory.
        own = torch.split(coefficients, [part.shape[-2] for part in values], dim=-1)
        sums = [_FusedSums.apply(*pair) for pair in zip(own, values, strict=True)]  # type: ignore[no-untyped-call]
        return tuple(sum(of_parts[1:], of_parts[0]) for of_parts in zip(*sums, strict=True))
    joined = values[0] if len(values) == 1 else torch.cat(values, dim=-2)
    return product(coefficients, joined).unbind(dim=-2)


def over_points(rows: Tensor, values: Tensor) -> Tensor:
    """``(*B, R, K)`` sums over points of products of ``(*B, R, N)`` and ``(*B, K, N)``."""
    few = max(1, _SERIAL_PRODUCT // max(1, rows.shape[-2] * values.shape[-2]))
    if not _plain(rows, values) or rows.shape[-1] <= few:
        return product(rows, values.mT)
    starts = range(0, rows.shape[-1], few)
    parts = [product(rows[..., k : k + few], values[..., k : k + few].mT) for k in starts]
    return sum(parts[1:], parts[0])


def product(a: Tensor, b: Tensor) -> Tensor:
    """``a @ b`` of matrices, a small, b with any number of columns."""
    if not _plain(a, b):
        return a @ b
    left, right = a.detach().numpy(), b.detach().numpy()
    few = max(1, _SERIAL_PRODUCT // max(1, a.shape[-2] * a.shape[-1]))
    if right.shape[-1] <= few:
        return torch.from_numpy(np.matmul(left, right))
    shape = np.broadcast_shapes(left.shape[:-2], right.shape[:-2])
    found: NDArray[Any] = np.empty((*shape, left.shape[-2], right.shape[-1]), left.dtype)
    for k in range(0, right.shape[-1], few):
        np.matmul(left, right[..., k : k + few], out=found[..., k : k + few])
    return torch.from_numpy(found)


def _plain(a: Tensor, b: Tensor) -> bool:
    return plain(a, b) and a.dtype == b.dtype


def plain(*tensors: Tensor | None) -> bool:
    """May an operation leave torch: nobody traces or derives it?"""
    derived = torch.is_grad_enabled()
    return all(
        t is None or (values_at_hand(t) and not (derived and t.requires_grad)) for t in tensors
    )


class _FusedSums(torch.autograd.Function):
    """The sums one by one, which a compiler fuses with what stands around them.

    Their derivative by the coefficients is a sum over points, for which a product is better.
    """

    generate_vmap_rule = True

    @staticmethod
    def forward(coefficients: Tensor, values: Tensor) -> tuple[Tensor, ...]:
        return tuple(_sum_of(row, values) for row in coefficients.unbind(dim=-2))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor], output: Any) -> None:
        ctx.save_for_backward(*inputs)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, Tensor | None]:
        coefficients, values = ctx.saved_tensors
        gradient = torch.stack(gradients, dim=-2)
        of_coefficients = of_values = None
        if ctx.needs_input_grad[0]:
            of_coefficients = (gradient @ values.mT).sum_to_size(coefficients.shape)
        if ctx.needs_input_grad[1]:
            columns = coefficients.unbind(dim=-1)
            of_values = torch.stack([_sum_of(column, gradient) for column in columns], dim=-2)
            of_values = of_values.sum_to_size(values.shape)
        return of_coefficients, of_values


def _sum_of(row: Tensor, values: Tensor) -> Tensor:
    total = row[..., 0, None] * values[..., 0, :]
    for view in range(1, values.shape[-2]):
        total = total + row[..., view, None] * values[..., view, :]
    return total
