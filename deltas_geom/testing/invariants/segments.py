"""Invariants of epipolar segments: what is visible of a depth range, and no more.

Between two visible depths all are visible, so a segment is right if both of its ends are visible
depths and every visible depth lies between them.
"""

import torch
from torch import Tensor

from deltas_geom.cameras.homogeneous import to_homogeneous
from deltas_geom.cameras.pixels import in_image, resize_intrinsics, resize_pixels
from deltas_geom.status import Status
from deltas_geom.testing.agreement import (
    EXTREMES,
    PIXEL_TOLERANCE,
    assert_finite,
    assert_near,
    assert_status,
    is_good,
    slack,
)
from deltas_geom.testing.changes import ELSEWHERE, World, cut, transformed
from deltas_geom.testing.registry import first_views, invariant
from deltas_geom.testing.scenes import IMAGE_SIZE, PosedScene
from deltas_geom.testing.sights import (
    VISIBLE,
    assert_covers,
    distance_to_segments,
    on_edge,
    sights,
)
from deltas_geom.testing.target import DepthRange, ImageSize, Target

RANGE: DepthRange = (0.3, 50.0)
END_TOLERANCE = 1e-5  # px: an end is the quotient of small numbers near the source's plane


@invariant("segments", scenes="segments")
def segment_ends_are_visible_depths_of_the_range(
    target: Target,
    scene: PosedScene,
    *,
    depth_range: DepthRange = RANGE,
    image_size: ImageSize = IMAGE_SIZE,
) -> None:
    """Both ends are in the image, and projections of depths of the range in front of the source.

    The far end is the farther one.
    """
    start, end, status = _segments(target, scene, depth_range, image_size)
    visible = is_good(status, VISIBLE)
    rays = sights(scene.views, scene.pixels[0])
    near, far = depth_range
    depths = []
    for pixels in (start, end):
        outside = visible & ~in_image(
            pixels, image_size=image_size, border=-slack() * PIXEL_TOLERANCE
        )
        if bool(outside.any()):
            item = int(outside.nonzero()[0])
            raise AssertionError(f"end {pixels[item].tolist()} px of item {item} is outside")
        inv_depth = rays.inv_depth(pixels).clamp(1 / far, 1 / near)
        seen = rays.at(inv_depth[:, None])[:, 0]
        in_front = torch.where(visible, seen[:, 2], 1.0)
        if not bool((in_front > 0).all()):
            raise AssertionError(f"item {int((in_front <= 0).nonzero()[0])} ends behind the source")
        offset = torch.where(visible[:, None], seen[:, :2] / seen[:, 2:] - pixels, 0.0)
        assert_near(
            offset, torch.zeros_like(offset), END_TOLERANCE, "px (end from a depth of the range)"
        )
        depths.append(inv_depth)
    long = visible & ((end - start).norm(dim=-1) > slack() * END_TOLERANCE)
    swapped = long & (depths[0] > depths[1])
    if bool(swapped.any()):
        raise AssertionError(f"item {int(swapped.nonzero()[0])}: the far end is the near one")


@invariant("segments", scenes="segments")
def every_visible_depth_lies_on_the_segment(
    target: Target,
    scene: PosedScene,
    *,
    depth_range: DepthRange = RANGE,
    image_size: ImageSize = IMAGE_SIZE,
) -> None:
    """What is in front of the source and in its image lies on the segment, within 1e-6 px."""
    found = _segments(target, scene, depth_range, image_size)
    assert_covers(scene.views, scene.pixels[0], found, depth_range, image_size)


@invariant("segments")
def a_segment_out_of_sight_is_flagged(
    target: Target, scene: PosedScene, *, depth_range: DepthRange = RANGE
) -> None:
    """A segment behind the source or beside its image is empty; a keypoint of NaN has none."""
    beside = scene.views.select([0, 1])
    beside = beside._replace(K=torch.stack([beside.K[0], beside.crop(left=1e5, top=0).K[1]]))
    found = _segments(target, scene._replace(views=beside), depth_range, IMAGE_SIZE)[2]
    empty = torch.full_like(found, Status.EMPTY, dtype=torch.int8)
    assert_status(found, empty, VISIBLE)
    # A source turned about in the anchor's place looks away from all that the anchor sees.
    turn = torch.diag(torch.tensor([-1.0, 1, -1, 1], dtype=scene.views.K.dtype))
    anchor = scene.views.cam_from_world[0]
    away = scene.views.select([0, 1])._replace(cam_from_world=torch.stack([anchor, turn @ anchor]))
    found = _segments(target, scene._replace(views=away), depth_range, IMAGE_SIZE)[2]
    assert_status(found, empty, VISIBLE)
    spoiled = torch.cat([torch.full_like(scene.pixels, torch.nan), scene.pixels], dim=1)
    found = _segments(target, scene._replace(pixels=spoiled), depth_range, IMAGE_SIZE)[2]
    alone = _segments(target, scene, depth_range, IMAGE_SIZE)[2]
    lost = torch.full_like(empty, Status.NOT_FINITE_INPUT)
    assert_status(found[: len(lost)], lost, VISIBLE)
    assert bool((found[len(lost) :] == alone).all()), "a keypoint of NaN changes another's status"


@invariant("segments")
def without_a_baseline_a_segment_is_a_point(
    target: Target, scene: PosedScene, *, depth_range: DepthRange = RANGE
) -> None:
    """Where the source only turned, all depths share the pixel of the point at infinity."""
    rotation = scene.views.cam_from_world[:2].clone()
    rotation[:, :3, 3] = 0  # both centres are the origin, exactly
    turned = scene.views.select([0, 1])._replace(cam_from_world=rotation)
    alone = scene._replace(views=turned)
    start, end, status = _segments(target, alone, depth_range, IMAGE_SIZE)
    pixels, visible = sights(turned, scene.pixels[0]).seen(
        torch.zeros_like(start[:, :1]), IMAGE_SIZE
    )
    wanted = torch.where(visible[:, 0], Status.NO_PARALLAX, Status.EMPTY)
    clear = ~on_edge(pixels[:, 0], IMAGE_SIZE)
    assert_status(status[clear], wanted[clear], VISIBLE)
    for found in (start, end):
        offset = torch.where(visible & clear[:, None], found - pixels[:, 0], 0.0)
        assert_near(offset, torch.zeros_like(offset), PIXEL_TOLERANCE, "px")


@invariant("segments")
def a_keypoint_at_the_epipole_stays_there(
    target: Target, scene: PosedScene, *, depth_range: DepthRange = RANGE
) -> None:
    """Where the source moved along the keypoint's ray, all depths share the epipole.

    The range begins before the source, or behind its centre.
    """
    anchor = scene.views.select(0)
    height, width = IMAGE_SIZE
    corner = scene.pixels.new_tensor([width - 1, height - 1])
    pixel = scene.pixels[0, :1].clamp(min=0).minimum(corner)  # seen by both
    ray = to_homogeneous(pixel) @ torch.linalg.inv(anchor.K[0]).mT
    near, far = depth_range
    for depth in (0.5 * near, (near * min(far, 4 * near)) ** 0.5):
        ahead = anchor.cam_from_world[0].clone()
        ahead[:3, 3] -= depth * ray[0]
        moved = scene.views.select([0, 0])._replace(
            cam_from_world=torch.stack([anchor.cam_from_world[0], ahead])
        )
        alone = PosedScene(moved, scene.points[:1], pixel.expand(2, 1, 2))
        start, end, status = _segments(target, alone, depth_range, IMAGE_SIZE)
        assert_status(status, torch.tensor([Status.NO_PARALLAX]), VISIBLE)
        for found in (start, end):
            assert_near(found, pixel, PIXEL_TOLERANCE, "px")


@invariant("segments", scenes="segments")
def segments_do_not_know_the_worlds_frame(
    target: Target,
    scene: PosedScene,
    *,
    world: World = ELSEWHERE,
    depth_range: DepthRange = RANGE,
) -> None:
    """Segments stay when the cameras are moved and turned, and scaled with the depth range."""
    moved = scene._replace(views=world.views(scene.views))
    scaled = (world.scale * depth_range[0], world.scale * depth_range[1])
    found = _segments(target, moved, scaled, IMAGE_SIZE)
    _assert_same(found, _segments(target, scene, depth_range, IMAGE_SIZE))


@invariant("segments", scenes="segments")
def segments_follow_a_resize(
    target: Target,
    scene: PosedScene,
    *,
    new_size: ImageSize = (120, 320),
    depth_range: DepthRange = RANGE,
) -> None:
    """Segments go with the source when it is resized, wherever the anchor is cropped."""
    pair = scene.views.select([0, 1])
    change = cut(pair, new_size=new_size)
    # The crop of a source clips, so the source is resized alone.
    identity = torch.eye(3, dtype=change.dtype)
    change[1] = resize_intrinsics(identity, old_size=IMAGE_SIZE, new_size=new_size)
    changed = PosedScene(
        pair._replace(K=change @ pair.K), scene.points, transformed(change, scene.pixels[:2])
    )
    start, end, status = _segments(target, scene, depth_range, IMAGE_SIZE)
    start, end = (resize_pixels(x, old_size=IMAGE_SIZE, new_size=new_size) for x in (start, end))
    _assert_same(_segments(target, changed, depth_range, new_size), (start, end, status))


@invariant("segments", scenes="segments")
def a_crop_of_the_source_clips_segments(
    target: Target,
    scene: PosedScene,
    *,
    left: int = 160,
    top: int = 120,
    new_size: ImageSize = (240, 320),
    depth_range: DepthRange = RANGE,
) -> None:
    """The segment in a crop of the source is the part of the whole segment that it shows.

    The crop, of ``new_size`` from (left, top), lies in the image.
    """
    pair = scene.views.select([0, 1])
    cropped = pair._replace(K=torch.stack([pair.K[0], pair.crop(left=left, top=top).K[1]]))
    whole = _segments(target, scene, depth_range, IMAGE_SIZE)
    part = _segments(target, scene._replace(views=cropped), depth_range, new_size)
    corner = whole[0].new_tensor([left, top])
    of_whole, of_part = is_good(whole[2], VISIBLE), is_good(part[2], VISIBLE)
    share = torch.linspace(0, 1, 33, dtype=corner.dtype)[:, None]
    places = whole[0][:, None] * (1 - share) + whole[1][:, None] * share - corner
    shown = (
        in_image(places, image_size=new_size, border=slack() * END_TOLERANCE) & of_whole[:, None]
    )
    for inside, outside, points in (
        (shown, part, places),
        (of_part[:, None], whole, torch.stack(part[:2], dim=1) + corner),
    ):
        lost = inside.any(dim=-1) & ~is_good(outside[2], VISIBLE)
        if bool(lost.any()):
            raise AssertionError(f"item {int(lost.nonzero()[0])} is flagged empty in one of both")
        distance = torch.where(inside, distance_to_segments(points, *outside[:2]), 0.0)
        assert_near(distance, torch.zeros_like(distance), END_TOLERANCE, "px (from the segment)")


@invariant("segments", scenes="segments")
def segments_are_finite(target: Target, scene: PosedScene, *, pixels: Tensor | None = None) -> None:
    """Ends are finite for keypoints of any finite size."""
    if pixels is None:
        pixels = EXTREMES[:, :2].to(scene.views.K)
    far = scene._replace(pixels=pixels.expand(2, *pixels.shape))
    start, end, _ = _segments(target, far, RANGE, IMAGE_SIZE)
    assert_finite(start, "far end")
    assert_finite(end, "near end")


def _segments(
    target: Target, scene: PosedScene, depth_range: DepthRange, image_size: ImageSize
) -> tuple[Tensor, Tensor, Tensor]:
    assert target.segments is not None
    pair = first_views(scene, 2)
    return target.segments(
        pair.views.K, pair.views.cam_from_world, pair.pixels[0], depth_range, image_size
    )


def _assert_same(
    found: tuple[Tensor, Tensor, Tensor], wanted: tuple[Tensor, Tensor, Tensor]
) -> None:
    visible = [is_good(status, VISIBLE) for status in (found[2], wanted[2])]
    # Of a single visible depth, on the edge, rounding decides whether it is one.
    length = [
        torch.where(v, (x[1] - x[0]).norm(dim=-1), 0.0)
        for v, x in zip(visible, (found, wanted), strict=True)
    ]
    differ = (visible[0] != visible[1]) & (torch.maximum(*length) > slack() * END_TOLERANCE)
    if bool(differ.any()):
        item = int(differ.nonzero()[0])
        says, before = (bool(mask[item]) for mask in visible)
        raise AssertionError(f"item {item}: visible is {says} instead of {before}")
    both = (visible[0] & visible[1])[:, None]
    for one, other, name in zip(found[:2], wanted[:2], ("far", "near"), strict=True):
        offset = torch.where(both, one - other, 0.0)
        assert_near(offset, torch.zeros_like(offset), END_TOLERANCE, f"px ({name} end)")
