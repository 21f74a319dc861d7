"""Matches of two frames that owe nothing to poses.

A keypoint is searched in all of the other image, and what it finds in the first. It counts if it
comes back to where it started, if nothing elsewhere is nearly as much like it, and if its
neighbours moved like it.
"""

import torch
from torch import Tensor

from deltas_nets.check.descriptors import Described

__all__ = ["match"]

ROUND_TRIP = 1.5  # px
RATIO = 0.9  # of the distances of descriptors, best to second best
_APART = 2  # cells of four pixels between the best and the second best
_NEIGHBOURS = 8
_LEAST_ALIKE = 4  # of them
_SLACK, _STRAIN = 2.0, 0.15  # px, and px a px of distance: by how much neighbours differ in motion


@torch.inference_mode()
def match(first: Described, second: Described) -> tuple[Tensor, Tensor]:
    """Where the first frame's keypoints are in the second.

    Returns:
        ``(N, 2)`` px of the second's size, and ``(N)`` bool whether that can be believed.
    """
    start = first.keypoints
    there, unlike = _find(first.at(start), second)
    back, _ = _find(second.at(there), first)
    kept = ((back - start).norm(dim=-1) <= ROUND_TRIP) & (unlike <= RATIO)
    return there, kept & _moves_alike(start, there, kept)


def _find(descriptors: Tensor, image: Described) -> tuple[Tensor, Tensor]:
    """Best places ``(N, 2)``, and how far they are in comparison with the second best ``(N)``."""
    _, rows, columns = image.coarse.shape
    alike = (descriptors @ image.coarse.flatten(1)).reshape(-1, rows, columns)
    best, index = alike.flatten(1).max(dim=-1)
    row, column = index // columns, index % columns
    near_row = (torch.arange(rows, device=row.device) - row[:, None]).abs() <= _APART
    near_column = (torch.arange(columns, device=row.device) - column[:, None]).abs() <= _APART
    alike.masked_fill_(near_row[:, :, None] & near_column[:, None, :], -1.0)
    second = alike.flatten(1).amax(dim=-1)
    unlike = ((1 - best).clamp(min=1e-9) / (1 - second).clamp(min=1e-9)).sqrt()
    return _refined(descriptors, image, 2 * row, 2 * column), unlike


def _refined(descriptors: Tensor, image: Described, row: Tensor, column: Tensor) -> Tensor:
    """The best of 8 x 8 descriptors around a place, to a part of a pixel."""
    _, rows, columns = image.fine.shape
    window = torch.arange(-3, 5, device=row.device)
    near_rows = (row[:, None] + window).clamp(0, rows - 1)
    near_columns = (column[:, None] + window).clamp(0, columns - 1)
    flat = (near_rows[:, :, None] * columns + near_columns[:, None, :]).flatten(1)
    alike = (image.rows[flat] @ descriptors[:, :, None])[..., 0]
    place = alike.argmax(dim=-1)
    which = torch.arange(len(row), device=row.device)
    y, x = place // 8, place % 8
    table = alike.reshape(-1, 8, 8)
    inner_y, inner_x = y.clamp(1, 6), x.clamp(1, 6)
    peak = table[which, inner_y, inner_x]

    def peak_between(before: Tensor, after: Tensor) -> Tensor:
        bend = (before + after - 2 * peak).clamp(max=-1e-6)
        return ((before - after) / (2 * bend)).clamp(-0.5, 0.5)

    dx = peak_between(table[which, inner_y, inner_x - 1], table[which, inner_y, inner_x + 1])
    dy = peak_between(table[which, inner_y - 1, inner_x], table[which, inner_y + 1, inner_x])
    cells = torch.stack([near_columns[which, inner_x] + dx, near_rows[which, inner_y] + dy], dim=-1)
    per_cell = descriptors.new_tensor([image.size[1] / columns, image.size[0] / rows])
    return (cells + 0.5) * per_cell - 0.5


def _moves_alike(start: Tensor, there: Tensor, kept: Tensor) -> Tensor:
    """Whether half of a match's neighbours moved like it: surfaces are wider than a point."""
    alike = torch.zeros_like(kept)
    index = kept.nonzero()[:, 0]
    if len(index) <= _NEIGHBOURS:
        return alike
    motion, place = (there - start)[index], start[index]
    distance = torch.cdist(place, place).fill_diagonal_(torch.inf)
    near, neighbour = distance.topk(_NEIGHBOURS, largest=False)
    differs = (motion[neighbour] - motion[:, None]).norm(dim=-1)
    alike[index] = (differs < _SLACK + _STRAIN * near).sum(dim=-1) >= _LEAST_ALIKE
    return alike
