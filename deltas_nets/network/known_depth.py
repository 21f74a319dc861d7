"""Depth of the anchor that something else than its matches tells, and how it joins theirs.

A sensor, the maps of other frames and the sparse points of a reconstruction enter the densifier by
the same slot as the triangulated points: as points with a weight.
"""

import torch
import torch.nn.functional as F
from torch import Tensor

from deltas_geom import SparseDepth
from deltas_geom.cameras.homogeneous import safe_divide
from deltas_geom.records import Record
from deltas_nets.network.correction import (
    ROUGHNESS,
    TOLERANCE,
    Correction,
    Places,
    correction,
    positive,
)

CELL = 4
"""Pixels: of a square so wide only the surest depth counts, so that a dense sensor is not taken for
sixteen times as many witnesses. The densifier begins at this stride."""
FULL_WEIGHT = 2.0
"""Of a lone depth without error; a triangulated point weighs its confidence, at most 1. Where all
cells around hold one too, it is half as much: points are not seen so close in training."""
HALVED_BY = 0.03
"""Share of the depth: a standard deviation that halves the weight."""


class KnownDepth(Record):
    """Depth that is known at some pixels of the anchor, or at all, with its uncertainty.

    Attributes:
        depth: ``(*B, 1, H, W)`` metres along z; 0 where it is unknown.
        deviation: ``(*B, 1, H, W)`` its standard deviation as a share of it.
    """

    depth: Tensor
    deviation: Tensor

    def confidence(self, tolerance: float = 0.05) -> Tensor:
        """Probability ``(*B, 1, H, W)`` that the relative error is below ``tolerance``.

        Raises:
            ValueError: the tolerance is not positive.
        """
        if not tolerance > 0:
            raise ValueError(f"tolerance must be a positive share of the depth, got {tolerance}")
        relative_scale = self.deviation / 2**0.5  # of a Laplace distribution
        return 1 - torch.exp(-tolerance / relative_scale.clamp_min(1e-6))


def as_points(known: KnownDepth) -> SparseDepth:
    """The surest depth of each cell as a point: ``(B, 1, H, W)``, mostly empty.

    Of equally sure ones the first counts.

    Example:
        >>> depth = torch.full((1, 1, 4, 8), 2.0)
        >>> points = as_points(KnownDepth(depth, torch.zeros_like(depth)))
        >>> points.weight.count_nonzero(), points.weight.max()
        (tensor(2), tensor(1.7778))
    """
    usable = (known.depth > 0) & (known.depth < torch.inf) & (known.deviation >= 0)
    deviation = torch.where(usable, known.deviation, torch.inf)
    weight = FULL_WEIGHT / (1 + (deviation / HALVED_BY).square())
    surest, place = F.max_pool2d(weight, CELL, ceil_mode=True, return_indices=True)
    filled = (surest > 0).to(surest.dtype)
    around = (9 * F.avg_pool2d(filled, 3, stride=1, padding=1) - filled) / 8
    surest = surest / (1 + around)
    kept = torch.zeros_like(weight.flatten(-2)).scatter(-1, place.flatten(-2), surest.flatten(-2))
    kept = kept.reshape(weight.shape)
    return SparseDepth(torch.where(kept > 0, known.depth, 0.0), kept)


def joined(matched: SparseDepth, known: SparseDepth) -> SparseDepth:
    """Points of both; where two fall on a pixel, their mean by weight.

    Args:
        matched: ``(B, 1, H, W)`` of the triangulated points.
        known: of the same size.
    """
    weight = matched.weight + known.weight
    share = safe_divide(known.weight, weight, weight > 0)
    depth = torch.lerp(matched.depth, known.depth, share)
    return SparseDepth(torch.where(weight > 0, depth, 0.0), weight)


def reconciled(matched: SparseDepth, known: KnownDepth, log_depth: Tensor) -> SparseDepth:
    """Points of both, after the known ones have told where the others are off, and by how much.

    Known depths that contradict those around them by more than the map may be off weigh less.

    Args:
        matched: ``(B, 1, H, W)`` of the triangulated points.
        known: ``(B, 1, H, W)``.
        log_depth: ``(B, 1, H, W)`` of the map that rests on the matched points alone.
    """
    points = as_points(known)
    variance = known.deviation.square()
    process = correction(points, variance, log_depth)
    believed = points.weight / _doubt(process, points, variance, log_depth)
    return joined(_moved(matched, process), SparseDepth(points.depth, believed))


def _moved(matched: SparseDepth, process: Correction) -> SparseDepth:
    index, _ = positive(matched.weight.flatten(1), _pixels(matched.weight))
    flat = matched.depth.flatten(1)
    depth = torch.where(flat > 0, flat, 1.0)
    places = Places.at(index, depth.log().reshape(matched.depth.shape))
    moved = depth.gather(-1, index) * process(places).exp()
    moved = flat.scatter(-1, index, torch.where(flat.gather(-1, index) > 0, moved, 0.0))
    return SparseDepth(moved.reshape(matched.depth.shape), matched.weight)


def _doubt(process: Correction, points: SparseDepth, variance: Tensor, log_depth: Tensor) -> Tensor:
    """``(B, 1, H, W)`` what the weight of each point is divided by, 1 where it agrees."""
    index, used = positive(points.weight.flatten(1), _pixels(points.weight))
    places = Places.at(index, log_depth)
    depth = torch.where(used, points.depth.flatten(1).gather(-1, index), 1.0)
    off = depth.log() - log_depth.flatten(1).gather(-1, index)
    noise = variance.flatten(1).gather(-1, index) + ROUGHNESS**2
    usual = TOLERANCE * (process.variance(places) + noise).sqrt()
    doubt = torch.where(used, ((off - process(places)).abs() / usual).clamp(1, 30) ** 4, 1.0)
    image = torch.ones_like(points.weight).flatten(1).scatter(-1, index, doubt)
    # What the process rests on has been judged by the others.
    image = image.scatter(-1, process.places.pixels, process.doubt)
    return image.reshape(points.weight.shape)


def _pixels(image: Tensor) -> Tensor:
    count = image.shape[-2] * image.shape[-1]
    return torch.arange(count, device=image.device).expand(image.shape[0], count)
