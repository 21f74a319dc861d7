"""Repeatability: does a detector find the same places of the scene in another view?

A point of one view counts if the other view sees its place: its depth is known, it projects into
the other image, and what is seen there has the depth that the point should have. It is repeated
if a point of the other view that counts too lies within some pixels of its projection. Two shares
are in use, both symmetric:

    repeated    (repeated points of the first + of the second) / (points that count)
    one to one  pairs, every point with one partner / (points that count in the view of fewer)

The first lets many points have the same partner, so it prefers points in clusters.

Sources: Schmid, Mohr and Bauckhage, Evaluation of interest point detectors (2000), for points of
the common part of the scene; DeTone et al., SuperPoint (2018), appendix, for the first share and
for 3 px and 300 points; Mikolajczyk et al., A comparison of affine region detectors (2005), section
4.1, for the second. They relate images by homographies, we by depth and pose.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from kornia.geometry.subpix import nms2d
from torch import Tensor

from deltas_geom import PosedViews, in_image, project, unproject
from deltas_geom.checks import check_shapes
from deltas_nets.losses.targets import read_nearest

TOLERANCE = 3.0  # px
NUM_POINTS = 300
DEPTH_TOLERANCE = 0.05


class Repeatability(NamedTuple):
    """How two point sets of one scene agree.

    Attributes:
        repeated: points of either view with a partner in the other.
        counted: points of either view whose place the other view sees.
        error: mean distance between projection and partner of repeated points, px; NaN if none.
        paired: pairs of points that have each other for their one partner, the nearest pairs first.
        fewer: points that count of the view that has fewer of them.
    """

    repeated: int
    counted: int
    error: float
    paired: int
    fewer: int

    @property
    def share(self) -> float:
        """Repeated of counted points, in [0, 1]; NaN where nothing counts."""
        return self.repeated / self.counted if self.counted else float("nan")

    @property
    def one_to_one(self) -> float:
        """Pairs of the points that could be paired, in [0, 1]; NaN where a view has none."""
        return self.paired / self.fewer if self.fewer else float("nan")


class Seen(NamedTuple):
    """Points of one view in the other.

    Attributes:
        pixels: ``(N, 2)``.
        counts: ``(N,)`` bool.
    """

    pixels: Tensor
    counts: Tensor


def repeatability(
    views: PosedViews,
    depth: Tensor,
    first: Tensor,
    second: Tensor,
    *,
    tolerance: float = TOLERANCE,
    depth_tolerance: float = DEPTH_TOLERANCE,
) -> Repeatability:
    """Compare the points found in two views of a scene.

    Args:
        views: the two cameras, K ``(2, 3, 3)``.
        depth: ``(2, H, W)`` true depth along z, metres, 0 = unknown.
        first: ``(N, 2)`` points found in view 0.
        second: ``(M, 2)`` points found in view 1.
        tolerance: farthest that a partner may be from the projection, px, itself included.
        depth_tolerance: largest difference between the projected and the seen depth, as a
            share of the projected one: beyond, the place is hidden, or its depth is wrong.

    Raises:
        ShapeError: a trailing shape differs.
    """
    check_shapes(depth=(depth, "2 H W"), first=(first, "N 2"), second=(second, "M 2"))
    forth = seen_by_other(views, depth, first, depth_tolerance)
    back = seen_by_other(views.select([1, 0]), depth.flip(0), second, depth_tolerance)
    in_second = _distances(forth.pixels[forth.counts], second[back.counts])
    in_first = _distances(back.pixels[back.counts], first[forth.counts])
    nearest = torch.cat([_nearest(in_second), _nearest(in_first)])
    near = nearest[nearest <= tolerance]
    return Repeatability(
        len(near),
        len(nearest),
        float(near.mean()),
        _count_pairs(in_second.maximum(in_first.mT), tolerance),
        min(in_second.shape),
    )


def pooled(pairs: Sequence[Repeatability]) -> Repeatability:
    """All pairs of views together: every point that counts weighs the same."""
    repeated = sum(pair.repeated for pair in pairs)
    total = sum(pair.error * pair.repeated for pair in pairs if pair.repeated)
    error = total / repeated if repeated else float("nan")
    return Repeatability(
        repeated,
        sum(pair.counted for pair in pairs),
        error,
        sum(pair.paired for pair in pairs),
        sum(pair.fewer for pair in pairs),
    )


def strongest_points(
    scores: Tensor, count: int = NUM_POINTS, *, nms_radius: int = 4, border: int = 4
) -> Tensor:
    """The best local maxima of a score map.

    Args:
        scores: ``(1, 1, H, W)``.
        count: how many are wanted.
        nms_radius: none is nearer to a stronger one than this, pixels along an axis.
        border: none is nearer to the image border, pixels.

    Returns:
        ``(n, 2)`` whole pixels, strongest first; ``n <= count``.
    """
    check_shapes(scores=(scores, "1 H W"))
    window = 2 * nms_radius + 1
    peaks = nms2d(scores, (window, window))[0, 0]
    height, width = peaks.shape
    inner = torch.zeros_like(peaks)
    rows, columns = slice(border, height - border), slice(border, width - border)
    inner[rows, columns] = peaks[rows, columns]
    values, index = inner.flatten().topk(min(count, inner.numel()))
    index = index[values > 0]
    row = index.div(width, rounding_mode="floor")
    return torch.stack([index % width, row], dim=-1).to(scores.dtype)


def seen_by_other(views: PosedViews, depth: Tensor, pixels: Tensor, depth_tolerance: float) -> Seen:
    """Where view 1 sees points of view 0, and whether it does."""
    size = (depth.shape[-2], depth.shape[-1])
    own = torch.where(in_image(pixels, image_size=size), read_nearest(depth[0], pixels), 0.0)
    safe = torch.where(own > 0, own, 1.0)
    points = unproject(views.select([0]), pixels[None], safe[None])[0]
    other = project(views.select([1]), points)
    there, expected = other.pixels[0], other.depth[0]
    surface = read_nearest(depth[1], there)
    # Of what is behind the camera, whose depth is negative, none is the same.
    same = (surface > 0) & ((surface - expected).abs() <= depth_tolerance * expected)
    return Seen(there, (own > 0) & in_image(there, image_size=size) & same)


def _distances(projected: Tensor, found: Tensor) -> Tensor:
    """How far each projection is from each found point, ``(n, m)`` px."""
    return torch.cdist(projected, found, compute_mode="donot_use_mm_for_euclid_dist")


def _nearest(distances: Tensor) -> Tensor:
    """``(n,)`` of ``(n, m)``; infinite without any."""
    return F.pad(distances, (0, 1), value=torch.inf).amin(dim=1)


def _count_pairs(distances: Tensor, tolerance: float) -> int:
    """How many pairs can be made one after the other, the nearest first, each point once."""
    rows, columns = torch.nonzero(distances <= tolerance, as_tuple=True)
    order = distances[rows, columns].argsort(stable=True)
    taken: tuple[set[int], set[int]] = (set(), set())
    for row, column in zip(rows[order].tolist(), columns[order].tolist(), strict=True):
        if row not in taken[0] and column not in taken[1]:
            taken[0].add(row)
            taken[1].add(column)
    return len(taken[0])
