"""A cloud of the points of all maps, thinned to one in a voxel."""

from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from deltas_nets.fuse.depth_view import DepthView
from deltas_nets.fuse.lattice import names_of_cubes, positions_of_cubes, sums_by_name

__all__ = ["Cloud", "CloudPoints", "normals_of"]

CHANNELS = 10  # weight; weighted offset from the voxel's corner, in voxels; normal; colour


class CloudPoints(NamedTuple):
    """Points of a surface.

    Attributes:
        points: ``(N, 3)`` float64 in the world.
        normals: ``(N, 3)`` float32, unit length, towards the cameras.
        colors: ``(N, 3)`` uint8.
    """

    points: NDArray[np.float64]
    normals: NDArray[np.float32]
    colors: NDArray[np.uint8]


class Cloud:
    """Sums over the points in each voxel; views may come in any order.

    Args:
        voxel: side of a voxel, in which one point is left: the mean by 1 / std^2.
        origin: ``(3,)`` float64 world point that voxels count from.
        device: where sums are kept and computed.
    """

    def __init__(
        self, voxel: float, *, origin: Tensor | None = None, device: str | torch.device = "cpu"
    ) -> None:
        self.voxel = voxel
        self.origin = torch.zeros(3, dtype=torch.float64) if origin is None else origin.double()
        self._names = torch.zeros(0, dtype=torch.int64, device=device)
        self._sums = torch.zeros(0, CHANNELS, device=device)
        self._new: list[tuple[Tensor, Tensor]] = []

    def __len__(self) -> int:
        self._merge()
        return len(self._names)

    def add(self, view: DepthView) -> None:
        """Add the points of a view that have a normal; nothing if there is none."""
        view = view.to(self._names.device)
        points = view.points()
        normals, known = normals_of(points)
        world_from_cam = view.world_from_cam.clone()
        world_from_cam[:3, 3] -= self.origin.to(world_from_cam)
        turn = world_from_cam[:3, :3].float()
        places = (
            points[known].double() @ world_from_cam[:3, :3].T + world_from_cam[:3, 3]
        ) / self.voxel
        corners = places.floor()
        weight = view.std[known].square().reciprocal()[:, None]
        values = (
            torch.ones_like(weight),
            (places - corners).float(),
            normals[known] @ turn.T,
            view.colors[known].float(),
        )
        sums = torch.cat(values, dim=-1) * weight
        self._new.append(sums_by_name(names_of_cubes(corners.long()), sums))
        # Merged when there is half as much new as old: each sum is then merged a few times in all.
        if 2 * sum(len(names) for names, _ in self._new) > len(self._names):
            self._merge()

    def points(self) -> CloudPoints:
        """One point of each voxel."""
        self._merge()
        mean = self._sums[:, 1:] / self._sums[:, :1]
        places = (positions_of_cubes(self._names).double() + mean[:, :3].double()) * self.voxel
        normals = F.normalize(mean[:, 3:6], dim=-1)
        colors = mean[:, 6:].round().clamp(0, 255).byte()
        return CloudPoints(
            places.cpu().numpy() + self.origin.numpy(), normals.cpu().numpy(), colors.cpu().numpy()
        )

    def state(self) -> dict[str, Tensor]:
        """The sums, to be written."""
        self._merge()
        return {"names": self._names, "sums": self._sums}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Take over the sums of a cloud of the same voxels."""
        self._names = state["names"].to(self._names)
        self._sums, self._new = state["sums"].to(self._sums), []

    def _merge(self) -> None:
        if self._new:
            names, sums = zip((self._names, self._sums), *self._new, strict=True)
            self._names, self._sums = sums_by_name(torch.cat(names), torch.cat(sums))
            self._new = []


def normals_of(points: Tensor) -> tuple[Tensor, Tensor]:
    """Normals of a depth map's surface.

    Args:
        points: ``(H, W, 3)`` in the camera's axes; zero where there is none.

    Returns:
        Unit normals ``(H, W, 3)`` that look at the camera, and the mask ``(H, W)`` of pixels that
        have one: those with a neighbour in their row and one in their column.
    """
    known = points[..., 2] > 0
    across, has_across = _slope(points, known, dim=1)
    down, has_down = _slope(points, known, dim=0)
    # Points are depths times rays, so this product looks at the camera whatever the depths are.
    normals = torch.linalg.cross(down, across)
    length = torch.linalg.vector_norm(normals, dim=-1)
    valid = known & has_across & has_down & (length > 0)
    return normals / torch.where(valid, length, 1.0)[..., None], valid


def _slope(points: Tensor, known: Tensor, dim: int) -> tuple[Tensor, Tensor]:
    """Difference to the neighbour at whose side depth changes less: across no edge if possible."""
    count = points.shape[dim]
    step = torch.zeros_like(points)
    has = torch.zeros_like(known)
    lower, upper = (slice(None, -1), slice(1, None))
    if count > 1:
        before = _along(points, upper, dim) - _along(points, lower, dim)
        both = _along(known, upper, dim) & _along(known, lower, dim)
        _along(step, upper, dim).copy_(before)
        _along(has, upper, dim).copy_(both)
        there = _along(has, lower, dim)
        # Towards the next one where that is nearer in depth, or the only one.
        better = both & (~there | (before[..., 2].abs() < _along(step, lower, dim)[..., 2].abs()))
        _along(step, lower, dim).copy_(
            torch.where(better[..., None], before, _along(step, lower, dim))
        )
        there |= both
    return step, has


def _along(values: Tensor, part: slice, dim: int) -> Tensor:
    return values[part] if dim == 0 else values[:, part]
