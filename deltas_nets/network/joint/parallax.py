"""How well the views' positions tell a depth: what an error of one pixel in the matches does."""

import torch
import torch.nn.functional as F
from torch import Tensor

from deltas_geom import PosedViews, Triangulation
from deltas_geom.numerics.arithmetic import without_gradients

SMALLEST = 1e-4  # rad


@without_gradients
def parallax_of(views: PosedViews, points: Triangulation, used: Tensor) -> Tensor:
    """Largest angle ``(B, N)`` rad between the anchor's ray and that of a used source.

    It is the chord of the angle, which needs no arc sine: onnxruntime has none in the float64 that
    triangulation's own parallax is computed in. 0 where there is no point.

    Args:
        views: ``(B, V)``.
        points: triangulated in them.
        used: ``(B, V-1, N)`` bool, the sources that the point was triangulated from.
    """
    rotation, shift = views.cam_from_world[..., :3, :3], views.cam_from_world[..., :3, 3:]
    centres = -(rotation.mT @ shift).mT  # (B, V, 1, 3)
    rays = F.normalize(points.points.unsqueeze(1) - centres, dim=-1)
    chord = torch.linalg.vector_norm(rays[:, 1:] - rays[:, :1], dim=-1)
    return torch.where(points.valid, torch.where(used, chord, 0.0).amax(dim=1), 0.0)


@without_gradients
def relative_error_per_pixel(views: PosedViews, parallax: Tensor) -> Tensor:
    """Relative error of depth ``(B, N)`` that one pixel gives, within [1e-4, 1].

    Moving a match by a pixel turns its ray by 1 / focal length, and depth follows by that over
    the parallax.

    Args:
        views: ``(B, V)``.
        parallax: ``(B, N)`` rad.

    Source: Hartley and Zisserman, Multiple View Geometry (2nd ed.), section 12.6.
    """
    focal = views.K[:, 1:, 0, 0].mean(dim=1, keepdim=True)
    return (1 / (focal * parallax.clamp_min(SMALLEST))).clamp(1e-4, 1.0)
