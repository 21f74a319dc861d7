"""The frame in which a point is solved.

Origin: the mean of the centres of the cameras that see the point, weighted as they are. Unit:
their spread. In this rig frame the algebraic error is nearly the angular one, the answer does not
depend on the world's origin or unit, and a view that is not used leaves no trace.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from deltas_geom.numerics.arithmetic import only, outside_gradients, unless_all
from deltas_geom.numerics.sums import over_views
from deltas_geom.numerics.vectors import Numbers, Symmetric4, Vector3, dot, scaled
from deltas_geom.triangulation.weights import Weights


class RigFrame(NamedTuple):
    """Where each of N points is solved: X = unit x + origin.

    Attributes:
        origin: three ``(*B, N)``, relative to the origin of the sums.
        unit: ``(*B, N)`` positive.
        total: ``(*B, N)`` sum of the squared weights; 1 if no view is used.
        middle: three ``(*B, N)``, of the used cameras, without gradient.
        reach: ``(*B, N)`` squared spread of the used cameras, all alike, around ``middle``.
        posed: ``(*B, N)`` bool: two or more cameras, apart by more than rounding.
        enough: ``(*B, N)`` bool: two or more cameras.
        finite: ``(*B, N)`` bool: everything that is used is.
    """

    origin: Vector3
    unit: Tensor
    total: Tensor
    middle: Vector3
    reach: Tensor
    posed: Tensor
    enough: Tensor
    finite: Tensor

    def held(self) -> "RigFrame":
        """The frame in which matrices are made: what depends on it is known without them."""
        origin = tuple(part.detach() for part in self.origin)
        return self._replace(origin=origin, unit=self.unit.detach())


def datum_of(centers: Tensor) -> Tensor:
    """A place in the world ``(*B, 1, 3)`` near the cameras: the origin of sums over them.

    Their median, coordinate by coordinate: a few that no point uses may stand anywhere.
    """
    middle = (centers.shape[-2] - 1) // 2
    return centers.detach().sort(dim=-2).values[..., middle : middle + 1, :]


Moments = tuple[Tensor, Tensor]
"""What is summed over each point's cameras, ``(*B, 5, V)`` weighted and ``(*B, 7, V)`` not."""


def rig_sums(moments: Moments, weights: Weights) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
    """What :func:`rig_frame` makes frames of: sums of :func:`camera_moments` over views."""
    weighted, counted = moments
    return over_views(weighted, weights.squared), over_views(counted, weights.used)


def camera_moments(centers: Tensor, datum: Tensor, broken: Tensor) -> Moments:
    """1, squared length and coordinates of offsets from the datum; also those of centres' lengths
    and of cameras that are broken.

    Args:
        centers: ``(*B, V, 3)`` of the cameras.
        datum: ``(*B, 1, 3)`` the origin of the sums, near the cameras.
        broken: ``(*B, V)`` 1 for cameras that are not finite, else 0.
    """
    offset = centers - datum
    square = offset.square().sum(dim=-1, keepdim=True)
    weighted = torch.cat([torch.ones_like(square), square, offset], dim=-1)
    from_world = centers.square().sum(dim=-1, keepdim=True).expand_as(square)
    counted = torch.cat([weighted, from_world, broken.unsqueeze(-1).expand_as(square)], dim=-1)
    return weighted.mT, counted.detach().mT


def rig_frame(weighted: tuple[Tensor, ...], counted: tuple[Tensor, ...], *, eps: float) -> RigFrame:
    """The frame of each point from sums over its cameras.

    Args:
        weighted: five ``(*B, N)``, the first of :func:`camera_moments`, by squared weights.
        counted: seven ``(*B, N)``, the second, each used view once.
        eps: rounding of the inputs, relative.
    """
    total, square, *offset = weighted
    # The largest squared weight is 1: less is no view, and its sums are 0.
    total = total.clamp(min=1)
    inverse = total.reciprocal()
    origin = scaled(tuple(offset), inverse)
    spread = square * inverse - dot(origin, origin)
    with outside_gradients():
        count, size, *offset, from_world, broken = counted
        share = count.clamp(min=1).reciprocal()
        size, middle = size * share, scaled(tuple(offset), share)
        reach = size - dot(middle, middle)
        own = torch.finfo(size.dtype).eps
        posed, enough = stand_apart(count, reach, size, share * from_world, eps=eps, own=own)
        apart = has_spread(spread, size, own=own)
    spread = only(spread, unless_all(apart), other=1.0)
    length = spread * spread.rsqrt()  # not sqrt, for which torch starts threads
    return RigFrame(origin, length, total, middle, reach, posed, enough, broken == 0)


def stand_apart(
    count: Numbers, reach: Numbers, size: Numbers, from_world: Numbers, *, eps: float, own: float
) -> tuple[Numbers, Numbers]:
    """Whether the cameras of each point are two or more and stand apart, and the former alone.

    By their count, the squared spread of their centres, and the mean squared distance of these from
    the datum and from the world's origin, ``(*B, N)`` each; ``eps`` is the relative rounding of the
    inputs, ``own`` that of these sums.
    """
    enough = count >= 2
    # Centres closer together than the rounding of where they are do not differ.
    apart = (reach > (64 * eps) ** 2 * from_world) & (reach > 16 * own * size)
    return enough & apart, enough


def has_spread(spread: Numbers, size: Numbers, *, own: float) -> Numbers:
    """Whether the weighted spread ``(*B, N)`` is a unit, and no rounding of the sums."""
    return spread > 1e-3 * own * size


def in_frame(normal: Symmetric4, origin: Vector3, length: Tensor) -> Symmetric4:
    """T^T M T for homogeneous points X = x + origin w / length.

    The unit is on w alone, which is the same up to scale and cheaper.
    """
    m00, m01, m02, m03, m11, m12, m13, m22, m23, m33 = normal
    o0, o1, o2 = origin

    def moved(last: Tensor, a: Tensor, b: Tensor, c: Tensor) -> Tensor:
        return torch.addcmul(torch.addcmul(torch.addcmul(last, a, o0), b, o1), c, o2)

    n03, n13, n23 = moved(m03, m00, m01, m02), moved(m13, m01, m11, m12), moved(m23, m02, m12, m22)
    n33 = moved(moved(m33, m03, m13, m23), n03, n13, n23)
    inverse = length.reciprocal()
    return (
        m00, m01, m02, n03 * inverse,
        m11, m12, n13 * inverse,
        m22, n23 * inverse,
        n33 * (inverse * inverse),
    )  # fmt: skip
