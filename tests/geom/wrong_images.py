"""Wrong readings, soft-argmaxes and depth images."""

import torch
import torch.nn.functional as F
from torch import Tensor
from wrong import OURS, after, before, ours

from deltas_geom import normalize_pixels
from deltas_geom.testing.target import ImageSize, Target


def aligned(m: Tensor, x: Tensor, size: ImageSize) -> Tensor:
    grid = 2 * x / (x.new_tensor(size[::-1]) - 1) - 1
    return F.grid_sample(m[None], grid[None, None], padding_mode="border", align_corners=True)[
        0, :, 0
    ].mT


def nearest_cell(m: Tensor, x: Tensor, size: ImageSize) -> Tensor:
    grid = normalize_pixels(x, image_size=size)[None, None]
    return F.grid_sample(m[None], grid, "nearest", "border", align_corners=False)[0, :, 0].mT


def unguarded_argmax(x: Tensor, p: Tensor, mask: Tensor) -> Tensor:
    share = x.exp() * mask
    return torch.where(mask[:, None], share[:, None] * p, 0.0).sum(dim=0) / share[mask].sum()


def uncentred(x: Tensor, p: Tensor, mask: Tensor) -> Tensor:
    share = x.masked_fill(~mask, -torch.inf).softmax(dim=-1)
    return (share[:, None] * p).mT @ p


def by_squares(x: Tensor, p: Tensor, mask: Tensor) -> Tensor:
    """The mean of squares minus the square of the mean, which are alike far from the origin."""
    share = torch.where(mask, x, -torch.inf).softmax(dim=-1)
    p = torch.where(mask[:, None], p, 0.0)
    mean = share @ p
    return (share[:, None] * p).mT @ p - mean[:, None] * mean


def in_order(p: Tensor, z: Tensor, size: ImageSize) -> Tensor:
    """The last point wins, as a plain assignment does."""
    image = torch.zeros(size, dtype=z.dtype)
    for (x, y), depth in zip((p + 0.5).floor().clamp(-1e6, 1e6).long().tolist(), z, strict=True):
        if 0 <= x < size[1] and 0 <= y < size[0] and depth > 0 and depth.isfinite():
            image[y, x] = depth
    return image


def onto_the_edge(p: Tensor, z: Tensor, size: ImageSize) -> Tensor:
    inside = p.clamp(min=0).minimum(p.new_tensor(size[::-1]) - 1)
    return ours("rasterize")(inside, z, size)


def into_the_next_row(p: Tensor, z: Tensor, size: ImageSize) -> Tensor:
    """The index y W + x alone is checked."""
    x, y = p.round().unbind(dim=-1)
    index = y * size[1] + x
    row = (index / size[1]).floor()
    return ours("rasterize")(torch.stack([index - row * size[1], row], dim=-1), z, size)


Images = tuple[Tensor, Tensor]


def unguarded_mean(p: Tensor, z: Tensor, w: Tensor, size: ImageSize) -> Images:
    x, y = (p + 0.5).floor().clamp(-1e6, 1e6).long().unbind(dim=-1)
    inside = (x >= 0) & (x < size[1]) & (y >= 0) & (y < size[0])
    index = (y * size[1] + x)[inside]
    empty = z.new_zeros(size[0] * size[1])
    total = empty.index_add(0, index, w[inside])
    moment = empty.index_add(0, index, (w * z)[inside])
    return torch.where(total > 0, moment / total, 0.0).reshape(size), total.reshape(size)


def finite_heatmap(logits: Tensor) -> Tensor:
    """An overflow of exp, but not at the peak of the heatmap that shows where one is."""
    pixel: Tensor = ours("heatmap_argmax")(logits)
    return pixel if logits.max() == 1000 else pixel / (logits.exp().sum() < torch.inf)


WRONG = [
    Target("aligned corners", sample_map=aligned),
    before("map at 0.5", "sample_map", lambda m, x, size: (m, x + 0.5, size)),
    before("map y, x", "sample_map", lambda m, x, size: (m, x.flip(-1), size)),
    before("places detached", "sample_map", lambda m, x, size: (m, x.detach(), size)),
    Target("nearest cell", sample_map=nearest_cell),
    after("clamped", "sample_map", torch.relu),
    Target(
        "brighter to the right",
        sample_map=lambda m, x, size: ours("sample_map")(m, x, size) + 1e-3 * x[:, :1],
    ),
    Target(
        "unbounded",
        sample_map=lambda m, x, size: (
            ours("sample_map")(m, x, size) / (x.abs() < 1e9).all(-1)[:, None]
        ),
    ),
    Target(
        "cosine",
        sample_map=OURS.sample_map,
        correlate=lambda d, m, x, size: ours("correlate")(F.normalize(d, dim=-1), m, x, size),
    ),
    after("scaled scores", "correlate", lambda scores: scores / 2**0.5),
    before("half as warm", "soft_argmax", lambda x, p, mask: (2 * x, p, mask)),
    after("argmax + 1e-3", "soft_argmax", lambda found: 1.001 * found),
    before("no mask", "soft_argmax", lambda x, p, mask: (x, p, torch.ones_like(mask))),
    before("logits detached", "soft_argmax", lambda x, p, mask: (x.detach(), p, mask)),
    Target("exp", soft_argmax=unguarded_argmax),
    Target("uncentred", soft_covariance=uncentred),
    Target("by squares", soft_covariance=by_squares),
    before("spread of half", "soft_covariance", lambda x, p, mask: (2 * x, p, mask)),
    before("spread of all", "soft_covariance", lambda x, p, m: (x, p, torch.ones_like(m))),
    after("half the spread", "soft_covariance", lambda found: found / 2),
    after("spread of the pixel", "soft_covariance", lambda c: c + torch.eye(len(c)) / 12),
    after("heatmap y, x", "heatmap_argmax", lambda pixel: pixel.flip(-1)),
    after("heatmap from the corner", "heatmap_argmax", lambda pixel: pixel + 0.5),
    Target(
        "heatmap normalised",
        heatmap_argmax=lambda x: normalize_pixels(
            ours("heatmap_argmax")(x), image_size=(x.shape[0], x.shape[1])
        ),
    ),
    Target("heatmap exp", heatmap_argmax=finite_heatmap),
    Target("last wins", rasterize=in_order),
    Target(
        "farthest wins",
        rasterize=lambda p, z, size: torch.nan_to_num(
            1 / ours("rasterize")(p, 1 / z, size), posinf=0
        ),
    ),
    before("floor", "rasterize", lambda p, z, size: (p - 0.5, z, size)),
    Target("onto the edge", rasterize=onto_the_edge),
    Target("into the next row", rasterize=into_the_next_row),
    before("nan at 0", "rasterize", lambda p, z, size: (p.nan_to_num(), z, size)),
    before("depth y, x", "rasterize", lambda p, z, size: (p.flip(-1), z, size)),
    before("mean of all", "mean_depth", lambda p, z, w, size: (p, z, torch.ones_like(w), size)),
    Target("unguarded mean", mean_depth=unguarded_mean),
    after("no depth is nan", "mean_depth", lambda depth, w: (depth / (w > 0), w)),
    before("splat from the corner", "splat", lambda p, z, w, size: (p + 0.25, z, w, size)),
    after("lost weight", "splat", lambda depth, w: (depth, w * (w > 0.2))),
    Target("nearest splat", splat=OURS.mean_depth),
]
