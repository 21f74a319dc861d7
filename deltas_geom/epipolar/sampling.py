"""Places along epipolar segments, and feature maps read at pixels."""

import math
from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor

from deltas_geom.cameras.homogeneous import safe_divide
from deltas_geom.cameras.pixels import in_image, read_map
from deltas_geom.cameras.views import PosedViews
from deltas_geom.checks import batch_shape, check_batch, check_counts, check_kind, check_shapes
from deltas_geom.epipolar.segments import Segments, epipolar_rays
from deltas_geom.numerics.arithmetic import (
    at_least_in_single,
    both,
    finite_or_zero,
    only,
    promoted,
    unless_all,
    without_autocast,
)
from deltas_geom.records import Record


class Samples(Record):
    """Places in the sources where a keypoint may be matched.

    Attributes:
        pixels: ``(*B, V-1, N, O, S, 2)``; O lines beside each other, S places along each.
        inv_depth: ``(*B, V-1, N, S)`` inverse of the anchor's z, 1/m, from far to near.
        mask: ``(*B, V-1, N, O, S)`` bool: the place can be read.
    """

    pixels: Tensor
    inv_depth: Tensor
    mask: Tensor


def check_samples(samples: object) -> None:
    """Raise ``TypeError`` with the cure for anything else, such as segments or pixels."""
    check_kind("samples", samples, Samples, "sample_segments(...) or sample_inv_depths(...)")


def check_scores(keypoints: Tensor, scores: Tensor, samples: Samples, dims: str) -> None:
    """Raise as :func:`check_shapes` unless scores of these dims are of the samples of keypoints."""
    check_samples(samples)
    check_shapes(
        keypoints=(keypoints, "N 2"),
        scores=(scores, dims),
        samples=(samples.pixels, f"{dims} 2"),
        inv_depth=(samples.inv_depth, "sources N S"),
    )


def check_spread(num_samples: int, spacing: str, offsets: Sequence[float]) -> None:
    """Raise as :func:`sample_segments` where a setting makes no sense."""
    check_counts(2, num_samples=num_samples)
    if spacing not in ("inv_depth", "pixels"):
        raise ValueError(f"spacing must be 'inv_depth' or 'pixels', got {spacing!r}")
    if not all(map(math.isfinite, offsets)):
        raise ValueError(f"offsets must be finite, got {offsets}")


@without_autocast
def sample_segments(
    segments: Segments,
    num_samples: int,
    *,
    spacing: Literal["inv_depth", "pixels"] = "inv_depth",
    offsets: Sequence[float] = (),
    image_size: tuple[int, int] | None = None,
) -> Samples:
    """Spread samples evenly over each segment, from its far to its near end.

    Args:
        segments: from :func:`epipolar_segments`.
        num_samples: S, at least 2.
        spacing: even in inverse depth, or even in pixels.
        offsets: distances of parallel lines from the segment, pixels; () is the segment
            itself. The paper uses (-1, 0, 1) against errors of the poses.
        image_size: (height, width); when given, offset samples outside are masked out.

    Returns:
        Samples. Those of a segment that is not visible, not finite, or without a foreshortening
        above 0, are masked.

    Raises:
        ShapeError: a trailing shape differs.
        TypeError: no segments, or a number of samples that is not whole.
        ValueError: fewer than 2 samples, unknown spacing, an offset that is not finite.

    Source: the paper, section 3.2.
    """
    check_spread(num_samples, spacing, offsets)
    check_kind("segments", segments, Segments, "epipolar_segments(...)")
    check_shapes(
        start=(segments.start, "S N 2"),
        end=(segments.end, "S N 2"),
        inv_depth_start=(segments.inv_depth_start, "S N"),
        inv_depth_end=(segments.inv_depth_end, "S N"),
        foreshortening=(segments.foreshortening, "S N"),
    )
    *ends, low, high, _, ratio = segments
    parts = [*ends, *(each.unsqueeze(-1) for each in (low, high, ratio))]
    known, sound = finite_or_zero(torch.cat(parts, dim=-1))
    if sound is not None:
        parts = list(known.split_with_sizes([2, 2, 1, 1, 1], dim=-1))
    start, end, low, high, ratio = parts
    fraction, rest = (
        torch.linspace(end, 1 - end, num_samples, device=start.device, dtype=start.dtype)
        for end in (0, 1)
    )
    # At 0 an end is in the camera's plane, and pixels on the way are quotients of zeros.
    ahead = unless_all(ratio[..., 0] > torch.finfo(ratio.dtype).tiny ** 0.25)
    sound = both(sound, None if ahead is None else ahead.unsqueeze(-1))
    # Homogeneous interpolation: with r the foreshortening, a share s of the inverse depth
    # lies at the share s r / (1 - s + s r) of the pixels.
    ratio = only(ratio, sound, other=1.0)
    if spacing == "inv_depth":
        of_depth, nearer = fraction, fraction * ratio
        of_pixels = nearer / (rest + nearer)
    else:
        of_depth, of_pixels = fraction / (ratio * rest + fraction), fraction
    along = end - start
    # Not a product and a sum, which take five times as long where there are many samples.
    inv_depth = torch.addcmul(low, of_depth, high - low)
    pixels = torch.addcmul(start.unsqueeze(-2), of_pixels.unsqueeze(-1), along.unsqueeze(-2))

    pixels = pixels.unsqueeze(-3)
    if len(offsets):  # a tensor and an array have no truth value
        length = along.square().sum(-1, keepdim=True)
        moving = length > 0
        unit = along * torch.where(moving, length, 1.0).rsqrt()
        across = torch.stack([-unit[..., 1], unit[..., 0]], dim=-1)
        # Not torch.tensor, which copies numbers of the host to the device and waits for them.
        shifts = torch.stack([start.new_full((), offset) for offset in offsets])
        pixels = pixels + shifts[:, None, None] * across[..., None, None, :]
    mask = only(segments.visible.unsqueeze(-1), sound, other=False)
    mask = mask.unsqueeze(-1).expand(pixels.shape[:-1])
    if image_size is not None:
        mask = mask & in_image(pixels, image_size=image_size)
    return Samples(pixels, inv_depth, mask)


@without_autocast
def sample_inv_depths(
    views: PosedViews, pixels: Tensor, inv_depths: Tensor, *, image_size: tuple[int, int]
) -> Samples:
    """The same inverse depths in every source, so that views can be fused before a decision.

    Args:
        views: the anchor (view 0) and its V-1 sources.
        pixels: ``(*B, N, 2)`` keypoints of the anchor.
        inv_depths: ``(S,)`` or ``(*B, N, S)``, 1/m of the anchor's z, not negative; what is not
            finite counts as 0, masked.
        image_size: (height, width) of the sources.

    Returns:
        Samples with O = 1. Where a sample falls behind a source or outside its image the mask
        is False; behind, its pixel is (0, 0). In front is as in :func:`epipolar_segments`.

    Raises:
        ShapeError: a trailing shape differs.
    """
    check_shapes(pixels=(pixels, "N 2"), inv_depths=(inv_depths, "S"))
    rays = epipolar_rays(views, pixels)
    inv_depths, known = finite_or_zero(inv_depths, dims=0)
    reach = only(inv_depths.detach().abs(), known, other=torch.inf)  # nothing is that far ahead
    if inv_depths.ndim > 1:
        inv_depths, reach = inv_depths.unsqueeze(-3), reach.unsqueeze(-3)
    inv_depth = inv_depths.expand(batch_shape((*rays.origin.shape[:-1], 1), inv_depths.shape))
    homogeneous = rays.at(inv_depth)
    least = rays.clearance[..., None] + reach * rays.clearance_slope[..., None]
    in_front = homogeneous[..., 2] > least
    if rays.usable is not None:
        in_front = in_front & rays.usable[..., None]
    where = safe_divide(homogeneous[..., :2], homogeneous[..., 2:], in_front[..., None])
    mask = in_front & in_image(where, image_size=image_size)
    return Samples(where.unsqueeze(-3), inv_depth, mask.unsqueeze(-2))


@at_least_in_single
def sample_map(feature_map: Tensor, pixels: Tensor, *, image_size: tuple[int, int]) -> Tensor:
    """Read a feature map of any stride at pixels of the image, bilinearly.

    Arithmetic is in float32 at least, whatever the map's dtype and ``torch.autocast`` say: in
    bfloat16 places in an image of 640 px are known to a pixel or two.

    Args:
        feature_map: ``(*B, D, h, w)``, the image plane sampled coarser.
        pixels: ``(*B, N, 2)`` in the image; beyond the map's outer centres its border is
            continued. ``*B`` broadcasts with the map's.
        image_size: (height, width) of the image.

    Returns:
        ``(*B, N, D)``, at least float32. A coordinate that is NaN or infinite reads the border,
        NaN and minus infinity the left or upper one, with zero gradient to the pixel. A number of
        the map that is NaN or infinite counts as 0.

    Raises:
        ShapeError: a trailing shape differs, or the map is empty.

    Example:
        >>> ramp = torch.arange(4.0).reshape(1, 1, 4)  # one row of four pixels
        >>> sample_map(ramp, torch.tensor([[1.5, 0.0]]), image_size=(1, 4))
        tensor([[1.5000]])
    """
    check_batch(feature_map=(feature_map, "D +h +w"), pixels=(pixels, "N 2"))
    return read_map(*promoted(feature_map, pixels), image_size=image_size).mT
