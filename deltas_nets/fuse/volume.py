"""Signed distances to the surfaces that depth maps show, averaged in sparse blocks of voxels.

Source: Curless and Levoy, "A Volumetric Method for Building Complex Models from Range Images",
SIGGRAPH 1996; sparse blocks as in Nießner et al., "Real-time 3D Reconstruction at Scale using Voxel
Hashing", SIGGRAPH Asia 2013.
"""

import math
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor

from deltas_geom.cameras.poses import invert_pose
from deltas_geom.cameras.projection import pixel_rays
from deltas_nets.fuse.blocks import SIDE, SLAB, VOXELS, Blocks
from deltas_nets.fuse.depth_view import DepthView
from deltas_nets.fuse.lattice import distinct_names, positions_of_cubes

__all__ = ["BYTES_OF_BLOCK", "Volume"]

CHANNELS = 5  # weight, weighted distance in truncations, weighted red, green, blue
BYTES_OF_BLOCK = 4 * CHANNELS * VOXELS
BATCH = 63
"""Blocks that are projected at once. What is computed of them stays in the cache, and no operation
is long enough for torch to start threads for it, which spin beside a busy neighbour."""
NEAREST = 1e-6  # of depth; what is nearer to a camera, or behind it, it does not see
FAR = 1e20  # farther than any depth and truncation
AROUND = 1.75
"""Voxels around a seen point whose blocks are there too, so that cubes at the surface are whole."""


class Volume:
    """A truncated signed distance function, in which every depth weighs 1 / std^2.

    Views may come in any order: all that is kept are sums.

    Args:
        voxel: side of a voxel.
        truncation: distance from a surface up to which a view says something behind it; four voxels
            if not given.
        origin: ``(3,)`` float64 world point that voxels count from; near the scene, so that float32
            is fine enough.
        device: where sums are kept and computed.
        threads: of Python, that share the blocks of a view.

    Example:
        >>> flat = torch.full((48, 64), 1.0)
        >>> K = torch.tensor([[60.0, 0, 31.5], [0, 60, 23.5], [0, 0, 1]]).double()
        >>> colors = torch.full((48, 64, 3), 200, dtype=torch.uint8)
        >>> volume = Volume(0.05)
        >>> volume.add(DepthView(flat, 0.01 * flat, colors, K, torch.eye(4).double()))
        >>> len(volume.blocks) > 0
        True
    """

    def __init__(
        self,
        voxel: float,
        truncation: float | None = None,
        *,
        origin: Tensor | None = None,
        device: str | torch.device = "cpu",
        threads: int = 1,
    ) -> None:
        self.voxel, self._threads = voxel, threads
        self.truncation = 4 * voxel if truncation is None else truncation
        self.origin = torch.zeros(3, dtype=torch.float64) if origin is None else origin.double()
        self.blocks = Blocks(CHANNELS, device)
        inside = torch.arange(SIDE)
        # Voxel centres, in voxels from the corner of the block; x is the slowest.
        self._inside = torch.cartesian_prod(inside, inside, inside).double() + 0.5

    def add(self, view: DepthView) -> None:
        """Add what a view sees; nothing if it has no depth."""
        device = self.blocks.device
        view = view.to(device)
        cam_from_local = _shifted(view.cam_from_world.cpu(), self.origin)
        names = self._names_along(view, cam_from_local)
        slots = self.blocks.claim(names)
        slots, order = slots.sort()
        positions = positions_of_cubes(names[order]).cpu().double()
        seen = _Seen(view)
        proj = view.K.cpu() @ cam_from_local[:3]
        offsets = (proj[:, :3] @ (self._inside * self.voxel).T).float().to(device)
        corners = positions * (SIDE * self.voxel)
        corners = (proj[:, :3] @ corners.T + proj[:, 3:]).float().to(device)

        def add(part: slice) -> None:
            slab = self.blocks.slab(int(slots[part.start]) // SLAB)
            seen.add_to(slab, slots[part] % SLAB, corners[:, part], offsets, self.truncation)

        if self._threads == 1:
            for part in _batches(slots):
                add(part)
        else:  # a block is in one batch, so threads do not meet
            with ThreadPoolExecutor(self._threads) as pool:
                list(pool.map(add, _batches(slots)))

    def _names_along(self, view: DepthView, cam_from_local: Tensor) -> Tensor:
        """Blocks around the seen points, and along their rays as far as the truncation."""
        block = SIDE * self.voxel
        points = _spread_points(view, block / 2)
        count = 1 + math.ceil(2 * self.truncation / (block / 2))
        along = torch.linspace(-self.truncation, self.truncation, count).to(points)
        behind = (points + along[:, None, None] * (points / points[:, 2:])).reshape(-1, 3)
        world_from_cam = invert_pose(cam_from_local).to(points)
        turn, shift = world_from_cam[:3, :3], world_from_cam[:3, 3]
        sides = torch.tensor([-AROUND * self.voxel, AROUND * self.voxel]).to(points)
        around = points @ turn.T + torch.cartesian_prod(sides, sides, sides)[:, None]
        places = torch.cat((behind @ turn.T, around.reshape(-1, 3))) + shift
        return distinct_names((places / block).floor().long())

    def state(self) -> dict[str, Tensor]:
        """The sums, to be written."""
        return self.blocks.state()

    def restore(self, state: dict[str, Tensor]) -> None:
        """Take over the sums of a volume of the same voxels."""
        self.blocks.restore(state)


class _Seen:
    """A view as rows of numbers that voxels look up, in a border of pixels without depth."""

    def __init__(self, view: DepthView) -> None:
        weight = torch.where(view.depth > 0, view.std.square().reciprocal(), 0.0)
        colors = view.colors.permute(2, 0, 1).float() * weight
        height, width = view.image_size
        rows = torch.cat((view.depth[None], weight[None], colors))
        padded = F.pad(rows, (1, 1, 1, 1)).reshape(len(rows), -1)
        self.depth, self.weight, *self.colors = padded.contiguous().unbind()
        self.height, self.width = height + 2, width + 2

    def add_to(
        self, slab: Tensor, slots: Tensor, corners: Tensor, offsets: Tensor, truncation: float
    ) -> None:
        """Add what the voxels of blocks see.

        Args:
            slab: ``(C, SLAB, VOXELS)`` sums.
            slots: ``(M,)`` of the blocks, in the slab.
            corners: ``(3, M)`` their corners times the camera's matrix.
            offsets: ``(3, VOXELS)`` the voxels from there.
            truncation: as of the volume.
        """
        z = F.threshold(corners[2, :, None] + offsets[2], NEAREST, FAR)
        per_depth = z.reciprocal()
        # A pixel's centre is 1 in the border, and whole numbers are cut off, not rounded.
        column = (corners[0, :, None] + offsets[0]).mul_(per_depth).add_(1.5)
        row = (corners[1, :, None] + offsets[1]).mul_(per_depth).add_(1.5)
        column = column.clamp_(0, self.width - 1).int()
        pixel = row.clamp_(0, self.height - 1).int().mul_(self.width).add_(column).reshape(-1)
        depth = self.depth.index_select(0, pixel).view_as(z)
        distance = (depth - z).mul_(1 / truncation)
        # Nothing is said in front of the truncation either: a map that sees through a surface
        # would outvote many that see it. Ones and zeros: bools take several times as long.
        seen = distance.abs().lt_(1)
        weight = self.weight.index_select(0, pixel).view_as(z).mul_(seen)  # 0 without depth
        slab[0].index_add_(0, slots, weight)
        slab[1].index_add_(0, slots, distance.mul_(weight))
        for sums, color in zip(slab[2:], self.colors, strict=True):
            sums.index_add_(0, slots, color.index_select(0, pixel).view_as(z).mul_(seen))


def _spread_points(view: DepthView, apart: float) -> Tensor:
    """Camera points ``(N, 3)`` so near to each other that no seen surface is missed.

    Args:
        view: what is seen.
        apart: how far they may be from each other.
    """
    far = float(view.depth.max())
    if far <= 0:
        return torch.zeros(0, 3, device=view.depth.device)
    cell = max(1, min(int(apart * float(view.K[0, 0]) / far), *view.image_size))
    farthest = F.max_pool2d(view.depth[None], cell, ceil_mode=True)[0]
    inverse = torch.where(view.depth > 0, view.depth, torch.inf).reciprocal()
    nearest = F.max_pool2d(inverse[None], cell, ceil_mode=True)[0].reciprocal()
    # Of a cell at the edge of something both surfaces.
    depth = torch.cat((nearest, torch.where(farthest - nearest > apart / 2, farthest, 0.0)))
    found = (depth > 0) & depth.isfinite()
    found = found.view(2, *nearest.shape)
    _, rows, columns = found.nonzero().unbind(dim=-1)
    middle = torch.stack((columns, rows), dim=-1) * cell + (cell - 1) / 2
    return (pixel_rays(view.K, middle.double()) * depth.view_as(found)[found][:, None]).float()


def _shifted(cam_from_world: Tensor, origin: Tensor) -> Tensor:
    """The pose in a world whose origin is at a point of the other."""
    shifted = cam_from_world.clone()
    shifted[:3, 3] += cam_from_world[:3, :3] @ origin
    return shifted


def _batches(slots: Tensor) -> Iterator[slice]:
    """Parts of ascending slots that are in one slab each, and not too many."""
    ends = torch.searchsorted(
        slots, torch.arange(0, int(slots[-1:].sum()) + SLAB + 1, SLAB).to(slots)
    )
    for start, end in pairwise(ends.tolist()):
        for first in range(start, end, BATCH):
            yield slice(first, min(first + BATCH, end))
