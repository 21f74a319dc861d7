"""The long way, for any number of points: element by element, some at a time.

A point is a null vector of its normal matrix (dlt.py), in its own rig frame (rig_frame.py), in
float64 where the device has it, found by arithmetic alone (null_vector.py).
"""

from typing import NamedTuple

import torch
from torch import Tensor

from deltas_geom.cameras.homogeneous import safe_sqrt
from deltas_geom.numerics.arithmetic import surely_all
from deltas_geom.numerics.ldl import Vector4
from deltas_geom.triangulation.adjoint import gradients_of
from deltas_geom.triangulation.equations import (
    Equations,
    Frame,
    Rig,
    alike_of,
    equations_of,
    product_of,
)
from deltas_geom.triangulation.judge import judge, ok
from deltas_geom.triangulation.observed import Observations, Vector3, in_parts
from deltas_geom.triangulation.reprojection import (
    in_views,
    mean_of,
    parallax_of,
    reproject,
    squared_errors,
)
from deltas_geom.triangulation.solution import (
    FoundPoints,
    derivable_points,
    find_points,
    in_world,
    kept,
)
from deltas_geom.triangulation.uncertainty import covariance_of, representable, unpacked3


class Solved(NamedTuple):
    """Points without gradient.

    Attributes:
        equations: theirs.
        vector: their null vectors in the frame.
        points: three ``(*B, N)`` in the world; anything where they fail.
        status: ``(*B, N)``.
    """

    equations: Equations
    vector: Vector4
    points: Vector3
    status: Tensor


class LongWay:
    """Triangulation of pixels whose shapes have been checked.

    Args:
        rig: of the cameras.
        batch: of all inputs together.
        frame: in which points are solved.
        dtype: of the results.
        alike: are there neither weights nor a mask, so that all points share a frame?
    """

    def __init__(
        self, rig: Rig, batch: torch.Size, frame: Frame, dtype: torch.dtype, *, alike: bool
    ) -> None:
        self.rig, self.batch, self.frame, self.dtype = rig, batch, frame, dtype
        self.alike = alike_of(rig, frame, torch.finfo(dtype).eps) if alike else None

    def solved(
        self, pixels: Tensor, weights: Tensor | None, mask: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Points in the solver's type and their status, without gradient."""
        solved = self.solve(self.see(pixels, weights, mask))
        return torch.stack(kept(solved.points, ok(solved.status)), dim=-1), solved.status

    def points(
        self, pixels: Tensor, weights: Tensor | None, mask: Tensor | None
    ) -> tuple[Tensor, ...]:
        """Points alone, without gradient."""
        solved = self.solve(self.see(pixels, weights, mask))
        return (self.outward(kept(solved.points, ok(solved.status))),)

    def full(
        self, pixels: Tensor, weights: Tensor | None, mask: Tensor | None, *, covariance: bool
    ) -> tuple[Tensor, ...]:
        """The fields of a :class:`Triangulation`, status last, without gradient."""
        solved = self.solve(self.see(pixels, weights, mask))
        points = kept(solved.points, ok(solved.status))
        return self.described(solved.equations, points, solved.status, covariance)

    def see(self, pixels: Tensor, weights: Tensor | None, mask: Tensor | None) -> Equations:
        """The equations of what is seen."""
        parts = in_parts(pixels, weights, mask, self.batch)
        eps = torch.finfo(self.dtype).eps
        return equations_of(self.rig, parts, frame=self.frame, eps=eps, alike=self.alike)

    def solve(self, equations: Equations) -> Solved:
        """The points that minimise the algebraic error, and their status, without gradient."""
        with torch.no_grad():
            return self._solve(equations)

    def _solve(self, equations: Equations) -> Solved:
        def product(x: Vector4) -> Vector4:
            return product_of(equations, x)

        # What the normal matrix loses of the rows' digits matters to those who have them.
        polish = 2 if self.dtype == torch.float64 else 0
        found = find_points(
            equations.normal, equations.frame, eps=equations.eps, product=product, polish=polish
        )
        places = in_world(found.points, equations.rig.datum)
        return Solved(equations, found.vector, places, self._judged(equations, found, places))

    def _judged(self, equations: Equations, found: FoundPoints, places: Vector3) -> Tensor:
        # A projection matrix is K [R | t] with K[2, 2] = 1: its third row gives metric depth.
        row = equations.rig.near[..., 2, :]

        def nearest(part: Observations, *points: Tensor) -> tuple[Tensor]:
            depth, unused = in_views(row, points), part.weights.unused
            if not surely_all(~unused):
                depth = torch.where(unused, 1.0, depth)
            return (depth.amin(dim=-2),)

        (depth,) = equations.each(nearest, *found.points)
        x, y, z = places
        held = x.abs() + y.abs() + z.abs() <= torch.finfo(self.dtype).max
        frame = equations.frame
        return judge(
            finite=frame.finite,
            enough=frame.enough,
            posed=found.posed,
            near=found.near & held,
            in_front=depth > 0,
        )

    def derive(self, equations: Equations) -> tuple[Vector3, Tensor]:
        """Points in the world, 0 where they fail, differentiably; and their status."""
        solved = self.solve(equations)
        valid = ok(solved.status)
        near = derivable_points(equations.normal, equations.frame, solved.vector, valid)
        return kept(in_world(near, equations.rig.datum), valid), solved.status

    def described(
        self, equations: Equations, points: Vector3, status: Tensor, covariance: bool
    ) -> tuple[Tensor, ...]:
        """The fields of a :class:`Triangulation`, status last."""
        cameras, valid = equations.rig.cameras, ok(status)

        def seen(part: Observations, valid: Tensor, *points: Tensor) -> tuple[Tensor, ...]:
            (px, py, weights), (x, y, z), valid = part, points, valid.unsqueeze(-2)
            used = ~weights.unused & valid
            found = reproject(cameras.proj, (x, y, z), used)
            squared, depth = squared_errors(found, px, py), found.depth
            if not surely_all(found.seen):
                # At a used camera's centre, in front of it by rounding, it may be behind by that.
                depth = torch.where(used, depth.clamp(min=0), torch.where(valid, depth, 0.0))
            outward = [
                self._fitting(one)
                for one in (
                    depth,
                    mean_of(squared, found.seen, weights.squared),
                    parallax_of(cameras.centers, (x, y, z), used.to(found.x.dtype)),
                    safe_sqrt(squared),
                )
            ]
            if covariance:
                outward += covariance_of(cameras.proj, found, weights.squared)
                outward.append(weights.largest.squeeze(-2).expand_as(x))
            return tuple(outward)

        depth, residual, parallax, errors, *noise = equations.each(seen, valid, *points)
        described: tuple[Tensor, ...] = (self.outward(points), depth, residual, parallax, errors)
        if covariance:
            xx, xy, xz, yy, yz, zz, largest = noise
            unit = largest[..., None, None]
            # Divided twice: the square of a small weight may be 0.
            spread = unpacked3((xx, xy, xz, yy, yz, zz)) / unit / unit
            described = (*described, representable(spread, self.dtype))
        return (*described, status)

    def adjoint(
        self,
        gradient: Tensor,
        needed: tuple[bool, ...],
        pixels: Tensor,
        weights: Tensor | None,
        mask: Tensor | None,
    ) -> tuple[Tensor | None, ...]:
        """Gradients by cameras, pixels and weights of points with this gradient."""
        solved = self.solve(self.see(pixels, weights, mask))
        work = solved.points[0].dtype
        gx, gy, gz = (component.to(work) for component in gradient.unbind(dim=-1))
        found = gradients_of(
            solved.equations,
            solved.vector,
            ok(solved.status),
            (gx, gy, gz),
            weights=weights if needed[2] else None,
            of_cameras=needed[0],
            dtype=pixels.dtype,
        )
        return found.proj, found.pixels, found.weights

    def outward(self, points: Vector3) -> Tensor:
        """Three ``(*B, N)`` as ``(*B, N, 3)`` of the caller's type."""
        return torch.stack([self._fitting(component) for component in points], dim=-1)

    def _fitting(self, values: Tensor) -> Tensor:
        limit = torch.finfo(self.dtype).max
        return values.clamp(-limit, limit).to(self.dtype)
