"""Posed images with any leading dims become one batch, and what is predicted of it goes back."""

from typing import Any, NamedTuple

import torch
from torch import Tensor

from deltas_geom import PosedViews
from deltas_geom.checks import ShapeError, check_depth_range, check_kind, check_shapes
from deltas_nets.network.prediction import DepthPrediction


class FlatBatch(NamedTuple):
    """View sets in a row.

    Attributes:
        images: ``(B, V, 3, H, W)``.
        views: ``(B, V)``, their cameras.
        dims: the leading dims ``*B`` that they had.
    """

    images: Tensor
    views: PosedViews
    dims: torch.Size

    @property
    def image_size(self) -> tuple[int, int]:
        """(height, width)."""
        return self.images.shape[-2], self.images.shape[-1]


def flat_batch(images: Tensor, views: PosedViews, depth_range: tuple[float, float]) -> FlatBatch:
    """What every network is given, checked, with one batch dim.

    Args:
        images: ``(*B, V, 3, H, W)``; view 0 is the anchor, V >= 2.
        views: their cameras, ``(*B, V)`` or broadcastable to it.
        depth_range: (near, far) of the search, metres.

    Raises:
        ShapeError: a trailing shape differs, there is no source, or the batch is empty.
        ValueError: the depth range makes no sense.
        TypeError: not a tensor, or not posed views.

    Example:
        >>> views = PosedViews(torch.eye(3).expand(2, 3, 3), torch.eye(4).expand(2, 4, 4))
        >>> flat = flat_batch(torch.rand(4, 5, 2, 3, 48, 64), views, (0.5, 10.0))
        >>> flat.images.shape, flat.views.K.shape, flat.dims
        (torch.Size([20, 2, 3, 48, 64]), torch.Size([20, 2, 3, 3]), torch.Size([4, 5]))
    """
    check_kind("views", views, PosedViews, "PosedViews(K, cam_from_world)")
    views.check_shapes()
    check_shapes(images=(images, "V 3 H W"), K=(views.K, "V 3 3"))
    check_depth_range(depth_range)
    if images.shape[-4] < 2:
        raise ShapeError("images must hold the anchor and at least one source (V >= 2)")
    if 0 in images.shape:
        raise ShapeError(f"images must not be empty, got {tuple(images.shape)}")
    dims = images.shape[:-4]
    cameras = (t.expand(*dims, *t.shape[-3:]).reshape(-1, *t.shape[-3:]) for t in views)
    return FlatBatch(images.reshape(-1, *images.shape[-4:]), PosedViews(*cameras), dims)


def with_batch_dims(prediction: DepthPrediction, batch: torch.Size) -> DepthPrediction:
    """Give every tensor the caller's leading dims, none or many, for its flat batch dim."""

    def restore(value: Any) -> Any:
        if isinstance(value, Tensor):
            # Shared tables, such as the sampled inverse depths, have no batch dim.
            return value.reshape(*batch, *value.shape[1:]) if value.ndim > 1 else value
        if isinstance(value, tuple):
            items = [restore(item) for item in value]
            return type(value)(*items) if hasattr(value, "_fields") else tuple(items)
        return value

    restored: DepthPrediction = restore(prediction)
    return restored
