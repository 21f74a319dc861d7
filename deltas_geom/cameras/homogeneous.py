"""To and from homogeneous coordinates, without a division by zero."""

import torch
from torch import Tensor

from deltas_geom.checks import check_shapes
from deltas_geom.numerics.arithmetic import finite_or_zero, without_autocast


@without_autocast
def to_homogeneous(coordinates: Tensor) -> Tensor:
    """Append a one: ``(*B, D)`` to ``(*B, D + 1)``; what is NaN stays so.

    Example:
        >>> to_homogeneous(torch.tensor([2.0, 3.0]))
        tensor([2., 3., 1.])
    """
    check_shapes(coordinates=(coordinates, "D"))
    return torch.cat([coordinates, torch.ones_like(coordinates[..., :1])], dim=-1)


def safe_divide(numerator: Tensor, denominator: Tensor, where: Tensor) -> Tensor:
    """``numerator / denominator`` where ``where`` holds, elsewhere 0 with zero gradient.

    Args:
        numerator: any shape that broadcasts with the others.
        denominator: not zero where ``where`` holds.
        where: bool.
    """
    # Double where: the unused branch must not turn the gradient into NaN.
    return torch.where(where, numerator / torch.where(where, denominator, 1.0), 0.0)


def safe_sqrt(squared: Tensor) -> Tensor:
    """Square roots of any shape; 0 with zero gradient unless ``squared`` is positive.

    At 0, as of a perfect match, the slope is infinite.
    """
    positive = squared > 0
    # Double where, as above.
    return torch.where(positive, torch.where(positive, squared, 1.0).sqrt(), 0.0)


@without_autocast
def from_homogeneous(coordinates: Tensor) -> Tensor:
    """Divide by the last coordinate: ``(*B, D + 1)`` to ``(*B, D)``.

    Coordinates at infinity (last coordinate exactly 0), NaN or infinite give 0 with zero gradient;
    test them, as ``coordinates[..., -1] != 0``, to tell them apart.

    Example:
        >>> from_homogeneous(torch.tensor([[4.0, 6.0, 2.0], [1.0, 1.0, 0.0]]))
        tensor([[2., 3.],
                [0., 0.]])
    """
    check_shapes(coordinates=(coordinates, "+D"))
    known, _ = finite_or_zero(coordinates)
    last = known[..., -1:]
    return safe_divide(known[..., :-1], last, last != 0)
