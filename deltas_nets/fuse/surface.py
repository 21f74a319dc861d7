"""Where the signed distance of a volume is zero: marching cubes, some blocks at a time.

Source: Lewiner et al., "Efficient Implementation of Marching Cubes' Cases with Topological
Guarantees", 2003, as scikit-image has it: what it does at a face of a cube depends on the face
alone, so cubes on both sides of a border agree.
"""

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from deltas_nets.fuse.blocks import SIDE
from deltas_nets.fuse.lattice import distinct_names, names_of_cubes, positions_of_cubes
from deltas_nets.fuse.mesh import Mesh, joined
from deltas_nets.fuse.volume import Volume

__all__ = ["surface"]

GROUP = 8
"""Blocks along the side of what is meshed at once; a layer of their neighbours goes with them."""
WIDE = GROUP * SIDE
"""Cubes along that side."""
OFF_ZERO = 1e-3
"""Distances, in truncations, are kept this far from zero: no vertex falls into a corner of a cube,
where rounding would decide whose it is."""


def surface(volume: Volume) -> Mesh:
    """The surface that the views of a volume show, coloured, without seams.

    Only cubes whose eight corners were seen have a part of it.
    """
    positions = positions_of_cubes(volume.blocks.names)
    groups = positions_of_cubes(distinct_names(positions.div(GROUP, rounding_mode="floor")))
    lowest = groups.amin(dim=0) if len(groups) else groups
    meshes, seams = [], []
    for group in groups:
        field = _field(volume, group)
        found = _marched(field)
        if found is None:
            continue
        local, faces = found
        start = ((group - lowest) * WIDE).cpu().numpy()
        corner = volume.origin.numpy() + (group.cpu().numpy() * WIDE + 0.5) * volume.voxel
        vertices = corner + local.astype(np.float64) * volume.voxel
        meshes.append(Mesh(vertices, _colors(volume, field, local), faces))
        seams.append(_seams(local, start))
    return joined(meshes, seams)


class _Field(NamedTuple):
    """What is known in a group of blocks and the layer behind them.

    Attributes:
        slots: ``(GROUP + 1,) * 3`` of the blocks, -1 where there is none.
        distance: ``(WIDE + 1,) * 3`` in truncations.
        seen: whether it is known.
    """

    slots: Tensor
    distance: Tensor
    seen: Tensor


def _field(volume: Volume, group: Tensor) -> _Field:
    side = torch.arange(GROUP + 1, device=group.device)
    inside = torch.cartesian_prod(side, side, side)
    slots = volume.blocks.find(names_of_cubes(group * GROUP + inside))
    there = slots >= 0
    weight, distance = volume.blocks.read(slots[there], slice(2))
    seen = weight > 0
    distance = distance / torch.where(seen, weight, 1.0)
    x, y, z = inside[there].unbind(dim=-1)

    def dense(values: Tensor) -> Tensor:
        shape = (GROUP + 1, SIDE) * 3
        image = torch.zeros(shape, dtype=values.dtype, device=values.device)
        image[x, :, y, :, z, :] = values.view(-1, SIDE, SIDE, SIDE)
        image = image.reshape((SIDE * (GROUP + 1),) * 3)
        return image[: WIDE + 1, : WIDE + 1, : WIDE + 1]

    return _Field(slots, dense(distance), dense(seen))


def _marched(field: _Field) -> tuple[NDArray[np.float32], NDArray[np.int32]] | None:
    """Vertices ``(N, 3)`` in voxels from the group's first one, and faces; None without any."""
    from skimage.measure import marching_cubes

    positive = field.distance > 0
    # Of each cube, at its first corner.
    crossed = ~_of_all_corners(positive) & ~_of_all_corners(~positive)
    crossed &= _of_all_corners(field.seen)
    if not crossed.any():
        return None
    places = crossed.nonzero()
    low, high = places.amin(dim=0), places.amax(dim=0) + 1
    box = tuple(slice(a, b + 1) for a, b in zip(low.tolist(), high.tolist(), strict=True))
    distance = torch.where(positive, 1.0, -1.0) * field.distance.abs().clamp_min(OFF_ZERO)
    distance = distance[box]
    mask = torch.zeros_like(distance, dtype=torch.bool)
    inner = tuple(slice(a, b) for a, b in zip(low.tolist(), high.tolist(), strict=True))
    mask[1:, 1:, 1:] = crossed[inner]  # scikit-image looks at the last corner
    vertices, faces, _, _ = marching_cubes(
        distance.cpu().numpy(), 0.0, mask=mask.cpu().numpy(), gradient_direction="descent"
    )
    return vertices + low.cpu().numpy().astype(np.float32), faces


def _of_all_corners(values: Tensor) -> Tensor:
    """Whether all eight corners of each cube have it."""
    along = values[1:] & values[:-1]
    along = along[:, 1:] & along[:, :-1]
    return along[:, :, 1:] & along[:, :, :-1]


def _colors(volume: Volume, field: _Field, local: NDArray[np.float32]) -> NDArray[np.uint8]:
    """``(N, 3)`` of vertices, between those of the voxels at both ends of their edges."""
    places = torch.from_numpy(local).to(field.slots.device)
    lower = places.floor()
    part = (places - lower).sum(dim=-1).clamp(0, 1)
    ends = []
    for voxel in (lower.long(), places.ceil().long()):
        x, y, z = (voxel // SIDE).unbind(dim=-1)
        slots = field.slots.view((GROUP + 1,) * 3)[x, y, z]
        x, y, z = (voxel % SIDE).unbind(dim=-1)
        sums = volume.blocks.read_voxels(slots, (x * SIDE + y) * SIDE + z)
        ends.append(sums[2:] / sums[0])
    colors = torch.lerp(ends[0], ends[1], part)
    bytes: NDArray[np.uint8] = colors.round().clamp(0, 255).byte().T.cpu().numpy()
    return bytes


def _seams(local: NDArray[np.float32], start: NDArray[np.int64]) -> NDArray[np.int64]:
    """Names ``(N, 3)`` of the edges that vertices are on, in half voxels; -1 inside of the group.

    An edge has one vertex at most, and its middle is half a voxel from its ends.
    """
    border = ((local == 0) | (local == WIDE)).any(axis=-1)
    lower = np.floor(local).astype(np.int64)
    names = 2 * (start + lower) + (local > lower)
    return np.where(border[:, None], names, -1)
