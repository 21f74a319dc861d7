"""The short way as its caller sees it: tensors in, tensors out."""

import numpy as np
import torch
from torch import Tensor

from deltas_geom.numerics.vectors import Array
from deltas_geom.triangulation.equations import Frame
from deltas_geom.triangulation.reprojection import reproject
from deltas_geom.triangulation.short import ShortRig, Solved, describe, solve
from deltas_geom.triangulation.short_adjoint import gradients
from deltas_geom.triangulation.uncertainty import covariance_of, representable, unscaled


class ShortWay:
    """Triangulation of few pixels whose shapes have been checked; float32 or float64."""

    def __init__(self, rig: ShortRig, frame: Frame, dtype: torch.dtype) -> None:
        self.rig, self.fixed = rig, frame == "world"
        self.dtype = np.dtype(np.float64 if dtype == torch.float64 else np.float32)
        self._last: tuple[object, Solved] | None = None

    def solved(
        self, pixels: Tensor, weights: Tensor | None, mask: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Points in float64 and their status, without gradient."""
        solved = self._solve(pixels, weights, mask)
        return torch.from_numpy(solved.points), torch.from_numpy(solved.status)

    def points(
        self, pixels: Tensor, weights: Tensor | None, mask: Tensor | None
    ) -> tuple[Tensor, ...]:
        """Points alone, without gradient."""
        return (self._outward(self._solve(pixels, weights, mask).points),)

    def full(
        self, pixels: Tensor, weights: Tensor | None, mask: Tensor | None, *, covariance: bool
    ) -> tuple[Tensor, ...]:
        """The fields of a :class:`Triangulation`, status last, without gradient."""
        solved = self._solve(pixels, weights, mask)
        found = [self._outward(one) for one in (solved.points, *describe(self.rig, solved))]
        if covariance:
            found.append(self._covariance(solved))
        return *found, torch.from_numpy(solved.status)

    def adjoint(
        self,
        gradient: Tensor,
        needed: tuple[bool, ...],
        pixels: Tensor,
        weights: Tensor | None,
        mask: Tensor | None,
    ) -> tuple[Tensor | None, ...]:
        """Gradients by cameras, pixels and weights of points with this gradient."""
        known = self._last is not None and self._last[0] == _place_of(pixels)
        solved = self._last[1] if self._last and known else self._solve(pixels, weights, mask)
        outer = gradient.resolve_neg().numpy().astype(np.float64)
        proj, by_pixels, by_size = gradients(
            self.rig, solved, outer, fixed=self.fixed, of_cameras=needed[0]
        )
        return (
            None if proj is None else torch.from_numpy(proj),
            torch.from_numpy(by_pixels),
            None
            if weights is None
            else torch.from_numpy(by_size) * torch.where(weights < 0, -1.0, 1.0),
        )

    def _covariance(self, solved: Solved) -> Tensor:
        proj, points = torch.from_numpy(self.rig.proj), torch.from_numpy(solved.points)
        share, used, largest = (
            torch.from_numpy(one).mT for one in (solved.share, solved.used, solved.largest)
        )
        used = used & torch.from_numpy(solved.status == 0).unsqueeze(-2)
        seen = reproject(proj, points.unbind(dim=-1), used)
        noise = unscaled(covariance_of(proj, seen, share * share), largest.squeeze(-2))
        return representable(noise, torch.float64 if self.dtype.itemsize == 8 else torch.float32)

    def _solve(self, *seen: Tensor | None) -> Solved:
        pixels, weights, mask = (None if t is None else t.detach().numpy() for t in seen)
        assert pixels is not None and seen[0] is not None
        solved = solve(self.rig, pixels, weights, mask, fixed=self.fixed, dtype=self.dtype)
        self._last = _place_of(seen[0]), solved  # for the backward pass, if it is the same chunk
        return solved

    def _outward(self, values: Array) -> Tensor:
        limit = float(np.finfo(self.dtype).max)  # type: ignore[type-var]
        return torch.from_numpy(np.minimum(np.maximum(values, -limit), limit).astype(self.dtype))


def _place_of(pixels: Tensor) -> tuple[object, ...]:
    return pixels.data_ptr(), pixels.shape, pixels.stride()
