"""Plain torch, kornia and OpenCV as targets, with what each of them has.

Differences of convention are settled here, so that a failure is one of the implementation.
"""

from types import ModuleType
from typing import Literal

import torch
import torch.nn.functional as F
from kornia.geometry.epipolar import fundamental_from_projections
from kornia.geometry.epipolar import triangulate_points as kornia_triangulate_points
from kornia.geometry.subpix import spatial_soft_argmax2d
from kornia.geometry.transform import remap
from torch import Tensor

from deltas_geom.cameras.homogeneous import to_homogeneous
from deltas_geom.cameras.pixels import normalize_pixels
from deltas_geom.cameras.views import PosedViews
from deltas_geom.testing.target import ImageSize, Target

KorniaSolver = Literal["eigh", "svd", "cofactor"]
KORNIA_SOLVERS: tuple[KorniaSolver, ...] = ("eigh", "svd", "cofactor")


def plain_torch() -> Target:
    """The textbook in a line or two of torch each, as one writes it without a library.

    It has no guards: what it fails is what a library should add.
    """

    def pixels(K: Tensor, cam_from_world: Tensor, points: Tensor) -> Tensor:
        in_camera = points @ cam_from_world[:, :3, :3].mT + cam_from_world[:, None, :3, 3]
        homogeneous = in_camera @ K.mT
        return homogeneous[..., :2] / homogeneous[..., 2:]

    def points(proj: Tensor, pixels: Tensor, weights: Tensor | None) -> Tensor:
        rows = pixels[..., None] * proj[..., :, None, 2:, :] - proj[..., :, None, :2, :]
        if weights is not None:
            rows = weights[..., None, None] * rows
        rows = rows.transpose(-4, -3).flatten(-3, -2)  # (N, 2V, 4)
        null: Tensor = torch.linalg.svd(rows).Vh[..., -1, :]
        return null[..., :3] / null[..., 3:]

    def rays(K: Tensor, pixels: Tensor) -> Tensor:
        found: Tensor = to_homogeneous(pixels) @ torch.linalg.inv(K).mT
        return found

    def at_depth(K: Tensor, cam_from_world: Tensor, pixels: Tensor, depth: Tensor) -> Tensor:
        in_camera = rays(K, pixels) * depth[..., None]
        return (in_camera - cam_from_world[:, None, :3, 3]) @ cam_from_world[:, :3, :3]

    def residual(proj: Tensor, pixels: Tensor, points: Tensor, weights: Tensor | None) -> Tensor:
        seen = to_homogeneous(points) @ proj.mT
        squared = (seen[..., :2] / seen[..., 2:] - pixels).square().sum(dim=-1)
        heed = torch.ones_like(squared) if weights is None else weights.square()
        found: Tensor = ((heed * squared).sum(dim=0) / heed.sum(dim=0)).sqrt()
        return found

    def read(feature_map: Tensor, pixels: Tensor, image_size: ImageSize) -> Tensor:
        grid = normalize_pixels(pixels, image_size=image_size)[None, None]
        found = F.grid_sample(feature_map[None], grid, padding_mode="border", align_corners=False)
        return found[0, :, 0].mT

    def mean_position(logits: Tensor, positions: Tensor, mask: Tensor) -> Tensor:
        return logits.masked_fill(~mask, -torch.inf).softmax(dim=-1) @ positions

    def nearest(pixels: Tensor, depth: Tensor, image_size: ImageSize) -> Tensor:
        height, width = image_size
        x, y = pixels.round().long().unbind(dim=-1)
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        image = depth.new_full((height * width,), torch.inf)
        image = image.scatter_reduce(0, (y * width + x)[inside], depth[inside], "amin")
        return torch.where(image.isinf(), 0.0, image).reshape(image_size)

    return Target(
        "torch",
        pixels,
        None,
        points,
        batched=True,
        sample_map=read,
        soft_argmax=mean_position,
        rasterize=nearest,
        unproject=at_depth,
        rays=rays,
        residual=residual,
    )


def kornia(solver: KorniaSolver = "eigh") -> Target:
    """kornia: camera, fundamental matrix, two-view triangulation without weights, remap, argmax.

    Example:
        >>> kornia("svd").offers("segments")
        False
    """

    def pixels(K: Tensor, cam_from_world: Tensor, points: Tensor) -> Tensor:
        # Of all sizes: the projection does not look at the image.
        camera = PosedViews(K, cam_from_world).to_kornia(image_size=(1, 1))
        found: Tensor = camera.project(points.expand(K.shape[0], *points.shape))
        return found

    def fundamental(K: Tensor, cam_from_world: Tensor) -> Tensor:
        proj = PosedViews(K, cam_from_world).proj
        found: Tensor = fundamental_from_projections(proj[:1], proj[1:])[0]
        return found

    def points(proj: Tensor, pixels: Tensor, weights: Tensor | None) -> Tensor:
        first, second = pixels[:1], pixels[1:]
        found: Tensor = kornia_triangulate_points(proj[:1], proj[1:], first, second, solver=solver)
        return found[0]

    def read(feature_map: Tensor, pixels: Tensor, image_size: ImageSize) -> Tensor:
        # Its pixel coordinates have -1 and 1 at the outer centres, hence the aligned corners.
        x, y = _map_pixels(pixels, feature_map, image_size).unbind(dim=-1)
        found: Tensor = remap(
            feature_map[None], x[None, None], y[None, None], "bilinear", "border", True
        )
        return found[0, :, 0].mT

    def at_depth(K: Tensor, cam_from_world: Tensor, pixels: Tensor, depth: Tensor) -> Tensor:
        camera = PosedViews(K, cam_from_world).to_kornia(image_size=(1, 1))
        found: Tensor = camera.unproject(pixels, depth[..., None])
        return found

    def heatmap(logits: Tensor) -> Tensor:
        found: Tensor = spatial_soft_argmax2d(logits[None, None], normalized_coordinates=False)
        return found[0, 0]

    return Target(
        f"kornia {solver}",
        pixels,
        fundamental,
        points,
        max_views=2,
        weighted=False,
        sample_map=read,
        heatmap_argmax=heatmap,
        unproject=at_depth,
    )


def opencv() -> Target:
    """OpenCV's ``projectPoints``, ``undistortPoints``, ``triangulatePoints`` and ``remap``.

    Triangulation is of two views, without weights and gradient. Its fundamental matrices are
    estimated from matches: there is none of given cameras.

    Raises:
        ImportError: OpenCV is not installed.
    """
    cv2 = _import_opencv()

    def pixels(K: Tensor, cam_from_world: Tensor, points: Tensor) -> Tensor:
        views = []
        for k, pose in zip(K.numpy(), cam_from_world.numpy(), strict=True):
            turn, _ = cv2.Rodrigues(pose[:3, :3])
            found, _ = cv2.projectPoints(points.numpy(), turn, pose[:3, 3], k, None)
            views.append(torch.from_numpy(found[:, 0]))
        return torch.stack(views)

    def points(proj: Tensor, pixels: Tensor, weights: Tensor | None) -> Tensor:
        first, second = (view.numpy().T for view in pixels)
        homogeneous = cv2.triangulatePoints(proj[0].numpy(), proj[1].numpy(), first, second)
        return torch.from_numpy(cv2.convertPointsFromHomogeneous(homogeneous.T)[:, 0])

    def rays(K: Tensor, pixels: Tensor) -> Tensor:
        views = [
            torch.from_numpy(cv2.undistortPoints(view.copy(), k, None)[:, 0])
            for k, view in zip(K.numpy(), pixels.numpy(), strict=True)
        ]
        return to_homogeneous(torch.stack(views))

    def read(feature_map: Tensor, pixels: Tensor, image_size: ImageSize) -> Tensor:
        # It takes places in float32 alone, whatever the map.
        x, y = _map_pixels(pixels, feature_map, image_size).float().numpy()[None].transpose(2, 0, 1)
        channels = [
            cv2.remap(channel.numpy(), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[0]
            for channel in feature_map
        ]
        return torch.stack([torch.from_numpy(channel) for channel in channels], dim=-1)

    return Target(
        "opencv",
        pixels,
        None,
        points,
        max_views=2,
        weighted=False,
        differentiable=False,
        sample_map=read,
        rays=rays,
    )


def _map_pixels(pixels: Tensor, feature_map: Tensor, image_size: ImageSize) -> Tensor:
    """Pixels ``(N, 2)`` of the image as pixels of a map ``(D, h, w)`` of larger cells."""
    height, width = feature_map.shape[1:]
    share = pixels.new_tensor([width / image_size[1], height / image_size[0]])
    return (pixels + 0.5) * share - 0.5


def _import_opencv() -> ModuleType:
    try:
        import cv2
    except ImportError as error:
        raise ImportError(
            "deltas_geom.testing.targets.opencv needs OpenCV: pip install 'deltas-depth[test]'"
        ) from error
    module: ModuleType = cv2
    return module
