"""Which shapes of K and poses go together, and the cure where one K is for all views."""

import torch
from torch import Tensor

from deltas_geom.checks import ShapeError, check_batch


def posed_shapes(K: Tensor, poses: Tensor, name: str) -> torch.Size:
    """``*B`` of K and ``poses``, whose name is ``name``; raise unless they go together."""
    tensors = isinstance(K, Tensor) and isinstance(poses, Tensor)
    if tensors and K.shape[-3:-2] != poses.shape[-3:-2]:
        _refuse_one_for_all(K, poses, name)
    return check_batch(**{"K": (K, "V 3 3"), name: (poses, "V 4 4")})


def _refuse_one_for_all(K: Tensor, poses: Tensor, name: str) -> None:
    """Raise ``ShapeError`` with the cure where K seems to be one for all views."""
    if K.shape[-2:] != (3, 3) or poses.shape[-2:] != (4, 4) or poses.ndim < 3:
        return
    views = poses.shape[-3]
    if K.ndim == 2 or K.shape[-3] == 1:
        cure = f"K.expand{(*K.shape[:-3], views, 3, 3)}"
    elif K.shape[:-2] == poses.shape[:-3]:
        cure = f"K[..., None, :, :].expand{(*K.shape[:-2], views, 3, 3)}"
    else:
        return
    raise ShapeError(
        f"K must have shape (*B, {views}, 3, 3), as {name} has V = {views}, "
        f"got {tuple(K.shape)}: for one K of all views pass {cure}"
    )
