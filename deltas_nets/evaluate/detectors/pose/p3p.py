"""Pose of a camera from three points, in closed form.

Source: Ke and Roumeliotis, An efficient algebraic solution to the perspective-three-point problem
(CVPR 2017), section 3: the rotation is three rotations about known axes, and the cosine of one of
them is a root of a quartic. Names are the paper's.
"""

import torch
from torch import Tensor

from deltas_geom.checks import check_shapes

__all__ = ["solve_p3p"]

REAL = 1e-3
"""Imaginary part that rounding gives a double root, of cosines."""
NEWTON_STEPS = 2


def solve_p3p(points: Tensor, rays: Tensor) -> Tensor:
    """Poses in which a camera sees three points along three rays.

    Args:
        points: ``(*B, 3, 3)`` points of the world, a row each, metres.
        rays: ``(*B, 3, 3)`` directions towards them in the camera, of unit length.

    Returns:
        ``(*B, 4, 4, 4)`` cam_from_world, up to four; those that do not exist, or come of points
        on a line, are NaN. Not all of them have the points ahead.

    Raises:
        ShapeError: a trailing shape differs.

    Example:
        >>> points = torch.tensor([[0.0, 0, 2], [1, 0, 3], [0, 1, 4]], dtype=torch.float64)
        >>> poses = solve_p3p(points, torch.nn.functional.normalize(points, dim=-1))
        >>> errors = (poses - torch.eye(4)).abs().amax(dim=(1, 2))
        >>> bool((errors < 1e-6).any())
        True
    """
    check_shapes(points=(points, "3 3"), rays=(rays, "3 3"))
    w1, w2, w3 = points.unbind(dim=-2)
    b1, b2, b3 = rays.unbind(dim=-2)
    length = (w1 - w2).norm(dim=-1)
    k1 = (w1 - w2) / length[..., None]
    cross = torch.linalg.cross(b1, b2)
    sine = cross.norm(dim=-1)
    k3 = cross / sine[..., None]
    v1, v2 = torch.linalg.cross(b1, b3), torch.linalg.cross(b2, b3)
    u1 = w1 - w3
    along = _dot(u1, k1)
    k3_b3 = _dot(k3, b3)
    normal = torch.linalg.cross(u1, k1)
    delta = normal.norm(dim=-1)
    normal = normal / delta[..., None]
    f11, f13 = k3_b3 * delta, _dot(k3, v1) * delta
    f15 = -along * k3_b3
    f21, f22, f23 = _dot(torch.linalg.cross(b1, k3), v2), sine * k3_b3, _dot(k3, v2)
    along2 = along - length
    f24, f25 = along2 * f22, -along2 * f21
    f21, f22, f23 = f21 * delta, f22 * delta, f23 * delta
    g1, g2, g3, g4 = f13 * f22, f13 * f25 - f15 * f23, f11 * f23 - f13 * f21, -f13 * f24
    g5, g6, g7 = f11 * f22, f11 * f25 - f15 * f21, -f15 * f24
    quartic = torch.stack(
        [
            g5**2 + g1**2 + g3**2,
            2 * (g5 * g6 + g1 * g2 + g3 * g4),
            g6**2 + 2 * g5 * g7 + g2**2 + g4**2 - g1**2 - g3**2,
            2 * (g6 * g7 - g1 * g2 - g3 * g4),
            g7**2 - g2**2 - g4**2,
        ],
        dim=-1,
    )
    cos1 = real_roots(quartic)
    sin1 = (1 - cos1**2).sqrt() * k3_b3.sign()[..., None]
    g1, g2, g3, g4, g5, g6, g7 = (g[..., None] for g in (g1, g2, g3, g4, g5, g6, g7))
    scale = sin1 / ((g5 * cos1 + g6) * cos1 + g7)
    cos3, sin3 = (g1 * cos1 + g2) * scale, (g3 * cos1 + g4) * scale
    middle = torch.stack(
        [
            cos3, torch.zeros_like(cos3), -sin3,
            sin1 * sin3, cos1, sin1 * cos3,
            cos1 * sin3, -sin1, cos1 * cos3,
        ],
        dim=-1,
    )  # fmt: skip
    middle = middle.reshape(*middle.shape[:-1], 3, 3)
    left = torch.stack([k1, normal, torch.linalg.cross(k1, normal)], dim=-1)
    right = torch.stack([b1, k3, torch.linalg.cross(b1, k3)], dim=-2)
    world_from_cam = left[..., None, :, :] @ middle @ right[..., None, :, :]
    reach = (delta / k3_b3)[..., None, None] * b3[..., None, :] * sin1[..., None]
    rotation = world_from_cam.mT
    translation = reach - (rotation @ w3[..., None, :, None])[..., 0]
    return _poses(rotation, translation)


def real_roots(quartic: Tensor) -> Tensor:
    """Cosines that are roots: ``(*B, 5)``, highest power first, to ``(*B, 4)``, NaN for others."""
    companion = torch.zeros(*quartic.shape[:-1], 4, 4, dtype=quartic.dtype, device=quartic.device)
    monic = quartic[..., 1:] / quartic[..., :1]
    sound = monic.isfinite().all(dim=-1)[..., None]
    companion[..., 0, :] = torch.where(sound, -monic, 0.0)
    companion[..., [1, 2, 3], [0, 1, 2]] = 1.0
    roots = torch.linalg.eigvals(companion)
    x = roots.real
    a, b, c, d, e = (part[..., None] for part in quartic.unbind(dim=-1))
    for _ in range(NEWTON_STEPS):
        value = (((a * x + b) * x + c) * x + d) * x + e
        slope = ((4 * a * x + 3 * b) * x + 2 * c) * x + d
        x = torch.where(slope != 0, x - value / slope, x)
    real = sound & (roots.imag.abs() < REAL) & (x.abs() <= 1)
    return torch.where(real, x, torch.nan)


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return (a * b).sum(dim=-1)


def _poses(rotation: Tensor, translation: Tensor) -> Tensor:
    last = rotation.new_tensor([0.0, 0, 0, 1]).expand(*rotation.shape[:-2], 1, 4)
    poses = torch.cat([torch.cat([rotation, translation[..., None]], dim=-1), last], dim=-2)
    sound = poses.isfinite().all(dim=-1).all(dim=-1)[..., None, None]
    return torch.where(sound, poses, torch.nan)
