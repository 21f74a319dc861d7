"""Frames spread over a capture, each with neighbours, and what was matched between them."""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from deltas_geom import PosedViews
from deltas_geom.cameras.pixels import resize_intrinsics
from deltas_nets.captures.capture import Capture
from deltas_nets.captures.frames import Frames
from deltas_nets.captures.straight import straight
from deltas_nets.check.descriptors import Described, describe
from deltas_nets.check.matching import match
from deltas_nets.check.workers import side_by_side
from deltas_nets.errors import UserError
from deltas_nets.network.deltas import Deltas

__all__ = ["Matched", "cameras_of", "match_capture"]

GROUPS = 6
LEAST = 24  # matches with which two frames go together
MOTION = 0.06  # of the width, wanted between neighbours in a group
_LONGEST_STRIDE = 16
_AHEAD = np.radians(25)  # frames turned by less look at the same


class Matched(NamedTuple):
    """Matches between V frames of a capture.

    Attributes:
        positions: ``(V,)`` of the frames in the capture's, in order.
        pixels: ``(V, N, 2)`` float64, px of the sizes; NaN where a frame does not see the point.
        sizes: (height, width) at which each frame was looked at.
        unread: why images could not be read, by position.
        alone: positions of frames that match nothing, though the frames around them match.
    """

    positions: tuple[int, ...]
    pixels: Tensor
    sizes: tuple[tuple[int, int], ...]
    unread: dict[int, UserError]
    alone: tuple[int, ...] = ()

    @property
    def seen(self) -> Tensor:
        """``(V, N)`` bool."""
        return self.pixels.isfinite().all(dim=-1)

    def views(self, frames: Frames) -> PosedViews:
        """The cameras of the frames, for pixels of the sizes."""
        return cameras_of(frames, self.positions, self.sizes)


def cameras_of(
    frames: Frames, positions: Sequence[int], sizes: Sequence[tuple[int, int]]
) -> PosedViews:
    """Cameras of straightened frames for images of sizes, in float64."""
    intrinsics = []
    for position, size in zip(positions, sizes, strict=True):
        frame = straight(frames.at(position))
        K = torch.from_numpy(frame.K.copy())
        intrinsics.append(resize_intrinsics(K, old_size=frame.image_size, new_size=size))
    poses = frames.cam_from_world[list(positions)]
    return PosedViews(torch.stack(intrinsics), torch.from_numpy(poses.copy()))


def match_capture(
    capture: Capture,
    network: Deltas,
    *,
    threads: int = 1,
    report: Callable[[str], None] = lambda _: None,
) -> Matched:
    """Match frames to their neighbours in time, at about ``GROUPS`` places of a capture.

    How far apart neighbours are is chosen by how much the images move, never by poses: those are
    what is to be judged. Only where neighbours in time do not match, those by pose are tried.

    Args:
        capture: two frames or more.
        network: with descriptors.
        threads: that look at places.
        report: called with the id of every anchor when it is done.
    """
    looked = _Looked(capture.frames, network)
    anchors = _spread(len(capture.frames))
    rows: list[dict[int, Tensor]] = []
    found_in = side_by_side(lambda anchor: _group(capture, looked, anchor), anchors, threads)
    for anchor, found in zip(anchors, found_in, strict=True):
        rows += [found] if found else []
        report(capture.frames.id_at(anchor))
    return _joined(looked, rows)


class _Looked:
    """Frames described when they are first asked for; None where an image cannot be read."""

    def __init__(self, frames: Frames, network: Deltas) -> None:
        self.frames, self.network = frames, network
        self.known: dict[int, Described | None] = {}
        self.unread: dict[int, UserError] = {}

    def __call__(self, position: int) -> Described | None:
        if position not in self.known:
            # Two threads may look at the same; neither must see that the other has only begun.
            try:
                described = describe(self.network, self.frames.at(position))
            except UserError as error:
                self.unread[position], described = error, None
            self.known[position] = described
        return self.known[position]

    def match(self, one: int, other: int) -> bool:
        """Whether two frames match."""
        first, second = self(one), self(other)
        if first is None or second is None:
            return False
        return int(match(first, second)[1].sum()) >= LEAST


def _spread(count: int) -> list[int]:
    """Positions in the middle of ``GROUPS`` equal parts."""
    parts = (np.arange(GROUPS) + 0.5) / GROUPS
    return sorted({int(position) for position in parts * count})


def _group(capture: Capture, looked: _Looked, anchor: int) -> dict[int, Tensor]:
    """Pixels ``(N, 2)`` of the anchor's keypoints in each frame of its group, NaN if not seen."""
    first = looked(anchor)
    if first is None:
        return {}
    found: dict[int, Tensor] = {anchor: first.keypoints.double()}

    def moved(position: int) -> float | None:
        """How far matches moved, as a part of the width; None where the two do not match."""
        other = looked(position) if 0 <= position < len(capture.frames) else None
        if other is None or position in found:
            return None
        there, kept = match(first, other)
        if int(kept.sum()) < LEAST:
            return None
        found[position] = torch.where(kept[:, None], there.double(), torch.nan)
        motion = (there - first.keypoints)[kept].norm(dim=-1).median()
        return float(motion) / first.size[1]

    motion = moved(anchor + 1) or moved(anchor - 1)
    stride = 1 if not motion else int(np.clip(round(MOTION / motion), 1, _LONGEST_STRIDE))
    for offset in (-1, 1, 2, -2):
        moved(anchor + stride * offset)
    if len(found) < 3:
        for position in _near_by_pose(capture.frames, anchor):
            moved(position)
    return found if len(found) > 1 else {}


def _near_by_pose(frames: Frames, anchor: int) -> Iterator[int]:
    """Four frames that look the same way from nearby, as far as poses are right."""
    rotation, shift = frames.cam_from_world[:, :3, :3], frames.cam_from_world[:, :3, 3]
    centres = -np.einsum("fij,fi->fj", rotation, shift)
    distance = np.linalg.norm(centres - centres[anchor], axis=-1)
    usual = float(np.median(distance)) or 1.0
    cost = distance / usual + 1 - rotation[:, 2] @ rotation[anchor, 2]
    yield from (int(position) for position in np.argsort(cost)[1:5])


def _joined(looked: _Looked, groups: Sequence[dict[int, Tensor]]) -> Matched:
    positions = sorted({position for group in groups for position in group})
    view_of = {position: view for view, position in enumerate(positions)}
    blocks = []
    for group in groups:
        block = torch.full((len(positions), len(next(iter(group.values()))), 2), torch.nan)
        block = block.double()
        for position, pixels in group.items():
            block[view_of[position]] = pixels.cpu()
        blocks.append(block[:, block.isfinite().all(dim=-1).sum(dim=0) > 1])
    pixels = torch.cat(blocks, dim=1) if blocks else torch.zeros(0, 0, 2).double()
    sizes = tuple(described.size for p in positions if (described := looked.known[p]) is not None)
    return Matched(tuple(positions), pixels, sizes, looked.unread, _alone(looked, groups))


def _alone(looked: _Looked, groups: Sequence[dict[int, Tensor]]) -> tuple[int, ...]:
    """Frames between two of a group, one before and one after, neither of which they match.

    Of a camera that looked elsewhere meanwhile, or was turned to take a portrait, frames between
    two match neither, and are right.
    """
    rotations = looked.frames.cam_from_world[:, :3, :3]

    def turned(one: int, other: int) -> float:
        return float(np.arccos(np.clip(((rotations[one] * rotations[other]).sum() - 1) / 2, -1, 1)))

    matched = {position for group in groups for position in group}
    described = [position for position, seen in looked.known.items() if seen is not None]
    alone = []
    for position in sorted(set(described) - matched):
        for group in groups:
            before = max((other for other in group if other < position), default=None)
            after = min((other for other in group if other > position), default=None)
            if before is not None and after is not None:
                most = max(turned(before, after), _AHEAD)
                if max(turned(before, position), turned(position, after)) > most:
                    break
                if not any(looked.match(position, other) for other in (before, after)):
                    alone.append(position)
                break
    return tuple(alone)
