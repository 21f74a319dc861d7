"""Scenes as arrays: numbers, poses and file names of their frames; no pixel is decoded.

A scene of 2000 frames takes 0.3 MB instead of the 2 MB that as many `Frame` objects would.
"""

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from deltas_nets.captures.capture import FloatArray, Frame
from deltas_nets.captures.readers.scannet import find_files, read_pose, world_from_cam_inverse
from deltas_nets.errors import UserError

__all__ = ["LeftOut", "Scene", "read_scene"]


@dataclass(frozen=True)
class LeftOut:
    """How many frames are not used, and why; each is counted once."""

    lost: int = 0
    """Their pose is missing, damaged or not finite."""
    not_rigid: int = 0
    """Their pose is no rotation and translation."""
    without_depth: int = 0
    """They have no depth file."""
    listed: int = 0
    """They are in the skip list."""

    def __add__(self, other: "LeftOut") -> "LeftOut":
        names = [field.name for field in fields(self)]
        return LeftOut(**{name: getattr(self, name) + getattr(other, name) for name in names})

    def in_words(self) -> str:
        """For a message.

        Example:
            >>> LeftOut(lost=2, listed=1).in_words()
            '2 without a finite pose, 0 whose pose is not rigid, 0 without depth, 1 listed'
        """
        return (
            f"{self.lost} without a finite pose, {self.not_rigid} whose pose is not rigid, "
            f"{self.without_depth} without depth, {self.listed} listed"
        )


class Scene(NamedTuple):
    """F usable frames of one scene.

    Attributes:
        path: the folder that holds color, depth and pose.
        image_size: (height, width) of the colour images.
        K: ``(3, 3)`` of the colour images.
        depth_K: ``(3, 3)`` of the depth images; None where they see what the images see.
        depth_size: (height, width) of the depth images; None if none decodes.
        ids: ``(F,)`` int64 frame numbers, ascending.
        cam_from_world: ``(F, 4, 4)`` float64, rigid.
        images: ``(F,)`` names of files in color, ASCII.
        depths: ``(F,)`` names of files in depth, ASCII.
        left_out: frames that are not among them.
        doubts: what may be a mistake, each for a warning.
    """

    path: Path
    image_size: tuple[int, int]
    K: FloatArray
    depth_K: FloatArray | None
    depth_size: tuple[int, int] | None
    ids: NDArray[np.int64]
    cam_from_world: FloatArray
    images: NDArray[np.bytes_]
    depths: NDArray[np.bytes_]
    left_out: LeftOut
    doubts: tuple[str, ...]

    def frame(self, position: int) -> Frame:
        """The frame at a position, for reading its pixels."""
        return Frame(
            id=int(self.ids[position]),
            image_path=self.path / "color" / self.images[position].decode(),
            image_size=self.image_size,
            K=self.K,
            cam_from_world=self.cam_from_world[position],
            depth_path=self.path / "depth" / self.depths[position].decode(),
            depth_K=self.depth_K,
            depth_size=self.depth_size,
        )

    def without(self, listed: NDArray[np.bool_]) -> "Scene":
        """The scene less some frames, ``(F,)``, which count as listed."""
        kept = ~listed
        return self._replace(
            ids=self.ids[kept],
            cam_from_world=self.cam_from_world[kept],
            images=self.images[kept],
            depths=self.depths[kept],
            left_out=replace(self.left_out, listed=int(listed.sum()) + self.left_out.listed),
        )


def read_scene(path: Path) -> Scene:
    """Read the poses of a scene.

    Frames without depth or without a finite, rigid pose are left out and counted: in a thousand
    scenes there are always some, and none of them is worth an evening.

    Args:
        path: the folder that holds color, depth, pose and intrinsic.

    Raises:
        UserError: a folder, the images or the intrinsics are missing or malformed.
        OSError: the system refuses to read a file.
    """
    files = find_files(path)
    usable: dict[int, FloatArray] = {}
    lost = not_rigid = without_depth = 0
    for id in files.images:
        world_from_cam = _finite_pose(files.poses.get(id))
        if world_from_cam is None:
            lost += 1
            continue
        try:
            cam_from_world = world_from_cam_inverse(world_from_cam, path=files.poses[id])
        except UserError:
            not_rigid += 1
            continue
        if id not in files.depths:
            without_depth += 1
            continue
        usable[id] = cam_from_world
    ids = np.array(list(usable), dtype=np.int64)
    return Scene(
        path=path,
        image_size=files.image_size,
        K=files.K,
        depth_K=files.depth_K,
        depth_size=files.depth_size,
        ids=ids,
        cam_from_world=np.array(list(usable.values()), dtype=np.float64).reshape(-1, 4, 4),
        images=np.array([files.images[id].name.encode() for id in usable], dtype=np.bytes_),
        depths=np.array([files.depths[id].name.encode() for id in usable], dtype=np.bytes_),
        left_out=LeftOut(lost, not_rigid, without_depth),
        doubts=files.doubts,
    )


def _finite_pose(path: Path | None) -> FloatArray | None:
    if path is None:
        return None
    try:
        world_from_cam = read_pose(path)
    except UserError:  # not 16 numbers
        return None
    return world_from_cam if np.isfinite(world_from_cam).all() else None
