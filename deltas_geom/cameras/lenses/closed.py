"""Models that a formula takes both ways: pinhole, FOV, division, EUCM, equirectangular.

Of each, where a point of the camera's frame appears on the plane of normalised pixels, and the ray
of such a pixel, of any length. Where the mask is False, values mean nothing but are finite.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from deltas_geom.cameras.lenses.angles import (
    angle_ratio,
    root,
    sine_ratio_and_cosine,
    tangent_ratio,
)
from deltas_geom.numerics.arithmetic import only, unless_all

_TURN = 2e-4
"""Of the derivative at the axis: where a division has less, pixels are lost to rounding."""

Coefficients = Sequence[Tensor]  # each (*B, 1)
Seen = tuple[Tensor, Tensor, Tensor]
"""x and y on the plane, and whether they mean something."""
Direction = tuple[Tensor, Tensor, Tensor, Tensor]
"""x, y, z of a ray, and whether they mean something."""


def slopes(x: Tensor, y: Tensor, z: Tensor, farthest: float = 1e12) -> Seen:
    """x / z and y / z in front of the camera, below a slope that is nearly in its plane."""
    ahead = z * farthest > torch.maximum(x.abs(), y.abs())
    known = unless_all(ahead)
    z = only(z, known, other=1.0)
    return only(x, known) / z, only(y, known) / z, ahead


def pinhole_pixels(_: Coefficients, x: Tensor, y: Tensor, z: Tensor) -> Seen:
    """Slopes."""
    return slopes(x, y, z)


def pinhole_rays(_: Coefficients, u: Tensor, v: Tensor) -> Direction:
    """Of any slopes."""
    return u, v, torch.ones_like(u), torch.ones_like(u, dtype=torch.bool)


def fov_pixels(coefficients: Coefficients, x: Tensor, y: Tensor, z: Tensor) -> Seen:
    """r becomes atan(2 r tan(w / 2)) / w. Source: Devernay and Faugeras, 2001."""
    squared_omega, sound = _below(coefficients[0].square(), math.pi**2)
    x, y, ahead = slopes(x, y, z)
    widened = tangent_ratio(squared_omega / 4)
    squared = squared_omega * widened.square() * torch.addcmul(x * x, y, y)
    gain = widened * angle_ratio(squared, torch.ones_like(squared))
    return x * gain, y * gain, ahead & sound


def fov_rays(coefficients: Coefficients, u: Tensor, v: Tensor) -> Direction:
    """As long as r w is below a right angle."""
    squared_omega, sound = _below(coefficients[0].square(), math.pi**2)
    s = torch.addcmul(u * u, v, v)
    # Not to a right angle: the ray of its rounding would have any slope.
    squared, below = _below(squared_omega * s, (math.pi / 2 - 1e-9) ** 2)
    gain = tangent_ratio(squared) / tangent_ratio(squared_omega / 4)
    return u * gain, v * gain, torch.ones_like(u), below & sound


def division_pixels(coefficients: Coefficients, x: Tensor, y: Tensor, z: Tensor) -> Seen:
    """A distance r of the image is of the slope r / (1 + k r^2). Source: Fitzgibbon, 2001."""
    k = coefficients[0]
    squared = torch.addcmul(x * x, y, y)
    under = torch.addcmul(z * z, k, squared, value=-4)
    seen = (under > _TURN**2 * z * z) & ((z > 0) | ((k < 0) & (squared > 0)))
    ahead = z > 0
    distance = root(torch.where(seen, under, 1.0))
    # Two forms of one root of a quadratic, of which each cancels where the other is taken.
    near = 2 / torch.where(seen & ahead, z + distance, 1.0)
    behind = seen & ~ahead
    far = (z - distance) / torch.where(behind, 2 * k * squared, 1.0)
    gain = torch.where(ahead, near, far)
    return x * gain, y * gain, seen


def division_rays(coefficients: Coefficients, u: Tensor, v: Tensor) -> Direction:
    """Before 1 / sqrt(k) where k is positive; anywhere else."""
    depth = torch.addcmul(u * u, v, v) * coefficients[0]
    return u, v, 1 + depth, 1 - depth > _TURN * (1 + depth)


def eucm_pixels(coefficients: Coefficients, x: Tensor, y: Tensor, z: Tensor) -> Seen:
    """Source: Khomutenko, Garcia and Martinet, An enhanced unified camera model, 2016."""
    (alpha, beta), sound = _eucm(coefficients)
    squared = torch.addcmul(z * z, beta, torch.addcmul(x * x, y, y))
    positive = squared > 0
    distance = root(torch.where(positive, squared, 1.0))
    widest = torch.minimum(alpha, 1 - alpha) / torch.maximum(alpha, 1 - alpha)
    seen = positive & sound & (z > -widest * distance + 1e-12 * distance)
    below = torch.where(seen, alpha * distance + (1 - alpha) * z, 1.0)
    return x / below, y / below, seen


def eucm_rays(coefficients: Coefficients, u: Tensor, v: Tensor) -> Direction:
    """Within the circle at which alpha > 1/2 ends."""
    (alpha, beta), sound = _eucm(coefficients)
    squared = beta * torch.addcmul(u * u, v, v)
    under = torch.addcmul(squared.new_ones(()), 2 * alpha - 1, squared, value=-1)
    seen = (under > 0) & sound
    below = torch.addcmul(1 - alpha, alpha, root(torch.where(seen, under, 1.0)))
    z = torch.addcmul(squared.new_ones(()), alpha * alpha, squared, value=-1)
    safe = torch.where(seen, below, 1.0)
    return u, v, z / safe, seen


def _eucm(coefficients: Coefficients) -> tuple[Coefficients, Tensor]:
    alpha, beta = coefficients
    sound = (alpha >= 0) & (alpha <= 1) & (beta > 0)
    return (torch.where(sound, alpha, 0.0), torch.where(sound, beta, 1.0)), sound


def panorama_pixels(_: Coefficients, x: Tensor, y: Tensor, z: Tensor) -> Seen:
    """Longitude, which grows to the right, and latitude, which grows downwards, in rad."""
    squared = torch.addcmul(x * x, z, z)
    # Straight up and down there is any longitude.
    seen = squared > 1e-24 * y * y
    across = root(torch.where(seen, squared, 1.0))
    longitude = torch.atan2(torch.where(seen, x, 0.0), torch.where(seen, z, 1.0))
    return longitude, torch.atan2(y, across), seen


def panorama_rays(_: Coefficients, u: Tensor, v: Tensor) -> Direction:
    """Of longitudes within half a turn and latitudes within a quarter."""
    seen = (u.abs() <= math.pi) & (v.abs() <= math.pi / 2)
    known = unless_all(seen)
    u, v = only(u, known), only(v, known)
    (side, ahead), (down, across) = sine_ratio_and_cosine(u * u), sine_ratio_and_cosine(v * v)
    return across * u * side, v * down, across * ahead, seen


def _below(value: Tensor, limit: float) -> tuple[Tensor, Tensor]:
    """The values below a limit, 0 in place of others, and which are."""
    below = value < limit
    return torch.where(below, value, 0.0), below
