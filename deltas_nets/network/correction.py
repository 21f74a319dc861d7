"""How far a depth map is off, inferred everywhere from where depth is known.

The error of log depth is a Gaussian process: a part that the whole map shares (poses of another
scale) and a part that pixels share the more, the nearer they lie to each other in the image and in
depth, so that it does not cross the edge of an object. Depths that contradict the others around
them lose their say.
"""

import math
from typing import NamedTuple, Self

import torch
import torch.nn.functional as F
from torch import Tensor

from deltas_geom import SparseDepth
from deltas_geom.numerics.arithmetic import at_least_single

SHARED, LOCAL = 0.03, 0.1
"""Standard deviations of both parts, in log depth."""
REACH = 0.15
"""Of the local part: distance, as a share of the longer side of the image, ..."""
LIKENESS = 0.15
"""... and difference of log depth at which two pixels still share 0.6 of it."""
ROUGHNESS = 0.03
"""Standard deviation of what no neighbour shares: the map's own noise."""
MOST = 512
"""Places that the process is conditioned on."""
PIXELS = 1 << 12
TOLERANCE, ROUNDS = 3.0, 6
"""Standard deviations by which a depth may differ from what the others predict, and how often that
is asked."""


class Places(NamedTuple):
    """Pixels of a map, M of them.

    Attributes:
        pixels: ``(B, M)`` int64 in the flat image.
        position: ``(B, M, 3)`` column, row and log depth, each in units of its reach.
    """

    pixels: Tensor
    position: Tensor

    @classmethod
    def at(cls, index: Tensor, log_depth: Tensor) -> Self:
        """Those with an index ``(B, M)`` in a map ``(B, 1, H, W)``; its log depth is theirs."""
        width, longer = log_depth.shape[-1], max(log_depth.shape[-2:])
        column, row = (index % width).to(log_depth.dtype), (index // width).to(log_depth.dtype)
        depth = log_depth.flatten(1).gather(-1, index)
        scaled = [column / (REACH * longer), row / (REACH * longer), depth / LIKENESS]
        return cls(index, torch.stack(scaled, dim=-1))


class Correction(NamedTuple):
    """The process, conditioned on what is known.

    Attributes:
        places: where it is known, M of them.
        shares: ``(B, M)`` weights of the places.
        inverse: ``(B, M, M)`` of their covariance with noise.
        doubt: ``(B, M)`` by how much the noise of each was raised; 1 where it agrees.
    """

    places: Places
    shares: Tensor
    inverse: Tensor
    doubt: Tensor

    def __call__(self, places: Places) -> Tensor:
        """``(B, M')`` what is to be added to log depth at other places."""
        return (covariance(places, self.places) @ self.shares[..., None])[..., 0]

    def at(self, index: Tensor, log_depth: Tensor) -> Tensor:
        """``(B, M')`` the same at pixels ``(B, M')`` of a map, not too many of them at a time."""
        parts = [self(Places.at(some, log_depth)) for some in torch.split(index, PIXELS, dim=-1)]
        return torch.cat(parts, dim=-1)

    def variance(self, places: Places) -> Tensor:
        """``(B, M')`` how much stays open there."""
        across = covariance(places, self.places)
        told = ((across @ self.inverse) * across).sum(dim=-1)
        return (SHARED**2 + LOCAL**2 - told).clamp_min(0)


def positive(weight: Tensor, index: Tensor) -> tuple[Tensor, Tensor]:
    """Indices ``(B, M)`` of the positive weights ``(B, N)``, the largest first, and which are.

    M is the largest number of them in an item, 1 at least; the others are filled up.
    """
    most = max(1, int((weight > 0).sum(dim=-1).max()))
    weight, order = weight.sort(dim=-1, descending=True, stable=True)
    return index.gather(-1, order[:, :most]), weight[:, :most] > 0


def covariance(one: Places, other: Places) -> Tensor:
    """``(B, M, M')`` of the errors at two sets of places."""
    squares = torch.cdist(one.position, other.position).square()
    return SHARED**2 + LOCAL**2 * torch.exp(-0.5 * squares)


def correction(
    known: SparseDepth, variance: Tensor, log_depth: Tensor, *, most: int = MOST
) -> Correction:
    """Condition the process on known depths.

    Args:
        known: ``(B, 1, H, W)`` points.
        variance: ``(B, 1, H, W)`` of the log of their depth.
        log_depth: ``(B, 1, H, W)`` of the map.
        most: of more points the surest of each cell stays.

    Source: Rasmussen and Williams, Gaussian Processes for Machine Learning (2006), equations 2.23
    and 5.12; where a depth is off by more than `TOLERANCE` of what the others leave open, its
    noise grows.
    """
    height, width = log_depth.shape[-2:]
    cell = max(1, math.ceil(math.sqrt(height * width / most)))
    weight, index = F.max_pool2d(known.weight, cell, ceil_mode=True, return_indices=True)
    index, used = positive(weight.flatten(1), index.flatten(1))
    places = Places.at(index, at_least_single(log_depth))
    depth = torch.where(used, known.depth.flatten(1).gather(-1, index), 1.0)
    off = torch.where(used, depth.log() - log_depth.flatten(1).gather(-1, index), 0.0)
    own = variance.flatten(1).gather(-1, index) + ROUGHNESS**2
    # A place without a depth shares nothing with the others.
    noise = torch.where(used, own, 1.0)
    among = covariance(places, places) * (used[:, None, :] & used[:, :, None])
    doubt = torch.ones_like(noise)
    for _ in range(ROUNDS):
        inverse = torch.linalg.inv(among + torch.diag_embed(noise * doubt))
        shares = (inverse @ off[..., None])[..., 0]
        precision = inverse.diagonal(dim1=-2, dim2=-1).clamp_min(1e-6)
        open_variance = (1 / precision - noise * (doubt - 1)).clamp_min(ROUGHNESS**2)
        strain = (shares / precision).abs() / (TOLERANCE * open_variance.sqrt())
        doubt = torch.where(used, strain.clamp(1, 30) ** 4, 1.0)
    inverse = torch.linalg.inv(among + torch.diag_embed(noise * doubt))
    return Correction(places, (inverse @ off[..., None])[..., 0], inverse, doubt)
