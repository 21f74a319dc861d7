"""Semi-global matching: costs of planes, summed along eight straight paths to every pixel."""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor


class Penalties(NamedTuple):
    """What it costs when depth changes from one pixel of a path to the next.

    Attributes:
        step: for one plane.
        jump: for more, where both pixels look the same.
        contrast: difference of grey values in [0, 1] at which a jump costs half as much.
    """

    step: float
    jump: float
    contrast: float


def aggregate(cost: Tensor, guide: Tensor, penalties: Penalties) -> Tensor:
    """Sum of the least costs of eight paths.

    Args:
        cost: ``(S, H, W)`` of planes.
        guide: ``(H, W)`` grey values in [0, 1], where depth may jump.
        penalties: of changes along a path.

    Returns:
        ``(S, H, W)``.

    Source: Hirschmueller, Stereo processing by semiglobal matching and mutual information (2008),
    section 2.2.
    """
    by_row, by_column = cost.transpose(0, 1).contiguous(), cost.permute(2, 0, 1).contiguous()
    down = swept(by_row, guide, (-1, 0, 1), penalties)
    up = swept(by_row.flip(0), guide.flip(0), (-1, 0, 1), penalties).flip(0)
    right = swept(by_column, guide.mT, (0,), penalties)
    left = swept(by_column.flip(0), guide.mT.flip(0), (0,), penalties).flip(0)
    return (down + up).transpose(0, 1) + (right + left).permute(1, 2, 0)


def swept(cost: Tensor, guide: Tensor, shifts: tuple[int, ...], penalties: Penalties) -> Tensor:
    """Sum of the paths that go from line to line, all pixels of a line at once.

    Args:
        cost: ``(lines, S, N)``.
        guide: ``(lines, N)``.
        shifts: of each path, from where in the line before it comes: -1, 0 or 1 pixel aside. A
            path begins where it enters the image.
        penalties: of changes.

    Returns:
        ``(lines, S, N)``.
    """
    total = torch.empty_like(cost)
    before = cost[0].expand(len(shifts), *cost.shape[1:])
    total[0] = len(shifts) * cost[0]
    for line in range(1, len(cost)):
        came = torch.stack(
            [_shifted(path, shift) for path, shift in zip(before, shifts, strict=True)]
        )
        grey = torch.stack([_shifted(guide[line - 1], shift) for shift in shifts])
        alike = 1 + (guide[line] - grey).abs() / penalties.contrast
        jump = (penalties.jump / alike).clamp_min(penalties.step)
        least = came.amin(dim=1, keepdim=True)
        best = torch.minimum(came, least + jump[:, None])
        best[:, 1:] = torch.minimum(best[:, 1:], came[:, :-1] + penalties.step)
        best[:, :-1] = torch.minimum(best[:, :-1], came[:, 1:] + penalties.step)
        before = cost[line] + best - least  # without the least costs grow along the path
        total[line] = before.sum(dim=0)
    return total


def _shifted(values: Tensor, shift: int) -> Tensor:
    """Entry n becomes that of n + shift, 0 beyond the ends: a path that begins there."""
    if shift == 0:
        return values
    return F.pad(values[..., 1:], (0, 1)) if shift > 0 else F.pad(values[..., :-1], (1, 0))
