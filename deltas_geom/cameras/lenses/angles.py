"""Functions of the square of an angle: smooth where it is 0, and made of sums and products.

Torch's sine, cosine and tangent start threads from 2048 numbers on, and its sinc takes 30 ns.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

_SMALL = 1e-3
"""Squared angles below which five terms of a series are exact in float64."""
_ARC_TANGENT = [1 / 9, -1 / 7, 1 / 5, -1 / 3, 1.0]
# Of half of an angle up to pi: the next term is below rounding.
_SINE = [(-1) ** k / math.factorial(2 * k + 1) for k in range(11, -1, -1)]
_COSINE = [(-1) ** k / math.factorial(2 * k) for k in range(12, -1, -1)]


def root(squared: Tensor) -> Tensor:
    """The square root of what is positive."""
    return squared * squared.rsqrt()


def sine_ratio_and_cosine(squared: Tensor) -> tuple[Tensor, Tensor]:
    """sin(a) / a and cos(a) of the square of an angle up to pi, to rounding of 1."""
    quarter = squared / 4
    sine, cosine = _series(_SINE, quarter), _series(_COSINE, quarter)
    return sine * cosine, 1 - 2 * quarter * sine * sine


def tangent_ratio(squared: Tensor) -> Tensor:
    """tan(a) / a of the square of an angle, which is below a right one."""
    sine, cosine = sine_ratio_and_cosine(squared)
    return sine / cosine


def angle_ratio(squared: Tensor, z: Tensor) -> Tensor:
    """a / r of r^2 and z, a being the angle from the z axis to a point r from it.

    r is positive where z is not.
    """
    small = (squared < _SMALL * z * z) & (z > 0)
    forward = torch.where(small, z, 1.0)
    near = _series(_ARC_TANGENT, torch.where(small, squared, 0.0) / (forward * forward)) / forward
    r = root(torch.where(small, 1.0, squared))
    return torch.where(small, near, torch.atan2(r, z) / r)


def _series(coefficients: Sequence[float], x: Tensor) -> Tensor:
    value = coefficients[0] * x + coefficients[1]
    for coefficient in coefficients[2:]:
        value = torch.addcmul(x.new_full((), coefficient), value, x)
    return value
