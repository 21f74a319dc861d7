"""How far matches are from where cameras allow them: the measure that hypotheses are judged by."""

from typing import NamedTuple

import torch
from torch import Tensor

LEAST_MATCHES = 8  # of a pair of views
SHARE = 1 / 4  # of a pair's matches must fit: with 30 % wrong pixels, half of them can
# Few matches can be fitted by accident, with a factor or a shift to choose: of a dozen, one wants
# more than a quarter. Chance has deviations of a share of 0.5 / sqrt(count).
CHANCE = 1.2
CAP = 50.0  # px: beyond, wrong is wrong
_PARTNERS = 5  # of each view
_MOST = 96  # matches looked at in a pair


class Evidence(NamedTuple):
    """Matches of pairs of views.

    Attributes:
        pairs: ``(P, 2)`` views.
        first: ``(P, M, 2)`` pixels of the pair's first view.
        second: ``(P, M, 2)`` of its second.
        counts: ``(P)`` how many of M there are; the others hold NaN.
    """

    pairs: Tensor
    first: Tensor
    second: Tensor
    counts: Tensor

    def of(self, chosen: Tensor) -> "Evidence":
        """That of some pairs, ``(P)`` bool."""
        return Evidence(*(tensor[chosen] for tensor in self))

    def with_camera(self, *cameras: int) -> Tensor:
        """Which pairs have one of the cameras, ``(P)`` bool."""
        return torch.isin(self.pairs, self.pairs.new_tensor(cameras)).any(dim=-1)


def gather_evidence(pixels: Tensor, seen: Tensor) -> Evidence:
    """Pairs of views with the most matches, about five for each or more view.

    Pixels are ``(V, N, 2)`` float64, finite where ``seen``.
    """
    pairs = choose_pairs(seen)
    both = seen[pairs[:, 0]] & seen[pairs[:, 1]]
    counts = both.sum(dim=-1).clamp(max=_MOST)
    # Evenly over the points, so that all of the image has a say.
    rank = both.cumsum(dim=-1) - 1
    total = both.sum(dim=-1, keepdim=True)
    step = (total / _MOST).clamp(min=1.0)
    slot = torch.where(both, (rank / step).long(), _MOST).clamp(max=_MOST)
    points = torch.arange(seen.shape[1], device=seen.device).expand_as(slot)
    index = points.new_zeros(len(pairs), _MOST + 1).scatter(1, slot, points)
    index = index[:, : int(counts.max()) if len(pairs) else 0]
    filled = torch.arange(index.shape[1], device=seen.device) < counts[:, None]
    first, second = (
        torch.where(filled[..., None], pixels[view[:, None], index], torch.nan)
        for view in pairs.unbind(dim=-1)
    )
    return Evidence(pairs, first, second, counts)


def choose_pairs(seen: Tensor) -> Tensor:
    """``(P, 2)`` pairs with matches enough: all of few views, the richest of many."""
    views = seen.shape[0]
    common = seen.double() @ seen.double().mT
    place = torch.arange(views, device=seen.device)
    offset = (place[:, None] - place).abs()
    # Of equally many matches, neighbours and some far ones: 1, 2, 3, 5, 8, ... views apart.
    steps = place.new_tensor([1, 2, 3, 5, 8, 13, 21, 34, 55, 89, 144])
    nearness = 0.5 / (1 + offset) + 0.5 * torch.isin(offset, steps)
    score = torch.where((common >= LEAST_MATCHES) & (offset > 0), common + 0.9 * nearness, -1.0)
    if views > _PARTNERS + 1:
        best = score.topk(_PARTNERS, dim=-1).indices
        chosen = torch.zeros_like(score, dtype=torch.bool).scatter(1, best, True) & (score > 0)
        chosen |= chosen.mT.clone()
    else:
        chosen = score > 0
    return chosen.triu(diagonal=1).nonzero()


def residuals(evidence: Evidence, K: Tensor, pose: Tensor, *, share: float = SHARE) -> Tensor:
    """Distance ``(*B, P)`` px that a quarter of a pair's matches, or a ``share``, keep within.

    A match is as far off as its pixel in one view is from what that view sees of the other
    pixel's ray: a half line, from the ray's far end to the epipole. So a point behind a camera
    is off by its parallax, and without a baseline there is a single right place. K may be any
    invertible matrices ``(*B, V, 3, 3)``, as they may be transposed; poses are cam_from_world.
    """
    off = _squared(evidence, K, pose)
    rank = ((evidence.counts * share).ceil().long() - 1).clamp(min=0)
    # Sorting all of them would take as long as half of the rest.
    count = int(rank.max()) + 1 if rank.numel() else 0
    nearest = off.topk(count, largest=False).values
    found = nearest.gather(-1, rank[:, None].expand(*off.shape[:-1], 1))
    return found[..., 0].sqrt().clamp(max=CAP)


def distances(evidence: Evidence, K: Tensor, pose: Tensor) -> Tensor:
    """``(*B, P, M)`` px, how far off each match is, in the worse of the pair's views."""
    return _squared(evidence, K, pose).sqrt()


def displacements(evidence: Evidence, K: Tensor, pose: Tensor) -> Tensor:
    """Distance from points at infinity that 45 % of a pair's matches keep within, ``(P)``."""
    still = pose.clone()
    still[:, :3, 3] = 0
    return residuals(evidence, K, still, share=0.45)


def _squared(evidence: Evidence, K: Tensor, pose: Tensor) -> Tensor:
    """``(*B, P, M)`` px^2, of distances from rays in the worse of the pair's views.

    A half line starts at a pixel s and goes along v, where its other end is r v / |v|^2 further
    on. A pixel d from s is off by (d x v)^2 + (d . v - clamp(d . v, 0, r))^2 over |v|^2: no root.
    """
    pairs = torch.cat([evidence.pairs, evidence.pairs.flip(-1)])
    pixels, others = (
        torch.cat(both)
        for both in ((evidence.first, evidence.second), (evidence.second, evidence.first))
    )
    a, b = pairs.unbind(dim=-1)
    from_a, from_b = pose[..., a, :3, :], pose[..., b, :3, :]
    turn = from_b[..., :3] @ from_a[..., :3].mT
    baseline = from_b[..., 3:] - turn @ from_a[..., 3:]
    to_b = K[..., b, :, :]
    infinite = (to_b @ turn @ inverse_up_to_scale(K)[..., a, :, :])[..., None]
    # By components: small matrix products and reductions over dims of two are slow.
    px, py = pixels.unbind(dim=-1)
    fx, fy, fz = (
        infinite[..., row, 2, :]
        .addcmul(infinite[..., row, 0, :], px)
        .addcmul(infinite[..., row, 1, :], py)
        for row in range(3)
    )
    nx, ny, nz = (to_b @ baseline).unbind(dim=-2)  # the epipole, (*B, 2 P, 1) each
    far_ahead, near_ahead = fz > 0, nz > 0
    # From behind the view, the ray comes from infinity and starts at the epipole.
    sign = 2 * far_ahead.to(fz) - 1
    vx = (nx * fz).addcmul_(fx, nz, value=-1).mul_(sign)
    vy = (ny * fz).addcmul_(fy, nz, value=-1).mul_(sign)
    length = (vx * vx).addcmul_(vy, vy)
    size = (nx * nx + ny * ny + nz * nz) * (fx * fx).addcmul_(fy, fy).addcmul_(fz, fz)
    # Without a way to go, the start is all there is.
    still = (length <= 1e-24 * size).to(fz)
    vx, length = vx.add_(still), length.add_(still)
    ex, ey = nx / nz, ny / nz
    sx = torch.where(far_ahead, fx / fz, ex)
    sy = torch.where(far_ahead, fy / fz, ey)
    reach = ((ex - sx) * vx).addcmul_(ey - sy, vy)
    reach = torch.where(far_ahead & near_ahead, reach, torch.inf)
    dx, dy = others[..., 0] - sx, others[..., 1] - sy
    aside = (dx * vy).addcmul_(dy, vx, value=-1)
    along = (dx * vx).addcmul_(dy, vy)
    along -= torch.minimum(along.clamp(min=0), reach).mul_(1 - still)
    squared = aside.mul_(aside).addcmul_(along, along).div_(length)
    squared = torch.where(far_ahead | near_ahead, squared, torch.inf)
    squared = squared.nan_to_num_(torch.inf, torch.inf)
    return torch.maximum(*squared.chunk(2, dim=-2))


def inverse_up_to_scale(K: Tensor) -> Tensor:
    """``(*B, V, 3, 3)`` a positive multiple of the inverse of any K, finite even where it has none.

    A solver's overhead is more than all else here.
    """
    x, y, z = K.unbind(dim=-2)
    columns = [torch.linalg.cross(y, z), torch.linalg.cross(z, x), torch.linalg.cross(x, y)]
    sign = (x * columns[0]).sum(dim=-1).sign()
    inverse: Tensor = torch.stack(columns, dim=-1) * sign[..., None, None]
    return inverse
