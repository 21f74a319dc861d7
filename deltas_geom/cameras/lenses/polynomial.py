"""Models that distort by a polynomial: where points of the camera's frame appear, and rays."""

import math
from typing import NamedTuple, Self

import torch
from torch import Tensor

from deltas_geom.cameras.lenses.angles import angle_ratio, sine_ratio_and_cosine
from deltas_geom.cameras.lenses.closed import Coefficients, Direction, Seen, slopes
from deltas_geom.cameras.lenses.inverse import follow, undistort
from deltas_geom.cameras.lenses.terms import Terms, distort, one_to_one_within
from deltas_geom.numerics.arithmetic import only, unless_all


class Polynomial(NamedTuple):
    """Which coefficients are which terms of a distortion of slopes, or of angles.

    Attributes:
        angles: is it the angle from the axis that is distorted (fisheye), not its tangent?
        radial: places of coefficients of r^2, r^4, ... in the numerator.
        divided: in the denominator.
        tangential: x and y.
        prism: x and y of r^2, then perhaps x and y of r^4.
    """

    angles: bool
    radial: tuple[int, ...] = ()
    divided: tuple[int, ...] = ()
    tangential: tuple[int, ...] = ()
    prism: tuple[int, ...] = ()

    @classmethod
    def named(cls, names: str, *, angles: bool, **kinds: str) -> Self:
        """With the names of coefficients in place of their places among ``names``."""
        place = {name: k for k, name in enumerate(names.split())}
        return cls(
            angles, **{kind: tuple(place[n] for n in of.split()) for kind, of in kinds.items()}
        )

    @property
    def around_axis(self) -> bool:
        """As :attr:`Model.around_axis`."""
        return not self.tangential and not self.prism

    def terms(self, coefficients: Coefficients) -> Terms:
        """The terms of these coefficients."""
        parts = [tuple(coefficients[k] for k in places) for places in self[1:]]
        return Terms(*parts)

    def reach(self, coefficients: Coefficients) -> Tensor:
        """How far from the axis the model is one to one, ``(*B, 1)``."""
        return one_to_one_within(self.terms(coefficients), math.pi if self.angles else math.inf)

    def pixels(
        self, coefficients: Coefficients, reach: Tensor, x: Tensor, y: Tensor, z: Tensor
    ) -> Seen:
        """As :attr:`Model.pixels`."""
        x, y, ahead = _angles(x, y, z) if self.angles else slopes(x, y, z)
        seen = ahead & (torch.addcmul(x * x, y, y) < reach * reach)
        known = unless_all(seen)
        u, v = distort(self.terms(coefficients), only(x, known), only(y, known))
        return u, v, seen

    def rays(
        self, coefficients: Coefficients, reach: Tensor, u: Tensor, v: Tensor, derivable: bool
    ) -> Direction:
        """As :attr:`Model.rays`."""
        x, y, found = _plane(self.terms(coefficients), reach, u, v, derivable)
        return (*(_from_angles(x, y) if self.angles else _from_slopes(x, y)), found)


class _Aria(NamedTuple):
    """A radial distortion of angles, and after it a tangential and a prism's: Aria's cameras.

    Source: https://facebookresearch.github.io/projectaria_tools, "Fisheye624".
    """

    first: Polynomial
    second: Polynomial

    def reach(self, coefficients: Coefficients) -> Tensor:
        """That of each step, ``(*B, 2)``."""
        parts = self.first.reach(coefficients), self.second.reach(coefficients)
        return torch.cat(parts, dim=-1)

    def pixels(
        self, coefficients: Coefficients, reach: Tensor, x: Tensor, y: Tensor, z: Tensor
    ) -> Seen:
        """As :attr:`Model.pixels`."""
        x, y, seen = self.first.pixels(coefficients, reach[..., :1], x, y, z)
        seen = seen & (torch.addcmul(x * x, y, y) < reach[..., 1:].square())
        known = unless_all(seen)
        u, v = distort(self.second.terms(coefficients), only(x, known), only(y, known))
        return u, v, seen

    def rays(
        self, coefficients: Coefficients, reach: Tensor, u: Tensor, v: Tensor, derivable: bool
    ) -> Direction:
        """As :attr:`Model.rays`."""
        return self.first.rays(coefficients, reach[..., :1], u, v, derivable)

    def undone(
        self, coefficients: Coefficients, reach: Tensor, u: Tensor, v: Tensor, derivable: bool
    ) -> Seen:
        """As :attr:`Model.undone`."""
        return _plane(self.second.terms(coefficients), reach[..., 1:], u, v, derivable)


prism_of_aria = _Aria(
    Polynomial(angles=True, radial=(0, 1, 2, 3, 4, 5)),
    Polynomial(angles=False, tangential=(6, 7), prism=(8, 10, 9, 11)),
)


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
