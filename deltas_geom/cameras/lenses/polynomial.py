"""Models that distort by a polynomial: where points of the camera's frame appear, and rays."""

import math
from functools import reduce
from typing import NamedTuple, Self

import torch
from torch import Tensor

from deltas_geom.cameras.lenses.angles import angle_ratio, sine_ratio_and_cosine
from deltas_geom.cameras.lenses.closed import Coefficients, Direction, Seen, slopes
from deltas_geom.cameras.lenses.inverse import follow, undistort
from deltas_geom.cameras.lenses.terms import Terms, distort, one_to_one_within
from deltas_geom.numerics.arithmetic import only, unless_all


class Places(NamedTuple):
    """Which coefficients are which terms of a distortion.

    Attributes:
        radial: places of coefficients of r^2, r^4, ... in the numerator.
        divided: in the denominator.
        tangential: x and y.
        prism: x and y of r^2, then perhaps x and y of r^4.
    """

    radial: tuple[int, ...] = ()
    divided: tuple[int, ...] = ()
    tangential: tuple[int, ...] = ()
    prism: tuple[int, ...] = ()

    def terms(self, coefficients: Coefficients) -> Terms:
        """The terms of these coefficients."""
        return Terms(*(tuple(coefficients[k] for k in places) for places in self))


class Polynomial(NamedTuple):
    """One distortion of slopes, or of angles, after the other.

    Attributes:
        angles: is it the angle from the axis that is distorted (fisheye), not its tangent?
        steps: each of what the one before it gave.
    """

    angles: bool
    steps: tuple[Places, ...]

    @classmethod
    def named(cls, names: str, *steps: dict[str, str], angles: bool) -> Self:
        """With the names of coefficients in place of their places among ``names``."""
        place = {name: k for k, name in enumerate(names.split())}

        def placed(step: dict[str, str]) -> Places:
            return Places(
                **{kind: tuple(place[n] for n in of.split()) for kind, of in step.items()}
            )

        return cls(angles, tuple(map(placed, steps)))

    @property
    def around_axis(self) -> bool:
        """As :attr:`Model.around_axis`, which asks the first step alone."""
        return not (self.steps[0].tangential or self.steps[0].prism)

    def reach(self, coefficients: Coefficients) -> Tensor:
        """How far from the axis each step is one to one, ``(*B, steps)``."""
        first, *others = (step.terms(coefficients) for step in self.steps)
        ends = [one_to_one_within(first, math.pi if self.angles else math.inf)]
        return torch.cat([*ends, *map(one_to_one_within, others)], dim=-1)

    def pixels(
        self, coefficients: Coefficients, reach: Tensor, x: Tensor, y: Tensor, z: Tensor
    ) -> Seen:
        """As :attr:`Model.pixels`."""
        x, y, seen = _angles(x, y, z) if self.angles else slopes(x, y, z)
        for step, end in zip(self.steps, torch.split(reach, 1, dim=-1), strict=True):
            seen = seen & (torch.addcmul(x * x, y, y) < end * end)
            known = unless_all(seen)
            x, y = distort(step.terms(coefficients), only(x, known), only(y, known))
        return x, y, seen

    def rays(
        self, coefficients: Coefficients, reach: Tensor, u: Tensor, v: Tensor, derivable: bool
    ) -> Direction:
        """As :attr:`Model.rays`."""
        u, v, found = _plane(self.steps[0].terms(coefficients), reach[..., :1], u, v, derivable)
        return (*(_from_angles(u, v) if self.angles else _from_slopes(u, v)), found)

    def undone(
        self, coefficients: Coefficients, reach: Tensor, u: Tensor, v: Tensor, derivable: bool
    ) -> Seen:
        """As :attr:`Model.undone`: all steps but the first."""
        masks = []
        for step, end in zip(self.steps[:0:-1], torch.split(reach, 1, dim=-1)[:0:-1], strict=True):
            u, v, within = _plane(step.terms(coefficients), end, u, v, derivable)
            masks.append(within)
        return u, v, reduce(torch.logical_and, masks)


def _plane(terms: Terms, reach: Tensor, u: Tensor, v: Tensor, derivable: bool) -> Seen:
    """The point that was distorted to (u, v), 0 where there is none."""
    point = undistort(terms, u.detach(), v.detach(), reach)
    known = unless_all(point.found)
    x, y = only(point.x, known), only(point.y, known)
    if derivable:
        point = point._replace(x=x, y=y)
        x, y = follow(terms, point, only(u, known), only(v, known))
    return x, y, point.found


def _angles(x: Tensor, y: Tensor, z: Tensor) -> Seen:
    """The point at the angle from the axis, in the direction of (x, y)."""
    squared = torch.addcmul(x * x, y, y)
    # Straight behind there is any direction.
    seen = (z > 0) | (squared > 1e-24 * z * z)
    known = unless_all(seen & (squared + z * z > 0))
    x, y, z = only(x, known), only(y, known), only(z, known, other=1.0)
    ratio = angle_ratio(only(squared, known), z)
    return x * ratio, y * ratio, seen


def _from_angles(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    ratio, z = sine_ratio_and_cosine(torch.addcmul(x * x, y, y))
    return x * ratio, y * ratio, z


def _from_slopes(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    z = torch.addcmul(torch.addcmul(torch.ones_like(x), x, x), y, y).rsqrt()
    return x * z, y * z, z
