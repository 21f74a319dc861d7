"""Functions of an angle, smooth where it is 0, none of which starts threads for few numbers.

Torch's sine, cosine, tangent, arc tangent and root start some from 2048 numbers on; its sinc, arc
tangent of two and reciprocal root do not.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

_SMALL = 1e-3
"""Squared angles below which five terms of a series are exact in float64."""
_ARC_TANGENT = [1 / 9, -1 / 7, 1 / 5, -1 / 3, 1.0]
_TANGENT = [62 / 2835, 17 / 315, 2 / 15, 1 / 3, 1.0]


def root(squared: Tensor) -> Tensor:
    """The square root of what is positive."""
    return squared * squared.rsqrt()


def sine_ratio(angle: Tensor) -> Tensor:
    """sin(a) / a."""
    return torch.sinc(angle / math.pi)


def cosine(angle: Tensor) -> Tensor:
    """cos(a), to rounding of 1."""
    half = angle / 2
    sine = half * sine_ratio(half)
    return torch.addcmul(angle.new_ones(()), sine, sine, value=-2)


def tangent_ratio(squared: Tensor) -> Tensor:
    """tan(a) / a of the square of an angle, which is below a right one."""
    small = squared < _SMALL
    angle = root(torch.where(small, 1.0, squared))
    ratio = sine_ratio(angle) / cosine(angle)
    return torch.where(small, _series(_TANGENT, squared), ratio)


def angle_ratio(squared: Tensor, z: Tensor) -> Tensor:
    """a / r, where a is the angle between the z axis and a point at a distance r from it.

    Args:
        squared: of r; positive where z is not.
        z: along the axis.
    """
    small = (squared < _SMALL * z * z) & (z > 0)
    forward = torch.where(small, z, 1.0)
    near = _series(_ARC_TANGENT, torch.where(small, squared, 0.0) / (forward * forward)) / forward
    r = root(torch.where(small, 1.0, squared))
    return torch.where(small, near, torch.atan2(r, z) / r)


def _series(coefficients: Sequence[float], x: Tensor) -> Tensor:
    value = torch.full_like(x, coefficients[0])
    for coefficient in coefficients[1:]:
        value = value * x + coefficient
    return value
