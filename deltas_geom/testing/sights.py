"""An oracle for segments that does not clip: single depths, one by one, in the camera equations."""

from typing import NamedTuple

import torch
from torch import Tensor

from deltas_geom.cameras.homogeneous import to_homogeneous
from deltas_geom.cameras.pixels import in_image
from deltas_geom.cameras.views import PosedViews
from deltas_geom.status import Status
from deltas_geom.testing.agreement import PIXEL_TOLERANCE, assert_near, is_good, slack
from deltas_geom.testing.target import DepthRange, ImageSize

VISIBLE = (Status.OK, Status.NO_PARALLAX)
"""What a segment's mask calls True."""
PLANE_TOLERANCE = 1e-4  # of the depths whose difference is a point's depth in view 1


class Sights(NamedTuple):
    """Where view 1 sees the rays of view 0's pixels: inverse depth w at ``far + w * toward``.

    Attributes:
        far: ``(N, 3)`` homogeneous pixel of the point at infinity.
        toward: ``(N, 3)`` homogeneous epipole, times metres.
    """

    far: Tensor
    toward: Tensor

    def at(self, inv_depth: Tensor) -> Tensor:
        """Homogeneous pixels ``(N, S, 3)`` at ``(N, S)`` 1/m."""
        return self.far[:, None] + inv_depth[..., None] * self.toward[:, None]

    def seen(self, inv_depth: Tensor, image_size: ImageSize) -> tuple[Tensor, Tensor]:
        """Pixels ``(N, S, 2)`` and whether they are in front and in the image ``(N, S)``."""
        homogeneous = self.at(inv_depth)
        pixels = homogeneous[..., :2] / homogeneous[..., 2:]
        return pixels, (homogeneous[..., 2] > 0) & in_image(pixels, image_size=image_size)

    def on_plane(self, inv_depth: Tensor) -> Tensor:
        """Whether a depth is so close to view 1's plane that its pixel is rounding, ``(N, S)``."""
        size = self.far[:, None, 2].abs() + inv_depth.abs() * self.toward[:, None, 2].abs()
        return self.at(inv_depth)[..., 2].abs() < PLANE_TOLERANCE * size

    def inv_depth(self, pixels: Tensor) -> Tensor:
        """Inverse depth ``(N)`` that is seen nearest to pixels ``(N, 2)``; 0 if all are."""
        constant = self.far[:, :2] - pixels * self.far[:, 2:]
        growth = self.toward[:, :2] - pixels * self.toward[:, 2:]
        squared = growth.square().sum(dim=-1)
        moves = squared > 1e-24 * self.toward.square().sum(dim=-1)
        found = -(constant * growth).sum(dim=-1) / torch.where(moves, squared, 1.0)
        return torch.where(moves, found, 0.0)


def sights(views: PosedViews, pixels: Tensor) -> Sights:
    """The rays of the first view's pixels ``(N, 2)`` in the second, by the camera equations."""
    rotation, translation = views.cam_from_world[..., :3, :3], views.cam_from_world[..., :3, 3:]
    rays = to_homogeneous(pixels) @ torch.linalg.inv(views.K[0]).mT @ rotation[0]  # in the world
    center = -rotation[0].mT @ translation[0]
    far = rays @ (views.K[1] @ rotation[1]).mT
    toward = (views.K[1] @ (rotation[1] @ center + translation[1])).mT
    return Sights(far, toward.expand_as(far))


def assert_covers(
    views: PosedViews,
    pixels: Tensor,
    found: tuple[Tensor, Tensor, Tensor],
    depth_range: DepthRange,
    image_size: ImageSize,
) -> None:
    """Every visible one of 129 depths lies within 1e-6 px of the segment from far to near."""
    start, end, status = found
    near, far = depth_range
    share = torch.linspace(0, 1, 129, dtype=pixels.dtype)
    inv_depth = (1 / far + share * (1 / near - 1 / far)).expand(pixels.shape[0], -1)
    rays = sights(views, pixels)
    places, visible = rays.seen(inv_depth, image_size)
    visible &= ~on_edge(places, image_size) & ~rays.on_plane(inv_depth)
    missed = visible.any(dim=-1) & ~is_good(status, VISIBLE)
    if bool(missed.any()):
        item = int(missed.nonzero()[0])
        depth = 1 / float(inv_depth[item, int(visible[item].nonzero()[0])])
        raise AssertionError(f"item {item} is flagged empty, but {depth:.7g} m is visible")
    distance = torch.where(visible, distance_to_segments(places, start, end), 0.0)
    assert_near(distance, torch.zeros_like(distance), PIXEL_TOLERANCE, "px (from the segment)")


def on_edge(pixels: Tensor, image_size: ImageSize, *, within: float = PIXEL_TOLERANCE) -> Tensor:
    """Whether pixels ``(*B, 2)`` are so close to the edge that rounding decides, ``(*B)``."""
    inner, outer = (
        in_image(pixels, image_size=image_size, border=slack() * border)
        for border in (within, -within)
    )
    return outer & ~inner


def distance_to_segments(points: Tensor, start: Tensor, end: Tensor) -> Tensor:
    """Distance ``(N, S)`` px of points ``(N, S, 2)`` from the segment between ``(N, 2)``."""
    along = (end - start)[:, None]
    foot = ((points - start[:, None]) * along).sum(dim=-1)
    foot = foot / along.square().sum(dim=-1).clamp(min=1e-30)
    distance: Tensor = (points - start[:, None] - foot.clamp(0, 1)[..., None] * along).norm(dim=-1)
    return distance
