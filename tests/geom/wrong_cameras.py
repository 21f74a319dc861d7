"""Wrong projections, rays, residuals, parallax and epipolar geometry."""

import torch
from torch import Tensor
from torch.nn.functional import normalize, pad
from wrong import after, before, ours

from deltas_geom import PosedViews, invert_pose
from deltas_geom.epipolar.fundamental import cross_matrix, inverse_intrinsics
from deltas_geom.testing.target import Target


def seen_in(proj: Tensor, points: Tensor) -> Tensor:
    return pad(points, (0, 1), value=1.0) @ proj.mT


def unguarded_pixels(K: Tensor, cam_from_world: Tensor, points: Tensor) -> Tensor:
    seen = seen_in(PosedViews(K, cam_from_world).proj, points)
    return seen[..., :2] / seen[..., 2:]


def along_the_ray(K: Tensor, pose: Tensor, pixels: Tensor, depth: Tensor) -> Tensor:
    points: Tensor = ours("unproject")(
        K, pose, pixels, depth / ours("rays")(K, pixels).norm(dim=-1)
    )
    return points


def of_the_mean(proj: Tensor, pixels: Tensor, points: Tensor, w: Tensor | None) -> Tensor:
    """The mean distance instead of the root of the mean square."""
    views = range(len(proj))
    alone = [ours("residual")(proj[v, None], pixels[v, None], points, None) for v in views]
    weights = torch.ones_like(pixels[..., 0]) if w is None else w.square()
    mean: Tensor = (weights * torch.stack(alone)).sum(dim=0) / weights.sum(dim=0)
    return mean


def algebraic(proj: Tensor, pixels: Tensor, points: Tensor, w: Tensor | None) -> Tensor:
    """Not divided by the depth: 0 where it should be, and else in metres times pixels."""
    seen = seen_in(proj, points)
    offset = seen[..., :2] - pixels * seen[..., 2:]
    return offset.square().sum(dim=-1).mean(dim=0).sqrt()


def baseline(proj: Tensor, points: Tensor) -> Tensor:
    centers = -torch.linalg.solve(proj[..., :3], proj[..., 3])
    return (centers[1:] - centers[:1]).norm(dim=-1).amax().expand(len(points))


def from_the_first(proj: Tensor, points: Tensor) -> Tensor:
    pairs = [ours("parallax")(proj[[0, view]], points) for view in range(1, len(proj))]
    return torch.stack(pairs).amax(dim=0)


def guarded_once(K: Tensor, cam_from_world: Tensor, points: Tensor) -> Tensor:
    """The branch that is not taken still divides by 0, and so does its gradient."""
    seen = seen_in(PosedViews(K, cam_from_world).proj, points)
    return torch.where(seen[..., 2:] > 1e-9, seen[..., :2] / seen[..., 2:], 0.0).clamp(max=1e30)


def fundamental_of_a_first_view_at_the_origin(K: Tensor, cam_from_world: Tensor) -> Tensor:
    essential = cross_matrix(cam_from_world[1, :3, 3]) @ cam_from_world[1, :3, :3]
    return inverse_intrinsics(K[1]).mT @ essential @ inverse_intrinsics(K[0])


WRONG = [
    after("projected at 0.5", "project", lambda x: x + 0.5),
    before("whole mm", "project", lambda k, t, x: (k, t, (1e3 * x).round() / 1e3)),
    Target("unguarded", project=unguarded_pixels),
    Target("guarded once", project=guarded_once),
    before("world_from_cam", "unproject", lambda k, t, x, z: (k, invert_pose(t), x, z)),
    before("unprojected at 0.5", "unproject", lambda k, t, x, z: (k, t, x + 0.5, z)),
    Target("along the ray", unproject=along_the_ray),
    before("rays at 0.5", "rays", lambda k, x: (k, x + 0.5)),
    after("unit rays", "rays", lambda rays: normalize(rays, dim=-1)),
    Target(
        "rays of K transposed",
        rays=lambda k, x: torch.linalg.solve(k.mT, pad(x, (0, 1), value=1.0).mT).mT,
    ),
    Target("overflowing", rays=lambda k, x: ours("rays")(k, x) / (x.abs() < 1e12).all()),
    after("transposed", "fundamental", lambda fundamental: fundamental.mT),
    Target("at the origin", fundamental=fundamental_of_a_first_view_at_the_origin),
    after("unit F", "fundamental", lambda fundamental: fundamental / fundamental.norm()),
    after("no lines", "fundamental", lambda fundamental: 0 * fundamental),
    after("half the gradient", "project", lambda pixels: (pixels + pixels.detach()) / 2),
    after("in slopes", "residual", lambda residual: residual / 500),
    Target("mean", residual=of_the_mean),
    Target("algebraic", residual=algebraic),
    before("residual at 0.5", "residual", lambda p, x, points, w: (p, x + 0.5, points, w)),
    after("degrees", "parallax", torch.rad2deg),
    Target("baseline", parallax=baseline),
    Target("from the first", parallax=from_the_first),
    after("acute", "parallax", lambda angle: torch.minimum(angle, torch.pi - angle)),
]
