"""Cubes of a lattice, named by one number each."""

import torch
from torch import Tensor

__all__ = ["REACH", "distinct_names", "names_of_cubes", "positions_of_cubes", "sums_by_name"]

_BITS = 21
REACH = 2 ** (_BITS - 1)
"""Cubes from the origin along an axis up to which they have a name."""
_BOX = 2**24
"""Cubes up to which a box is ticked off instead of names being sorted."""


def names_of_cubes(positions: Tensor) -> Tensor:
    """A number ``(...)`` int64 for each position ``(..., 3)`` int64, in lexical order.

    Example:
        >>> positions = torch.tensor([[-1, 2, 3], [0, 0, 0]])
        >>> positions_of_cubes(names_of_cubes(positions)).tolist()
        [[-1, 2, 3], [0, 0, 0]]
    """
    x, y, z = (positions.long() + REACH).unbind(dim=-1)
    names: Tensor = (x << 2 * _BITS) | (y << _BITS) | z
    return names


def positions_of_cubes(names: Tensor) -> Tensor:
    """The positions ``(..., 3)`` of names ``(...)``."""
    parts = [names >> 2 * _BITS, names >> _BITS, names]
    positions: Tensor = (torch.stack(parts, dim=-1) & (2 * REACH - 1)) - REACH
    return positions


def distinct_names(positions: Tensor) -> Tensor:
    """The name of each cube among positions ``(N, 3)`` int64 once, ascending.

    Example:
        >>> positions = torch.tensor([[4, 5, 6], [-1, 2, 3], [4, 5, 6]])
        >>> positions_of_cubes(distinct_names(positions)).tolist()
        [[-1, 2, 3], [4, 5, 6]]
    """
    if len(positions) == 0:
        return positions.new_zeros(0)
    low, high = positions.amin(dim=0), positions.amax(dim=0)
    size = (high - low + 1).tolist()
    if size[0] * size[1] * size[2] > _BOX:
        return _once(names_of_cubes(positions))
    ticked = torch.zeros(size, dtype=torch.bool, device=positions.device)
    ticked[tuple((positions - low).unbind(dim=-1))] = True
    return names_of_cubes(ticked.nonzero() + low)


def sums_by_name(names: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
    """Each name once, ascending, and the sums ``(M, C)`` of its values ``(N, C)``."""
    found, place = torch.unique(names, return_inverse=True)
    return found, values.new_zeros(len(found), values.shape[1]).index_add_(0, place, values)


def _once(names: Tensor) -> Tensor:
    found: Tensor = torch.unique(names)
    return found
