"""Invariants of sparse depth images: the nearest point, the mean, and the bilinear splat."""

import torch
from torch import Tensor

from deltas_geom.cameras.pixels import in_image, pixel_grid
from deltas_geom.testing.agreement import EXTREMES, VALUE_TOLERANCE, assert_finite, assert_near
from deltas_geom.testing.planar import DepthScene
from deltas_geom.testing.registry import invariant
from deltas_geom.testing.target import Target


@invariant("rasterize", scenes="depths")
def the_nearest_point_wins(target: Target, scene: DepthScene) -> None:
    """A pixel has the least depth of the points within half a pixel of its centre, or 0."""
    wanted = [
        scene.depth[here].min() if bool(here.any()) else scene.depth.new_zeros(())
        for here in _owners(scene)
    ]
    (depth,) = _drawn(target, scene)["rasterize"]
    assert_near(depth, torch.stack(wanted).reshape(scene.image_size), VALUE_TOLERANCE, "m")


@invariant("mean_depth", scenes="depths")
def the_mean_is_weighted(target: Target, scene: DepthScene) -> None:
    """A pixel has the weighted mean depth and the summed weight of the points nearest to it."""
    depth, weight = _drawn(target, scene)["mean_depth"]
    total = torch.stack([scene.weights[here].sum() for here in _owners(scene)])
    moment = torch.stack([(scene.weights * scene.depth)[here].sum() for here in _owners(scene)])
    wanted = torch.where(total > 0, moment / total, 0.0)
    assert_near(weight, total.reshape(scene.image_size), VALUE_TOLERANCE, "(weight)")
    assert_near(depth, wanted.reshape(scene.image_size), VALUE_TOLERANCE, "m")


@invariant("splat", scenes="depths")
def a_splat_keeps_weight_depth_and_place(target: Target, scene: DepthScene) -> None:
    """A pixel has the bilinear shares of its points' weights, and the mean depth under these."""
    depth, weight = _drawn(target, scene)["splat"]
    away = pixel_grid(scene.image_size, dtype=depth.dtype)[:, None] - scene.pixels
    shares = (1 - away.abs()).clamp(min=0).prod(dim=-1) * scene.weights
    total, moment = shares.sum(dim=-1), shares @ scene.depth
    assert_near(weight.flatten(), total, VALUE_TOLERANCE, "(weight)")
    assert_near((weight * depth).flatten(), moment, 1e-8, "m (times weight)")


@invariant("drawing", scenes="depths")
def the_order_of_points_does_not_count(
    target: Target, scene: DepthScene, *, order: list[int] | None = None
) -> None:
    """Points may come in any order (here: reversed)."""
    order = order or list(reversed(range(scene.depth.shape[0])))
    pixels, depth, weights, image_size = scene
    permuted = DepthScene(pixels[order], depth[order], weights[order], image_size)
    _assert_same(_drawn(target, permuted), _drawn(target, scene))


@invariant("drawing", scenes="depths")
def a_point_at_a_pixels_centre_goes_there(target: Target, scene: DepthScene) -> None:
    """Points at the centres of all pixels draw their depths, each where it is."""
    grid = pixel_grid(scene.image_size, dtype=scene.depth.dtype)
    depth = torch.arange(1.0, len(grid) + 1).to(grid)
    full = DepthScene(grid, depth, torch.ones_like(depth), scene.image_size)
    for found, *_ in _drawn(target, full).values():
        assert_near(found, depth.reshape(scene.image_size), VALUE_TOLERANCE, "m")


@invariant("drawing", scenes="depths")
def points_outside_leave_no_trace(target: Target, scene: DepthScene) -> None:
    """Points more than a pixel outside the image, or at NaN, draw nothing."""
    height, width = scene.image_size
    # Along one axis at a time: an index y W + x of a point to the right is one of the next row.
    away = 2 * torch.tensor([[width + 1, 0], [0, height + 1]]).to(scene.pixels)
    outside = [scene.pixels + sign * shift for shift in away for sign in (-1, 1)]
    outside.append(scene.pixels * torch.nan)
    more = DepthScene(
        torch.cat([scene.pixels, *outside]),
        torch.cat([scene.depth, (scene.depth / 2).repeat(5)]),
        scene.weights.repeat(6),
        scene.image_size,
    )
    _assert_same(_drawn(target, more), _drawn(target, scene))


@invariant("drawing", scenes="depths")
def depths_that_are_none_leave_no_trace(
    target: Target, scene: DepthScene, *, spoil: float | None = None
) -> None:
    """A depth that is NaN, infinite, 0 or negative draws nothing."""
    for junk in (torch.nan, torch.inf, 0.0, -1.0) if spoil is None else (spoil,):
        more = DepthScene(
            torch.cat([_inner(scene), scene.pixels]),
            torch.cat([torch.full_like(scene.depth, junk), scene.depth]),
            scene.weights.repeat(2),
            scene.image_size,
        )
        _assert_same(_drawn(target, more), _drawn(target, scene), f" with depths of {junk} m")


@invariant("drawing", scenes="depths")
def depth_images_are_finite(
    target: Target, scene: DepthScene, *, pixels: Tensor | None = None
) -> None:
    """Depth and weight are finite at any finite pixel, depth and weight."""
    count = scene.depth.shape[0]
    if pixels is None:
        pixels = EXTREMES[:, :2].to(scene.pixels)
        pixels = pixels.repeat(count, 1)[:count]
    for power in (30, -30):
        factor = 10.0**power
        wild = DepthScene(pixels, factor * scene.depth, factor * scene.weights, scene.image_size)
        for images in _drawn(target, wild).values():
            for image, name in zip(images, ("depth", "weight"), strict=False):
                assert_finite(image, name)


def _drawn(target: Target, scene: DepthScene) -> dict[str, tuple[Tensor, ...]]:
    """What the target draws, by the name of each way that it offers: depth, and maybe weight."""
    pixels, depth, weights, image_size = scene
    found: dict[str, tuple[Tensor, ...]] = {}
    if target.rasterize is not None:
        found["rasterize"] = (target.rasterize(pixels, depth, image_size),)
    if target.mean_depth is not None:
        found["mean_depth"] = target.mean_depth(pixels, depth, weights, image_size)
    if target.splat is not None:
        found["splat"] = target.splat(pixels, depth, weights, image_size)
    return found


def _owners(scene: DepthScene) -> list[Tensor]:
    """For each pixel in raster order, which points ``(N)`` bool fall on it."""
    # A pixel owns its left and upper edge; the far edges of the image belong to no pixel.
    cells = (scene.pixels + 0.5).floor()
    inside = in_image(cells, image_size=scene.image_size)
    grid = pixel_grid(scene.image_size, dtype=cells.dtype)
    return [(cells == cell).all(dim=-1) & inside for cell in grid]


def _inner(scene: DepthScene) -> Tensor:
    """The scene's pixels, moved between the centres of the outer pixels: no share is lost."""
    height, width = scene.image_size
    return scene.pixels.clamp(min=0).minimum(scene.pixels.new_tensor([width - 1, height - 1]))


def _assert_same(
    found: dict[str, tuple[Tensor, ...]], wanted: dict[str, tuple[Tensor, ...]], where: str = ""
) -> None:
    for name, images in wanted.items():
        for one, other in zip(found[name], images, strict=True):
            assert_near(one, other, 1e-8, f"({name}{where})")
