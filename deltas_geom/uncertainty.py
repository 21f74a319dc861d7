"""What is known about given points: residual, parallax, covariance."""

import torch
from torch import Tensor

from deltas_geom.homogeneous import safe_divide, to_homogeneous


def solver_dtype(tensor: Tensor) -> torch.dtype:
    """The type to compute in: float64, whatever the input, where the device has it."""
    # Apple's devices have no float64; there the rig frame alone keeps float32 usable.
    return torch.float32 if tensor.device.type == "mps" else torch.float64


def projection_centers(proj: Tensor) -> tuple[Tensor, Tensor]:
    """Centres ``(*B, V, 3)`` of cameras ``(*B, V, 3, 4)``, and whether each has one ``(*B, V)``.

    A camera without a finite centre gets 0 with zero gradient.
    """
    with torch.no_grad():
        centers = torch.linalg.solve_ex(proj[..., :3], proj[..., 3:]).result
        exists = centers.isfinite().all(-1).all(-1)
    identity = torch.eye(3, device=proj.device, dtype=proj.dtype)
    where = exists[..., None, None]
    # Double where: a singular system must not turn the gradient into NaN.
    safe = torch.where(where, proj[..., :3], identity)
    position = torch.where(where, proj[..., 3:], 0.0)
    return -torch.linalg.solve_ex(safe, position).result.squeeze(-1), exists


def reprojection_residual(proj: Tensor, points: Tensor, pixels: Tensor, weights: Tensor) -> Tensor:
    """Weighted RMS distance of projections from pixels, ``(*B, N)`` px.

    Args:
        proj: ``(*B, V, 3, 4)``.
        points: ``(*B, N, 3)``.
        pixels: ``(*B, V, N, 2)``, finite.
        weights: ``(*B, V, N)``; views of weight 0 do not count. 0 where no view counts.
    """
    work = solver_dtype(proj)
    homogeneous = to_homogeneous(points.to(work)).unsqueeze(-3) @ proj.to(work).mT
    counts = (weights > 0) & (homogeneous[..., 2] > 0)
    projected = safe_divide(homogeneous[..., :2], homogeneous[..., 2:], counts[..., None])
    largest = weights.detach().amax(dim=-2, keepdim=True)
    share = weights.to(work) / torch.where(largest > 0, largest, 1.0)
    squared_weights = torch.where(counts, share, 0.0).square()
    errors = torch.where(counts[..., None], projected - pixels, 0.0).square().sum(dim=-1)
    total = squared_weights.sum(dim=-2)
    mean = safe_divide((squared_weights * errors).sum(dim=-2), total, total > 0)
    positive = mean > 0
    # sqrt has an infinite slope at a perfect match; its gradient there is taken as 0.
    return torch.where(positive, torch.where(positive, mean, 1.0).sqrt(), 0.0).to(proj.dtype)


def ray_parallax(proj: Tensor, points: Tensor, used: Tensor) -> Tensor:
    """Largest angle between the rays of used views at a point, ``(*B, N)`` rad.

    Args:
        proj: ``(*B, V, 3, 4)``.
        points: ``(*B, N, 3)``.
        used: ``(*B, V, N)`` bool.
    """
    work = solver_dtype(proj)
    centers, _ = projection_centers(proj.detach().to(work))
    rays = points.detach().to(work).unsqueeze(-3) - centers.unsqueeze(-2)
    rays = torch.nn.functional.normalize(rays, dim=-1, eps=torch.finfo(work).tiny)
    widest = rays.new_zeros(used.shape[:-2] + used.shape[-1:])
    for view in range(rays.shape[-3] - 1):
        first = rays[..., view : view + 1, :, :]
        others = rays[..., view + 1 :, :, :]
        # atan2 keeps small angles that the arc cosine rounds away.
        sine = torch.linalg.cross(first.expand_as(others), others).norm(dim=-1)
        angle = torch.atan2(sine, (first * others).sum(dim=-1))
        both = used[..., view : view + 1, :] & used[..., view + 1 :, :]
        widest = torch.maximum(widest, torch.where(both, angle, 0.0).amax(dim=-2))
    return widest.to(proj.dtype)


def point_covariance(proj: Tensor, points: Tensor, weights: Tensor) -> Tensor:
    """First-order covariance ``(*B, N, 3, 3)`` m^2 for pixel noise of 1 / weight px.

    (sum w^2 J^T J)^-1 with J the derivative of the pixels by the point. Trust it while the
    relative depth error it states is below about 5 %. 0 where fewer than two views are used.

    Source: Hartley and Zisserman, 2nd ed., section 5.2.
    """
    work = proj.to(solver_dtype(proj))
    homogeneous = to_homogeneous(points.to(work.dtype)).unsqueeze(-3) @ work.mT
    used = (weights > 0) & (homogeneous[..., 2] > 0)
    enough = used.sum(dim=-2) >= 2
    inverse_depth = safe_divide(torch.ones_like(homogeneous[..., 2]), homogeneous[..., 2], used)
    pixels = homogeneous[..., :2] * inverse_depth[..., None]
    directions = work[..., None, :, :3]
    jacobian = directions[..., :2, :] - pixels[..., None] * directions[..., 2:, :]
    jacobian = jacobian * (inverse_depth * weights.to(work.dtype))[..., None, None]
    information = (jacobian.mT @ jacobian).sum(dim=-4)
    identity = torch.eye(3, device=proj.device, dtype=work.dtype)
    information = torch.where(enough[..., None, None], information, identity)
    covariance = torch.linalg.inv_ex(information).inverse
    covariance = torch.where(enough[..., None, None], covariance, 0.0)
    # nan_to_num after the cast: what float64 can hold, float32 may not.
    return covariance.to(proj.dtype).nan_to_num(0.0)
