"""The long way, for any number of points: element by element, some at a time.

A point is a null vector of its normal matrix (dlt.py), in its own rig frame (rig_frame.py), in
float64 where the device has it, found by arithmetic alone (null_vector.py).
"""

from typing import Any

import torch
from torch import Tensor

from deltas_geom.cameras.homogeneous import safe_sqrt
from deltas_geom.numerics.arithmetic import surely_all
from deltas_geom.numerics.vectors import Vector3, as_one
from deltas_geom.triangulation.adjoint import gradients_of
from deltas_geom.triangulation.equations import Equations, Frame, Rig, alike_of, equations_of
from deltas_geom.triangulation.judge import ok
from deltas_geom.triangulation.observed import observe
from deltas_geom.triangulation.reprojection import mean_of, parallax_of, reproject, squared_errors
from deltas_geom.triangulation.solution import follow_linear, in_world, kept, solve_linear
from deltas_geom.triangulation.uncertainty import covariance_of, representable, unscaled


class LongWay:
    """Triangulation of pixels whose shapes have been checked.

    All inputs have one ``batch``, results the dtype. Points are ``alike``, and share a frame, if
    there are neither weights nor a mask.
    """

    def __init__(
        self, rig: Rig, batch: torch.Size, frame: Frame, dtype: torch.dtype, *, alike: bool
    ) -> None:
        self.rig, self.batch, self.frame, self.dtype = rig, batch, frame, dtype
        self.alike = alike_of(rig, frame, dtype) if alike else None

    def solved(self, *seen: Any) -> tuple[Tensor, Tensor]:
        """Points in the solver's type and their status, without gradient."""
        _, points, status = self.placed(*seen, derivable=False)
        return as_one(points, points[0].dtype), status

    def points(self, *seen: Any, derivable: bool = False) -> tuple[Tensor]:
        """Points alone."""
        return (self._outward(self.placed(*seen, derivable=derivable)[1]),)

    def full(self, *seen: Any, covariance: bool, derivable: bool = False) -> tuple[Tensor, ...]:
        """The fields of a :class:`Triangulation`, status last."""
        equations, points, status = self.placed(*seen, derivable=derivable)
        cameras, valid = equations.rig.cameras, ok(status).unsqueeze(-2)
        px, py, weights = equations.observed
        used = ~weights.unused & valid
        found = reproject(cameras.proj, points, used)
        squared, depth = squared_errors(found, px, py), found.depth
        if not surely_all(found.seen):
            # At a used camera's centre, in front of it by rounding, it may be behind by that.
            depth = torch.where(used, depth.clamp(min=0), torch.where(valid, depth, 0.0))
        fields = (
            depth,
            mean_of(squared, found.seen, weights.squared),
            parallax_of(cameras.centers, points, used.to(depth.dtype)),
            safe_sqrt(squared),
        )
        described = (self._outward(points), *(self._clamped(x).to(self.dtype) for x in fields))
        if covariance:
            noise = unscaled(
                covariance_of(cameras.proj, found, weights.squared), weights.largest.squeeze(-2)
            )
            described = (*described, representable(noise, self.dtype))
        return (*described, status)

    def placed(self, *seen: Any, derivable: bool) -> tuple[Equations, Vector3, Tensor]:
        """The equations, points in the world, 0 where they fail, and their status."""
        equations = self.see(*seen)
        found, status = solve_linear(equations)
        valid = ok(status)
        if derivable:
            found = follow_linear(equations, found, valid)
        return equations, kept(in_world(found.points, self.rig.datum), valid), status

    def see(self, pixels: Tensor, weights: Tensor | None, mask: Tensor | None) -> Equations:
        """The equations of what is seen."""
        seen = observe(pixels, weights, mask, self.batch)
        return equations_of(self.rig, seen, frame=self.frame, dtype=self.dtype, alike=self.alike)

    def adjoint(
        self,
        gradient: Tensor,
        needed: tuple[bool, ...],
        pixels: Tensor,
        weights: Tensor | None,
        mask: Tensor | None,
    ) -> tuple[Tensor | None, ...]:
        """Gradients by cameras, pixels and weights of points with this gradient."""
        equations = self.see(pixels, weights, mask)
        solved, status = solve_linear(equations)
        return gradients_of(
            equations,
            solved.vector,
            ok(status),
            gradient.to(solved.vector[0].dtype).unbind(dim=-1),
            weights=weights if needed[2] else None,
            of_cameras=needed[0],
            dtype=pixels.dtype,
        )

    def _outward(self, points: Vector3) -> Tensor:
        """Three ``(*B, N)`` as ``(*B, N, 3)`` of the caller's type."""
        return as_one([self._clamped(component) for component in points], self.dtype)

    def _clamped(self, values: Tensor) -> Tensor:
        limit = torch.finfo(self.dtype).max
        return values.clamp(-limit, limit)
