"""Weighted, masked n-view DLT triangulation; every point carries a Status."""

from functools import partial
from typing import Any

import torch
from torch import Tensor

from deltas_geom.numerics.arithmetic import outside_gradients, values_at_hand, without_autocast
from deltas_geom.numerics.chunks import cut_points
from deltas_geom.numerics.evaluation import Adjoint, Function, recomputed, transformed
from deltas_geom.triangulation.equations import Frame, Rig, check_settings, rig_of
from deltas_geom.triangulation.judge import ok
from deltas_geom.triangulation.long import LongWay
from deltas_geom.triangulation.observed import Cameras, cameras_of, check_observed
from deltas_geom.triangulation.results import Triangulation
from deltas_geom.triangulation.short import FEW, ShortRig, short_rig
from deltas_geom.triangulation.short_way import ShortWay


@without_autocast
def triangulate_points(
    proj: Tensor,
    pixels: Tensor,
    weights: Tensor | None = None,
    mask: Tensor | None = None,
    *,
    frame: Frame = "rig",
) -> Tensor:
    """Points ``(*B, N, 3)`` alone; see :func:`triangulate`, which also says which are valid.

    (0, 0, 0) stands for no answer, and may be one. Pixels handed over as (N, V, 2) where N = V go
    unnoticed here: the residuals of :func:`triangulate` show them.
    """
    return Call(KnownCameras(proj), pixels, weights, mask, frame).points()


@without_autocast
def triangulate(
    proj: Tensor,
    pixels: Tensor,
    weights: Tensor | None = None,
    mask: Tensor | None = None,
    *,
    frame: Frame = "rig",
    covariance: bool = False,
    max_residual: float | None = None,
) -> Triangulation:
    """Triangulate matched pixels of V views by weighted DLT, differentiably.

    Args:
        proj: ``(*B, V, 3, 4)`` K [R | t].
        pixels: ``(*B, V, N, 2)`` matches; those of unused views may hold anything.
        weights: ``(*B, V, N)`` not negative (a sign has no effect: the rows they multiply are
            squared). 0 = unused.
        mask: ``(*B, V, N)`` bool, True = used.
        frame: "rig" solves in each point's rig frame; "world" in the frame of ``proj``, as
            OpenCV and kornia do, whose answer depends on the world's origin and unit.
        covariance: also compute the covariance of the points.
        max_residual: px; points about which the views disagree by more are RESIDUAL_TOO_LARGE.
            Pixels handed over as (N, V, 2) where N = V have residuals of many pixels, too.

    Returns:
        Points with status, in the dtype of ``proj``. Nothing raises or turns NaN because of values.

    Raises:
        ShapeError: a trailing shape differs, or there is no view.
        TypeError: ``proj`` is not floating point, or the mask not bool.
        ValueError: ``max_residual`` is not positive.

    Source: Hartley and Zisserman, 2nd ed., section 12.2; weights as in the paper, section
    3.2, after Iskakov et al. (2019).

    Example:
        >>> left = torch.tensor([[100.0, 0, 50, 0], [0, 100, 40, 0], [0, 0, 1, 0]])
        >>> right = left.clone()
        >>> right[0, 3] = -20.0  # 20 cm to the right
        >>> pixels = torch.tensor([[[60.0, 40.0]], [[50.0, 40.0]]])
        >>> result = triangulate(torch.stack([left, right]), pixels)
        >>> result.points.round(decimals=3)
        tensor([[0.2000, 0.0000, 2.0000]])
    """
    call = Call(KnownCameras(proj), pixels, weights, mask, frame)
    found = call.full(covariance=covariance)
    return found if max_residual is None else found.within_residual(max_residual)


class KnownCameras:
    """Cameras ``(*B, V, 3, 4)``, and what depends on them alone, kept when it was first needed."""

    def __init__(self, proj: Tensor) -> None:
        self.proj = proj
        self._short: ShortRig | None = None
        self._long: Rig | None = None

    def cameras(self) -> Cameras:
        """In the solver's type, without gradient."""
        return self.short().cameras() if _at_hand(self.proj) else cameras_of(self.proj.detach())

    def short(self) -> ShortRig:
        """For few points."""
        if self._short is None:
            self._short = short_rig(self.proj.detach().numpy())
        return self._short

    def long(self) -> Rig:
        """For any number of points; without gradient."""
        if self._long is None:
            self._long = rig_of(self.cameras())
        return self._long


class Call:
    """One triangulation, with arguments of :func:`triangulate`: how it is computed and derived."""

    def __init__(
        self,
        known: KnownCameras,
        pixels: Tensor,
        weights: Tensor | None,
        mask: Tensor | None,
        frame: Frame,
    ) -> None:
        check_settings(frame)
        proj = known.proj
        self.batch = check_observed(proj=proj, pixels=pixels, weights=weights, mask=mask)
        self.tensors: tuple[Any, ...] = (proj, pixels, weights, mask)
        self.known, self.frame, self.dtype = known, frame, proj.dtype
        self.alike = weights is None and mask is None
        self.at_hand = all(map(_at_hand, self.tensors))
        count = self.batch.numel() * pixels.shape[-2]
        # The normal matrix of the world's frame loses digits that an SVD of the rows keeps.
        exactly = frame == "world" and proj.dtype == torch.float64
        self.way: ShortWay | LongWay
        if (
            self.at_hand
            and count > 0
            and (count <= FEW or exactly)
            and not transformed(*self.tensors)
        ):
            self.way = ShortWay(known.short(), frame, proj.dtype)
        else:
            self.way = self.long(known.long())

    def long(self, rig: Rig) -> LongWay:
        """The long way by these cameras."""
        return LongWay(rig, self.batch, self.frame, self.dtype, alike=self.alike)

    def solved(self) -> tuple[Tensor, Tensor]:
        """Points ``(*B, N, 3)`` in the solver's type and their status, without gradient."""
        with outside_gradients():
            return self.way.solved(*self.tensors[1:])

    def points(self) -> Tensor:
        """Points ``(*B, N, 3)``."""

        def derivable(proj: Tensor, *seen: Any) -> tuple[Tensor]:
            return self.long(rig_of(cameras_of(proj))).points(*seen, derivable=True)

        def adjoint(
            gradients: tuple[Tensor], needed: tuple[bool, ...], *tensors: Any
        ) -> tuple[Tensor | None, ...]:
            found = self.way.adjoint(gradients[0], needed, *tensors[1:])
            return (*map(_shaped_as, found, tensors), None)

        return self._computed(derivable, self.way.points, (-2,), adjoint)[0]

    def full(self, *, covariance: bool) -> Triangulation:
        """Points with all that is known about them."""

        def derivable(proj: Tensor, *seen: Any) -> tuple[Tensor, ...]:
            return self.long(rig_of(cameras_of(proj))).full(
                *seen, covariance=covariance, derivable=True
            )

        values = partial(self.way.full, covariance=covariance)
        dims = (-2, -1, -1, -1, -1, *([-3] if covariance else []), -1)
        found = self._computed(derivable, values, dims)
        points, depth, residual, parallax, errors, *noise, status = found
        cov, angle = noise[0] if noise else None, parallax.detach()
        return Triangulation(points, depth, status, ok(status), residual, angle, cov, errors)

    def _computed(
        self,
        function: Function,
        values: Function,
        outputs: tuple[int, ...],
        adjoint: Adjoint | None = None,
    ) -> tuple[Tensor, ...]:
        serial = self.at_hand and adjoint is not None and self.dtype == torch.float32
        cut = cut_points(self.tensors[1], -2, -1, -1, outputs=outputs, serial=serial)

        def of_seen(_: Tensor, *seen: Any) -> tuple[Tensor, ...]:
            return values(*seen)

        return recomputed(function, *self.tensors, values=of_seen, cut=cut, adjoint=adjoint)


def _at_hand(tensor: Tensor | None) -> bool:
    """Are there values to look at, and does NumPy know their type, as it does not bfloat16?"""
    known = (torch.float32, torch.float64, torch.bool)
    return tensor is None or (values_at_hand(tensor) and tensor.dtype in known)


def _shaped_as(gradient: Tensor | None, tensor: Tensor | None) -> Tensor | None:
    """The gradient of a tensor that was broadcast and cast, in its own shape and type."""
    if gradient is None or tensor is None:
        return None
    return gradient.sum_to_size(tensor.shape).to(tensor.dtype)
