"""How large voxels should be, and what that takes, by a look at some maps."""

from collections.abc import Sequence
from decimal import ROUND_CEILING, Context
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.centres import camera_centres
from deltas_nets.errors import UserError
from deltas_nets.fuse.blocks import SIDE
from deltas_nets.fuse.depth_view import DepthView
from deltas_nets.fuse.lattice import REACH, distinct_names
from deltas_nets.fuse.sources import DepthSource
from deltas_nets.fuse.volume import BYTES_OF_BLOCK

__all__ = ["Sizes", "check_memory", "check_reach", "look_at"]

LOOKED_AT = 16
"""Maps that tell the sizes of all."""
STD_PER_VOXEL = 3.0
"""A voxel is so much smaller than the deviation of depth: finer ones would show noise."""
VOXELS_AROUND = 4.0
"""Least truncation, in voxels."""
COARSEST = 0.02
"""Of the depth: coarser voxels are not chosen, however unsure the maps are."""
CELL = 0.02
"""Of the depth: side of the cells by which surfaces are measured."""


class Sizes(NamedTuple):
    """What follows from the maps.

    Attributes:
        voxel: side of a voxel.
        truncation: how far behind a surface it is averaged.
        depth: of the maps, the median.
        area: of the surfaces, about.
        extent: from the origin to the farthest point.
        origin: ``(3,)`` float64, in the middle of the cameras.
    """

    voxel: float
    truncation: float
    depth: float
    area: float
    extent: float
    origin: Tensor

    @property
    def bytes(self) -> float:
        """Of the volume, about."""
        block = SIDE * self.voxel
        return self.area / block**2 * (2 * self.truncation / block + 1.5) * BYTES_OF_BLOCK


def middle_of(capture: Capture) -> Tensor:
    """``(3,)`` float64, the mean of the cameras' centres."""
    return torch.from_numpy(camera_centres(capture.frames.cam_from_world).mean(axis=0))


def look_at(source: DepthSource, voxel: float | None) -> Sizes:
    """Sizes for the maps of a source.

    Args:
        source: the maps; every so many are read.
        voxel: if it is given.

    Raises:
        UserError: a map cannot be read, or none has depth.
    """
    origin = middle_of(source.capture)
    ids = source.ids[:: 1 + (len(source.ids) - 1) // LOOKED_AT]
    stds, depths, per_pixel, points = [], [], [], []
    for id in ids:
        view = source.view(id)
        known = view.depth > 0
        if known.any():
            depths.append(float(view.depth[known].median()))
            stds.append(float(view.std[known].median()))
            per_pixel.append(depths[-1] / float(view.K[0, 0]))
            points.append(_some_points(view, origin))
    if not depths:
        what = "no pixel of the maps has depth"
        if not any(source.doubtful.values()):  # what was read had none, sure or not
            raise UserError(what, source.capture.path, "look at them: there is nothing to fuse")
        what = f"{what} that is sure enough ({source.least_confidence:.2g} or more)"
        remedy = "deltas fuse --min-confidence 0 uses all depth, sure or not"
        raise UserError(what, source.capture.path, remedy)
    std, depth = float(np.median(stds)), float(np.median(depths))
    if voxel is None:
        wanted = min(std / STD_PER_VOXEL, COARSEST * depth)
        voxel = float(f"{max(wanted, float(np.median(per_pixel))):.2g}")
    return _measured(voxel, std, depth, points, origin, len(source.ids) / len(ids))


def _some_points(view: DepthView, origin: Tensor) -> Tensor:
    """``(N, 3)`` from the origin, one or more of a view that has depth."""
    every = view.points()
    points = every[::4, ::4]
    if not (points[..., 2] > 0).any():
        points = every  # so little depth that all of it may lie between the rows
    points = points[points[..., 2] > 0].double()
    world_from_cam = view.world_from_cam
    return points @ world_from_cam[:3, :3].T + (world_from_cam[:3, 3] - origin)


def _measured(
    voxel: float, std: float, depth: float, points: Sequence[Tensor], origin: Tensor, more: float
) -> Sizes:
    side = CELL * depth
    places = torch.cat(list(points))
    cells = len(distinct_names((places / side).floor().long()))
    # Frames between those that were looked at see some of the same, and something new.
    area = cells * side**2 * min(more, 2.0)
    truncation = max(VOXELS_AROUND * voxel, std)
    return Sizes(voxel, truncation, depth, area, float(places.abs().max()), origin)


def check_memory(sizes: Sizes, gigabytes: float) -> None:
    """Whether a volume of these sizes is small enough.

    Raises:
        UserError: it is not; the text says with what voxels it would be.
    """
    fits = sizes
    while fits.bytes > gigabytes * 1e9 or fits.extent / fits.voxel > REACH / 2:
        larger = 1.1 * fits.voxel
        fits = fits._replace(voxel=larger, truncation=max(VOXELS_AROUND * larger, fits.truncation))
    if fits is not sizes:
        raise UserError(
            f"voxels of {sizes.voxel:g} need about {_up(sizes.bytes / 1e9)} GB of memory",
            "--voxel",
            f"use {_up(fits.voxel)} or more, or allow more with --memory",
        )


def check_reach(sizes: Sizes) -> None:
    """Whether voxels can be counted from one end of the scene to the other.

    Raises:
        UserError: they cannot; the text says with what voxels they could.
    """
    if sizes.extent / sizes.voxel > REACH / 2:
        what = f"voxels of {sizes.voxel:g} are too fine for a scene of {2 * sizes.extent:.3g}"
        raise UserError(what, "--voxel", f"use {_up(2 * sizes.extent / REACH)} or more")


def _up(value: float) -> str:
    """Two digits of a number that are not less: what is advised is not refused."""
    return f"{float(Context(prec=2, rounding=ROUND_CEILING).create_decimal_from_float(value)):g}"
