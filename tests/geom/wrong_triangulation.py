"""Wrong triangulations: their points, gradients, statuses, inliers and minima."""

from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad
from wrong import Function, after, before, ours

from deltas_geom import triangulate_points
from deltas_geom.testing.target import Target


def points(name: str, solve: Function, **more: Any) -> Target:
    """Of which no gradients are asked."""
    return Target(name, differentiable=False, triangulate=solve, **more)


def rows(proj: Tensor, pixels: Tensor, weights: Tensor | None) -> Tensor:
    """In the world's frame, as in the book: (N, 2 V, 4)."""
    equations = pixels[..., None] * proj[:, None, 2:] - proj[:, None, :2]
    equations = equations if weights is None else weights[..., None, None] * equations
    return equations.transpose(0, 1).flatten(1, 2)


def svd_points(proj: Tensor, pixels: Tensor, weights: Tensor | None) -> Tensor:
    null: Tensor = torch.linalg.svd(rows(proj, pixels, weights)).Vh[:, -1]
    return null[:, :3] / null[:, 3:] + 0 / (proj[0] - proj[1]).norm()


def normal_equations(proj: Tensor, pixels: Tensor, weights: Tensor | None) -> Tensor:
    """The null vector of A^T A in the input's precision."""
    equations = rows(proj, pixels, weights)
    null = torch.linalg.eigh(equations.mT @ equations).eigenvectors[..., 0]
    return null[:, :3] / null[:, 3:]


def first_view_counts_twice(proj: Tensor, pixels: Tensor, weights: Tensor) -> Tensor:
    return triangulate_points(proj, pixels, torch.cat([2 * weights[:1], weights[1:]]))


def spread(proj: Tensor, pixels: Tensor, weights: Tensor | None) -> Tensor:
    points = triangulate_points(proj, pixels, weights)
    return points + 1e-3 * (points - points.mean(dim=0))


def first_of_batch(proj: Tensor, pixels: Tensor, weights: Tensor | None) -> Tensor:
    found = triangulate_points(proj, pixels, weights)
    return found[..., :1, :, :].expand_as(found) if found.dim() > 2 else found


def first_camera_of_batch(proj: Tensor, pixels: Tensor, weights: Tensor | None) -> Tensor:
    return triangulate_points(proj[:1].expand_as(proj) if proj.dim() > 3 else proj, pixels, weights)


def in_half(proj: Tensor, pixels: Tensor, weights: Tensor | None) -> Tensor:
    found = triangulate_points(proj, pixels, weights)
    return found.half().float() if found.dtype == torch.float32 else found


def any_weight(proj: Tensor, x: Tensor, w: Tensor | None) -> Tensor:
    status: Tensor = ours("judge")(proj, x, None if w is None else torch.ones_like(w))
    return status


def overshot(proj: Tensor, x: Tensor, points: Tensor, w: Tensor | None) -> Tensor:
    return points + 2.5 * (ours("refine")(proj, x, points, w) - points)


def all_or_nothing(proj: Tensor, pixels: Tensor, w: Tensor | None) -> Tensor:
    points = triangulate_points(proj, pixels, w)
    return points / bool(pixels.isfinite().all())


Robust = tuple[Tensor, Tensor]


def all_views(proj: Tensor, pixels: Tensor, w: Tensor | None, limit: float) -> Robust:
    return triangulate_points(proj, pixels, w), torch.ones_like(pixels[..., 0]).bool()


def strict(proj: Tensor, pixels: Tensor, w: Tensor | None, limit: float) -> Robust:
    """The inliers of the DLT of all views: one wrong view spoils the point for all."""
    points = triangulate_points(proj, pixels, w)
    seen = pad(points, (0, 1), value=1.0) @ proj.mT
    return points, (seen[..., :2] / seen[..., 2:] - pixels).norm(dim=-1) < limit


WRONG = [
    points("1 mm off", lambda p, x, w: triangulate_points(p, x, w) + 1e-3),
    points("weights ignored", lambda p, x, w: triangulate_points(p, x)),
    points("weights ignored, pair", lambda p, x, w: triangulate_points(p, x), max_views=2),
    points("weights not squared", lambda p, x, w: triangulate_points(p, x, w.sqrt()), max_views=2),
    points("weights plus 0.1", lambda p, x, w: triangulate_points(p, x, w + 0.1)),
    points("pixels stretched", lambda p, x, w: triangulate_points(p, 1.001 * x, w)),
    points("first view twice", first_view_counts_twice),
    points("spread", spread),
    points("first of batch", first_of_batch, batched=True),
    points("first camera of batch", first_camera_of_batch, batched=True),
    points("float16", in_half),
    points("all or nothing", all_or_nothing),
    after("no gradient", "triangulate", lambda points: points.detach() + 0 * points),
    Target("svd", triangulate=svd_points),
    Target("normal equations", triangulate=normal_equations),
    after("all valid", "judge", lambda status: 0 * status),
    after("none valid", "judge", lambda status: status > 9),
    after("any reason", "judge", lambda status: status.clamp(max=1)),
    after("all or none", "judge", lambda status: status.max().expand_as(status)),
    Target("weights not judged", judge=any_weight),
    Target("overshot", refine=overshot),
    Target("no step", refine=lambda proj, x, points, w: points.clone()),
    Target("random walk", refine=lambda proj, x, points, w: points + 1e-4),
    Target("all views", robust=all_views),
    Target("no second look", robust=strict),
    before("robust, no weights", "robust", lambda p, x, w, limit: (p, x, None, limit)),
    before("squared px", "robust", lambda p, x, w, limit: (p, x, w, limit**0.5)),
    before("any weight", "robust", lambda p, x, w, limit: (p, x, (w > 0).to(p), limit)),
    after("none right", "robust", lambda points, inliers: (points, inliers & False)),
    after("robust, 1 mm off", "robust", lambda points, inliers: (points + 1e-3, inliers)),
]
