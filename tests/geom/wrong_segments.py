"""Wrong segments and samples along them."""

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from wrong import OURS, after, before, ours

from deltas_geom import Status
from deltas_geom.testing.target import DepthRange, ImageSize, Target

Ends = tuple[Tensor, Tensor, Tensor]


def unclipped(K: Tensor, pose: Tensor, pixels: Tensor, span: DepthRange, size: ImageSize) -> Ends:
    """Clipped by an image of more than a hundred times the size."""
    shift = torch.tensor([[1.0, 0, 1e5], [0, 1, 1e5], [0, 0, 1]]).to(K)
    K = torch.stack([K[0], shift @ K[1]])
    start, end, status = ours("segments")(K, pose, pixels, span, (200_000, 200_000))
    return start - 1e5, end - 1e5, status


def dropped(K: Tensor, pose: Tensor, pixels: Tensor, span: DepthRange, size: ImageSize) -> Ends:
    """Empty unless both ends are in the image."""
    start, end, status = ours("segments")(K, pose, pixels, span, size)
    whole = unclipped(K, pose, pixels, span, size)
    same = ((start - whole[0]).abs() + (end - whole[1]).abs()).amax(dim=-1) < 1e-6
    status = torch.where(same | (status == Status.NOT_FINITE_INPUT), status, Status.EMPTY)
    return start, end, status.to(torch.int8)


def both_sides(K: Tensor, pose: Tensor, pixels: Tensor, span: DepthRange, size: ImageSize) -> Ends:
    """Ends from the camera equations, whether in front or not, forced into the image."""
    status = ours("segments")(K, pose, pixels, span, size)[2]
    rays = torch.linalg.inv(K[0]) @ F.pad(pixels, (0, 1), value=1.0).mT
    forced = []
    for depth in reversed(span):
        in_anchor = F.pad((rays * depth).mT, (0, 1), value=1.0)
        seen = in_anchor @ torch.linalg.inv(pose[0]).mT @ (K[1] @ pose[1, :3]).mT
        place = seen[:, :2] / seen[:, 2:]
        forced.append(place.clamp(min=-0.5).minimum(place.new_tensor(size[::-1]) - 0.5))
    return forced[0], forced[1], torch.where(status == Status.EMPTY, status, Status.OK)


def linear_samples(*given: Any) -> Ends:
    """Even in pixels and in inverse depth at once, as if the source were an affine camera."""
    along, inv_depth, status = ours("depth_samples")(*given)
    share = torch.linspace(0, 1, along.shape[1], dtype=along.dtype)[:, None]
    return along[:, :1] * (1 - share) + along[:, -1:] * share, inv_depth, status


def unclipped_samples(*given: Any) -> Ends:
    *cameras, size, count = given
    along, inv_depth, _ = ours("depth_samples")(*cameras, (100 * size[0], 100 * size[1]), count)
    return along, inv_depth, ours("depth_samples")(*given)[2]


def no_infinity(K: Tensor, pose: Tensor, pixels: Tensor, w: Tensor, size: ImageSize) -> Any:
    found, visible = ours("sweep")(K, pose, pixels, w, size)
    return torch.where((w > 0)[:, None], found, torch.nan), visible


WRONG = [
    after("ends at 0.5", "segments", lambda a, b, s: (a + 0.5, b + 0.5, s)),
    after("ends y, x", "segments", lambda a, b, s: (a.flip(-1), b.flip(-1), s)),
    after("near first", "segments", lambda a, b, s: (b, a, s)),
    Target("unclipped", segments=unclipped),
    Target("dropped", segments=dropped),
    Target("both sides", segments=both_sides),
    before(
        "not so near", "segments", lambda k, t, x, r, size: (k, t, x, (max(r[0], 0.5), r[1]), size)
    ),
    before("too long", "segments", lambda k, t, x, r, size: (k, t, x, (r[0] / 2, 2 * r[1]), size)),
    after("all seen", "segments", lambda a, b, s: (a, b, 0 * s)),
    after("all seen, a mask", "segments", lambda a, b, s: (a, b, s > -1)),
    after("one for all", "segments", lambda a, b, s: (a, b, s.new_full(s.shape, int(s.max())))),
    after("none seen", "segments", lambda a, b, s: (a, b, s > 9)),
    after("empty is nan", "segments", lambda a, b, s: (a / (a != 0), b, s)),
    Target("affine", depth_samples=linear_samples),
    Target("unclipped samples", depth_samples=unclipped_samples),
    Target("spacings swapped", depth_samples=OURS.pixel_samples, pixel_samples=OURS.depth_samples),
    after("from near", "depth_samples", lambda x, w, s: (x.flip(1), w.flip(1), s)),
    after("far samples first", "pixel_samples", lambda x, w, s: (x, w + 1, s)),
    before(
        "too wide",
        "depth_samples",
        lambda k, t, x, r, *more: (k, t, x, (r[0] / 2, 2 * r[1]), *more),
    ),
    after(
        "empty samples are nan",
        "depth_samples",
        lambda x, w, s: (x / (s[:, None, None] < 6), w, s),
    ),
    after("sees behind", "sweep", lambda x, seen: (x, seen | (x == 0).all(dim=-1))),
    Target("no infinity", sweep=no_infinity),
]
