"""Lists of parameters as other programs write them."""

import math

import torch
from torch import Tensor

from deltas_geom.cameras.lenses.models import MODELS
from deltas_geom.cameras.pixels import intrinsics
from deltas_geom.checks import ShapeError, batch_shape, check_shapes
from deltas_geom.numerics.arithmetic import promoted

_OPENCV = {
    4: ("OPENCV", 4),
    5: ("FULL_OPENCV", 8),
    8: ("FULL_OPENCV", 8),
    12: ("OPENCV_THIN_PRISM", 12),
    14: ("OPENCV_THIN_PRISM", 12),
}
"""By the number of coefficients, the model and how many it has."""
_PANORAMA = "EQUIRECTANGULAR"


def in_a_row(K: Tensor, dist: Tensor) -> Tensor:
    """``(*B, D)`` of OpenCV's (1, D) and (D, 1), which no D = 1 and no batch of K explains."""
    check_shapes(K=(K, "3 3"), dist=(dist, "D"))
    dist = dist.mT if dist.ndim > 1 and dist.shape[-1] == 1 else dist
    return dist.squeeze(-2) if dist.ndim > K.ndim - 1 else dist


def opencv(K: Tensor, dist: Tensor) -> tuple[Tensor, Tensor, str]:
    """K, coefficients and the model of what OpenCV calls ``distCoeffs``."""
    dist = in_a_row(K, dist)
    count = dist.shape[-1]
    if count not in _OPENCV:
        raise ShapeError(f"dist must have 4, 5, 8, 12 or 14 coefficients, got {tuple(dist.shape)}")
    if count == 14 and bool((dist[..., 12:] != 0).any()):
        raise ValueError("the tilt of the sensor, tx and ty, must be 0: no model here has one")
    model, wanted = _OPENCV[count]
    missing = dist.new_zeros((*dist.shape[:-1], max(0, wanted - count)))
    return K, torch.cat([dist[..., :wanted], missing], dim=-1), model


def from_parameters(model: str, params: Tensor) -> tuple[Tensor, Tensor]:
    """K and coefficients of COLMAP's parameters of a model that exists."""
    check_shapes(params=(params, "P"))
    named = parameter_names(model)
    if params.shape[-1] != len(named):
        raise ShapeError(
            f"params of {model} must be {len(named)} ({' '.join(named)}), got {params.shape[-1]}"
        )
    if model == _PANORAMA:
        width, height = params.unbind(dim=-1)
        fx, fy, cx, cy = width / (2 * math.pi), height / math.pi, width / 2, height / 2
    else:
        focals = MODELS[model].focals
        fx, fy = params[..., 0], params[..., focals - 1]
        cx, cy = params[..., focals], params[..., focals + 1]
        params = params[..., focals + 2 :]
    return intrinsics(fx, fy, cx - 0.5, cy - 0.5), params[..., :0] if model == _PANORAMA else params


def to_parameters(model: str, K: Tensor, coefficients: Tensor) -> Tensor:
    """COLMAP's parameters of a model."""
    K, coefficients = promoted(K, coefficients)
    if model == _PANORAMA:
        return torch.stack([2 * math.pi * K[..., 0, 0], math.pi * K[..., 1, 1]], dim=-1)
    diagonal = K.diagonal(dim1=-2, dim2=-1)[..., : MODELS[model].focals]
    known = torch.cat([diagonal, K[..., :2, 2] + 0.5], dim=-1)
    batch = batch_shape(known.shape[:-1], coefficients.shape[:-1])
    parts = [part.expand(*batch, part.shape[-1]) for part in (known, coefficients)]
    return torch.cat(parts, dim=-1)


def parameter_names(model: str) -> list[str]:
    """The names of COLMAP's parameters of a model that exists."""
    if model == _PANORAMA:
        return ["w", "h"]
    focals = ["f"] if MODELS[model].focals == 1 else ["fx", "fy"]
    return [*focals, "cx", "cy", *MODELS[model].coefficients]
