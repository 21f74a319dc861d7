"""Triangulation by cameras that stay, frame after frame."""

from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

import torch
from torch import Tensor

from deltas_geom.checks import check_shapes, tracing
from deltas_geom.numerics.arithmetic import at_least_single, without_autocast
from deltas_geom.triangulation.equations import Frame, check_settings
from deltas_geom.triangulation.results import Triangulation
from deltas_geom.triangulation.triangulate import Call, KnownCameras

_Found = TypeVar("_Found")


class PreparedTriangulator:
    """Keeps what depends on the cameras alone; :meth:`Triangulator.prepare` makes it.

    Answers and gradients, also those by the cameras, are those of :func:`triangulate`. Cameras that
    are changed in place are noticed, and looked at anew; not so through ``proj.data`` or a NumPy
    array behind ``proj``, nor others that ``torch.func.functional_call`` lends to a network. It is
    no ``nn.Module``: ``net.to(...)`` leaves it behind, :meth:`to` moves it.

    Args:
        proj: ``(*B, V, 3, 4)`` K [R | t].
        frame: as for :func:`triangulate`.
        covariance: as for :func:`triangulate`.
        max_residual: as for :func:`triangulate`.

    Example:
        >>> left = torch.tensor([[100.0, 0, 50, 0], [0, 100, 40, 0], [0, 0, 1, 0]])
        >>> right = left.clone()
        >>> right[0, 3] = -20.0  # 20 cm to the right
        >>> rig = PreparedTriangulator(torch.stack([left, right]))
        >>> rig.points(torch.tensor([[[60.0, 40.0]], [[50.0, 40.0]]])).round(decimals=3)
        tensor([[0.2000, 0.0000, 2.0000]])
    """

    def __init__(
        self,
        proj: Tensor,
        *,
        frame: Frame = "rig",
        covariance: bool = False,
        max_residual: float | None = None,
    ) -> None:
        check_shapes(proj=(proj, "+V 3 4"))
        check_settings(frame, max_residual)
        self.proj = proj
        self.frame: Frame = frame
        self.covariance = covariance
        self.max_residual = max_residual
        self._renew()

    def __repr__(self) -> str:
        """The settings and whose cameras they are: no numbers."""
        shape, dtype = tuple(self.proj.shape), str(self.proj.dtype).removeprefix("torch.")
        settings = f"frame={self.frame!r}, covariance={self.covariance}"
        settings = f"{settings}, max_residual={self.max_residual}"
        return f"{type(self).__name__}(proj {shape}, {settings}) {dtype} {self.proj.device}"

    def _renew(self) -> None:
        self._cameras = KnownCameras(at_least_single(self.proj))
        self._version = _version_of(self.proj)

    def _known(self) -> KnownCameras:
        version = _version_of(self.proj)
        if version is None or version != self._version:
            self._renew()
        return self._cameras

    def points(
        self, pixels: Tensor, weights: Tensor | None = None, mask: Tensor | None = None
    ) -> Tensor:
        """Points ``(*B, N, 3)`` alone, as :func:`triangulate_points`."""
        return _of_call(Call.points, self._known(), self.proj, pixels, weights, mask, self.frame)

    def full(
        self, pixels: Tensor, weights: Tensor | None = None, mask: Tensor | None = None
    ) -> Triangulation:
        """Points with status and all that is known about them, as :func:`triangulate`."""
        full = partial(Call.full, covariance=self.covariance)
        found = _of_call(full, self._known(), self.proj, pixels, weights, mask, self.frame)
        return found if self.max_residual is None else found.within_residual(self.max_residual)

    def to(self, *args: Any, **kwargs: Any) -> "PreparedTriangulator":
        """The same for cameras moved as by :meth:`torch.Tensor.to`."""
        return PreparedTriangulator(
            self.proj.to(*args, **kwargs),
            frame=self.frame,
            covariance=self.covariance,
            max_residual=self.max_residual,
        )


@without_autocast
def _of_call(
    compute: Callable[[Call], _Found], known: KnownCameras, _: Tensor, *seen: Any
) -> _Found:
    """What is computed of a call, in the dtype of the cameras as they were given."""
    return compute(Call(known, *seen))


def _version_of(tensor: Tensor) -> int | None:
    """How often it was changed in place; None where torch does not count or a trace looks on."""
    looked_on = torch.compiler.is_compiling() or tracing()
    return None if looked_on or tensor.is_inference() else tensor._version
