"""Confident points of depth maps with their tracks, as a reconstruction has them.

Splatting starts from such points, and programs that read COLMAP models take them for COLMAP's own.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.frame import FloatArray, Frame
from deltas_nets.captures.frames import Frames
from deltas_nets.captures.points import Observations, SparsePoints
from deltas_nets.captures.straight import lens_of
from deltas_nets.errors import UserError
from deltas_nets.fuse.agreement import agreement
from deltas_nets.fuse.depth_view import DepthView, nearest
from deltas_nets.fuse.neighbours import neighbours
from deltas_nets.fuse.sources import DepthSource
from deltas_nets.outputs.depth_formats import DEPTH_FORMATS
from deltas_nets.outputs.summary import recorded_depth_scale

__all__ = ["seeds", "with_maps"]

OTHERS = 4
"""Maps that each map is compared with."""
REMEMBERED = 16
"""Maps that are kept in memory."""
NO_DEPTH: dict[str, Any] = dict.fromkeys(
    ("depth_path", "depth_K", "depth_size", "cam_from_depth", "depth_span")
)
SAME = 0.02
"""Share of the depth by which a map may miss a point that it is said to see."""


def with_maps(capture: Capture, folder: Path) -> Capture:
    """The capture with maps of `deltas depth` in the place of what a sensor measured.

    Args:
        capture: in the unit of the maps.
        folder: of the maps; frames without one have no depth.
    """
    # Whole, as frames join what is relative to the capture's own folder.
    folder, scale = folder.resolve(), recorded_depth_scale(folder)
    frames = []
    for frame in capture.frames.values():
        files = (folder / "depth" / f"{frame.id}.{name}" for name in DEPTH_FORMATS)
        file = next(filter(Path.exists, files), None)
        told = {"depth_path": file, "depth_scale": scale, "depth_unit": 1.0}
        frames.append(replace(frame, **{**NO_DEPTH, **told}))
    return replace(capture, frames=Frames.of(frames, capture.frames.folder))


class _Chosen(NamedTuple):
    """N points of one map: in the world, their colours, and their pixels ``(N, 2)`` there."""

    xyz: Tensor
    rgb: Tensor
    pixels: Tensor


def seeds(
    source: DepthSource, count: int, *, report: Callable[[str], None] = lambda _: None
) -> SparsePoints:
    """About so many points, spread over the frames and their images, the surest of each place.

    Points are taken where another map sees the same surface and fewer see through it. The error
    of a point is how far, on average, the surfaces that others see would move its pixel.

    Args:
        source: maps of a capture.
        count: how many points are wanted.
        report: called with the id of every finished frame.

    Raises:
        UserError: a map cannot be read, or no two maps agree anywhere.
    """
    capture = source.capture
    read = lru_cache(maxsize=REMEMBERED)(source.view)
    position = {id: number for number, id in enumerate(capture.frames)}
    available = np.array([position[id] for id in source.ids], dtype=np.intp)
    quota = math.ceil(count / len(source.ids))
    parts: list[SparsePoints] = []
    for id in source.ids:
        own = position[id]
        near = neighbours(read(id), capture.frames, available[available != own], OTHERS)
        others = [(place, read(capture.frames.at(place).id)) for place in near]
        chosen = _choose(read(id), [view for _, view in others], quota)
        parts.append(_with_tracks(capture, own, read(id), chosen, others))
        report(id)
    found = _together(parts)
    if len(found.xyz) == 0:
        what = "no two maps agree on any point"
        if source.least_confidence > 0:
            what = f"{what} that is sure enough ({source.least_confidence:.2g} or more)"
        raise UserError(what, capture.path, "deltas check tells what is wrong with a capture")
    return found


def _choose(view: DepthView, others: list[DepthView], quota: int) -> _Chosen:
    """The surest pixels that others confirm, one in each cell of a grid."""
    said = agreement(view, others)
    confirmed = (said.agree >= 1) & (said.agree > said.against) & (view.depth > 0)
    doubt = torch.where(confirmed, view.std / view.depth.clamp_min(1e-9), torch.inf)
    height, width = view.image_size
    cell = max(1, int(math.sqrt(height * width / max(1, quota))))
    best, place = torch.nn.functional.max_pool2d(
        -doubt[None, None], cell, ceil_mode=True, return_indices=True
    )
    order = best.flatten().argsort(descending=True, stable=True)
    index = place.flatten()[order][torch.isfinite(best.flatten()[order])][:quota]
    points = view.points().reshape(-1, 3)[index].double()
    world_from_cam = view.world_from_cam
    xyz = points @ world_from_cam[:3, :3].mT + world_from_cam[:3, 3]
    pixels = torch.stack([index % width, index // width], dim=-1).double()
    return _Chosen(xyz, view.colors.reshape(-1, 3)[index], pixels)


def _with_tracks(
    capture: Capture,
    own: int,
    view: DepthView,
    chosen: _Chosen,
    others: list[tuple[int, DepthView]],
) -> SparsePoints:
    """The points of one map, with where they are seen."""
    count = len(chosen.xyz)
    number = np.arange(count)
    seen = [(number, own)]
    moved, witnesses = torch.zeros(count).double(), torch.zeros(count).double()
    per_pixel = capture.frames.at(own).image_size[1] / view.image_size[1]
    for place, other in others:
        pixels, depth = _seen_by(other, chosen.xyz)
        theirs = nearest(other.depth, pixels).double()
        same = (depth > 0) & (theirs > 0) & ((theirs - depth).abs() < SAME * depth)
        rays = torch.cat([pixels, torch.ones(count, 1)], dim=-1).double() @ other.K.inverse().mT
        back = other.world_from_cam
        surface = (rays * theirs[:, None]) @ back[:3, :3].mT + back[:3, 3]
        apart = torch.linalg.vector_norm(_seen_by(view, surface)[0] - chosen.pixels, dim=-1)
        moved += torch.where(same, apart * per_pixel, 0.0)
        witnesses += same
        seen.append((number[same.numpy()], place))
    kept = (witnesses > 0).numpy()
    renumbered = np.cumsum(kept) - 1
    tracks = [(points[kept[points]], place) for points, place in seen]
    pixels_of = [
        _photo_pixels(capture.frames.at(place), chosen.xyz[points].numpy())
        for points, place in tracks
    ]
    return SparsePoints(
        chosen.xyz.numpy()[kept],
        chosen.rgb.numpy()[kept],
        (moved / witnesses.clamp_min(1)).numpy()[kept],
        Observations(
            np.concatenate([renumbered[points] for points, _ in tracks]),
            np.concatenate([np.full(len(points), place) for points, place in tracks]),
            np.concatenate(pixels_of),
        ),
    )


def _seen_by(view: DepthView, xyz: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels ``(N, 2)`` and depth ``(N,)`` of world points; where not in front, depth is 0."""
    found = xyz @ view.cam_from_world[:3, :3].mT + view.cam_from_world[:3, 3]
    ahead = found[:, 2] > 0
    pixels = found @ view.K.mT
    pixels = pixels[:, :2] / torch.where(ahead, pixels[:, 2], 1.0)[:, None]
    return pixels, torch.where(ahead, found[:, 2], 0.0)


def _photo_pixels(frame: Frame, xyz: FloatArray) -> FloatArray:
    """Where the photo, lens and all, shows world points ``(N, 3)`` in front of it."""
    local = xyz @ frame.cam_from_world[:3, :3].T + frame.cam_from_world[:3, 3]
    found: FloatArray = lens_of(frame).project(torch.from_numpy(local)).pixels.numpy()
    return found


def _together(parts: list[SparsePoints]) -> SparsePoints:
    starts = np.cumsum([0, *(len(part.xyz) for part in parts)])
    point = [part.seen.point + start for part, start in zip(parts, starts, strict=False)]
    return SparsePoints(
        np.concatenate([part.xyz for part in parts]),
        np.concatenate([part.rgb for part in parts]),
        np.concatenate([part.error for part in parts]),
        Observations(
            np.concatenate(point),
            np.concatenate([part.seen.frame for part in parts]),
            np.concatenate([part.seen.pixels for part in parts]),
        ),
    )
