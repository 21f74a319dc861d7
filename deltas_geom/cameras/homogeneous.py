"""To and from homogeneous coordinates, without a division by zero."""

import torch
import torch.nn.functional as F
from torch import Tensor

from deltas_geom.checks import check_shapes
from deltas_geom.numerics.arithmetic import (
    finite_or_zero,
    only,
    surely_below,
    unless_all,
    without_autocast,
)


@without_autocast
def to_homogeneous(coordinates: Tensor) -> Tensor:
    """Append a one: ``(*B, D)`` to ``(*B, D + 1)``; what is NaN stays so.

    Example:
        >>> import torch
        >>> to_homogeneous(torch.tensor([2.0, 3.0]))
        tensor([2., 3., 1.])
    """
    check_shapes(coordinates=(coordinates, "D"))
    return with_one(coordinates)


def with_one(coordinates: Tensor) -> Tensor:
    """:func:`to_homogeneous` without a look at the argument."""
    return F.pad(coordinates, (0, 1), value=1.0)


def safe_divide(numerator: Tensor, denominator: Tensor, where: Tensor) -> Tensor:
    """``numerator / denominator`` where ``where`` holds, elsewhere 0 with zero gradient."""
    known = unless_all(where)
    # Double where: the unused branch must not turn the gradient into NaN.
    return only(numerator / only(denominator, known, other=1.0), known)


def safe_sqrt(squared: Tensor) -> Tensor:
    """Square roots of any shape; 0 with zero gradient unless ``squared`` is positive.

    At 0, as of a perfect match, the slope is infinite; near it, parts of it overflow.
    """
    positive = unless_all(squared > torch.finfo(squared.dtype).tiny ** 0.6)
    # Double where, as above.
    safe = only(squared, positive, other=1.0)
    # Not sqrt, for which torch starts threads from 2048 numbers on.
    return only(safe * safe.rsqrt(), positive)


@without_autocast
def from_homogeneous(coordinates: Tensor) -> Tensor:
    """Divide by the last coordinate: ``(*B, D + 1)`` to ``(*B, D)``.

    Coordinates at infinity (last coordinate exactly 0), NaN or infinite give 0 with zero gradient;
    test them, as ``coordinates[..., -1] != 0``, to tell them apart.

    Example:
        >>> import torch
        >>> from_homogeneous(torch.tensor([[4.0, 6.0, 2.0], [1.0, 1.0, 0.0]]))
        tensor([[2., 3.],
                [0., 0.]])
    """
    check_shapes(coordinates=(coordinates, "+D"))
    quotient = coordinates[..., :-1] / coordinates[..., -1:]
    if surely_below(quotient):
        return quotient
    known, _ = finite_or_zero(coordinates)
    last = known[..., -1:]
    return safe_divide(known[..., :-1], last, last != 0)
