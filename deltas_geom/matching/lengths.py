"""Lengths of features read between pixels: polynomials there, as cheap to read as one map."""

import torch
from torch import Tensor

from deltas_geom.cameras.pixels import resize_pixels
from deltas_geom.numerics.arithmetic import (
    at_least_single,
    numbers_or_zero,
    only,
    outside_gradients,
    unless_all,
)


def length_table(feature_map: Tensor) -> tuple[Tensor]:
    """What the squared length of a read feature consists of, ``(*B, 9, h, w)``.

    Between a and b it is (1-u) |a|^2 + u |b|^2 - u (1-u) |a - b|^2. Twice, along x and along y,
    that is a polynomial of 3 x 3 terms, here for the cell right of and below each pixel, y
    first. Differences, not the products of neighbours: maps are smooth, and small differences
    keep their digits.
    """

    def right(values: Tensor) -> Tensor:
        return torch.cat([values[..., 1:], values[..., -1:]], dim=-1)

    def below(values: Tensor) -> Tensor:
        return torch.cat([values[..., 1:, :], values[..., -1:, :]], dim=-2)

    def squared(values: Tensor) -> Tensor:
        return values.square().sum(dim=-3)

    features = numbers_or_zero(at_least_single(feature_map))
    along = right(features) - features
    length, step_x, step_y = squared(features), squared(along), squared(below(features) - features)
    twist = squared(below(along) - along)
    of_top = [length, right(length), step_x]
    of_bottom = [below(value) for value in of_top]
    return (torch.stack([*of_top, *of_bottom, step_y, right(step_y), twist], dim=-3),)


def inverse_lengths(table: Tensor, pixels: Tensor, *, image_size: tuple[int, int]) -> tuple[Tensor]:
    """One by the length of the feature at pixels ``(*B, n, O, S, 2)``; 0 where it is nothing."""
    size = (table.shape[-2], table.shape[-1])
    places = resize_pixels(at_least_single(pixels), old_size=image_size, new_size=size)
    places = places.to(table.dtype)
    x, column = _cell(places[..., 0].flatten(-3), size[1])
    y, row = _cell(places[..., 1].flatten(-3), size[0])
    cell = (row * size[1] + column).unsqueeze(-2).expand(*table.shape[:-2], -1)
    terms = table.flatten(-2).gather(-1, cell)
    terms = terms.reshape(*terms.shape[:-2], 3, 3, terms.shape[-1])
    of_x = torch.stack([1 - x, x, x * (x - 1)], dim=-2).unsqueeze(-3)
    of_y = torch.stack([1 - y, y, y * (y - 1)], dim=-2)
    squared = ((terms * of_x).sum(dim=-2) * of_y).sum(dim=-2)
    with outside_gradients():
        ends = (terms[..., :2, :2, :] * of_x[..., :2, :]).sum(dim=-2) * of_y[..., :2, :]
        least = 16 * torch.finfo(squared.dtype).eps * ends.sum(dim=-2)
        has_length = unless_all(squared > least)
    # Double where: the unused branch must not turn the gradient into NaN.
    inverse = only(only(squared, has_length, other=1.0).rsqrt(), has_length)
    return (inverse.reshape(pixels.shape[:-1]),)


def _cell(place: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Share of the way to the next centre, and the index of the centre before it."""
    inside = (place > 0) & (place < size - 1)
    place = torch.where(inside, place, place.detach().clamp(0, size - 1).nan_to_num(0.0))
    before = place.detach().floor()
    return place - before, before.long()
