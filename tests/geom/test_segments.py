"""Epipolar segments: exactly the visible part of the depth range."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch.testing import assert_close

from deltas_geom import (
    PosedViews,
    Segments,
    ShapeError,
    Status,
    epipolar_distance,
    epipolar_segments,
    fundamental_between,
    in_image,
    project,
    resize_pixels,
    unproject,
)
from deltas_geom.testing import default_intrinsics, forward_motion, pure_rotation, zero_baseline
from deltas_geom.testing.scenes import IMAGE_SIZE
from deltas_geom.testing.strategies import extreme, image_pixels, intrinsics, poses


@st.composite
def rigs(draw: st.DrawFn) -> tuple[PosedViews, Tensor, tuple[float, float]]:
    """Three cameras within a metre, turned by up to a radian; keypoints; a depth range."""
    views = PosedViews(draw(intrinsics(3)), draw(poses(3, turn=0.6, shift=0.5)))
    near = draw(st.floats(0.2, 2.0))
    far = draw(st.one_of(st.just(float("inf")), st.floats(1.5, 20).map(lambda share: near * share)))
    return views, draw(image_pixels(3)), (near, far)


def at_depth(views: PosedViews, pixels: Tensor, inv_depth: Tensor) -> tuple[Tensor, Tensor]:
    """Direct projection of anchor pixels ``(N, 2)`` at ``(V-1, N)`` 1/m: pixels, visible."""
    anchor = views.select(0)
    # A depth of 1e9 m stands in for infinity: it moves a pixel by 1e-6 px at most.
    depth = 1 / inv_depth.clamp(min=1e-9)
    places, visible = [], []
    for source in range(depth.shape[0]):
        points = unproject(anchor, pixels[None], depth[source][None])[0]
        seen = project(views.select(source + 1), points)
        places.append(seen.pixels[0])
        visible.append(seen.in_front[0] & in_image(seen.pixels[0], image_size=IMAGE_SIZE))
    return torch.stack(places), torch.stack(visible)


def segments_of(rig: tuple[PosedViews, Tensor, tuple[float, float]]) -> Segments:
    views, pixels, depth_range = rig
    return epipolar_segments(views, pixels, depth_range=depth_range, image_size=IMAGE_SIZE)


def test_wrong_arguments_are_named() -> None:
    views = forward_motion().views
    with pytest.raises(ShapeError, match="pixels must have shape"):
        epipolar_segments(views, torch.zeros(3), depth_range=(1, 2), image_size=(4, 4))
    with pytest.raises(ValueError, match="near, far"):
        epipolar_segments(views, torch.zeros(1, 2), depth_range=(2, 1), image_size=(4, 4))


def test_batch_dims_broadcast(dtype: torch.dtype) -> None:
    scene = forward_motion(dtype=dtype)
    pixels = scene.pixels[0].expand(4, 1, 3, 2)
    segments = epipolar_segments(scene.views, pixels, depth_range=(0.5, 10), image_size=IMAGE_SIZE)
    assert segments.start.shape == (4, 1, 1, 3, 2) and segments.start.dtype == dtype
    assert segments.status.shape == (4, 1, 1, 3) and segments.status.dtype == torch.int8


def test_no_keypoints_are_no_error() -> None:
    segments = segments_of((forward_motion().views, torch.zeros(0, 2).double(), (1.0, 2.0)))
    assert segments.start.shape == (1, 0, 2)


@given(rig=rigs())
def test_ends_are_the_projections_of_the_clamped_depths(
    rig: tuple[PosedViews, Tensor, tuple[float, float]],
) -> None:
    views, pixels, (near, far) = rig
    segments = segments_of(rig)
    for end, inv_depth in (
        (segments.start, segments.inv_depth_start),
        (segments.end, segments.inv_depth_end),
    ):
        within = (inv_depth >= 1 / far - 1e-12) & (inv_depth <= 1 / near + 1e-12)
        assert (within | ~segments.visible).all()
        place, _ = at_depth(views, pixels, inv_depth)
        # An end far out along the camera's plane is clipped by the image, so px are px.
        offset = torch.where(segments.visible[..., None], place - end, 0.0)
        assert_close(offset, torch.zeros_like(offset), rtol=0, atol=1e-5)  # px
        outside = ~in_image(end, image_size=IMAGE_SIZE, border=-1e-6)
        assert not (outside & segments.visible).any()


@given(rig=rigs())
def test_every_visible_depth_lies_on_the_segment_and_no_other(
    rig: tuple[PosedViews, Tensor, tuple[float, float]],
) -> None:
    views, pixels, (near, far) = rig
    segments = segments_of(rig)
    start, end = segments.inv_depth_start, segments.inv_depth_end
    along = segments.end - segments.start
    for share in torch.linspace(0, 1, 33, dtype=torch.float64):
        inv_depth = (1 / far + share * (1 / near - 1 / far)).expand_as(start)
        place, visible = at_depth(views, pixels, inv_depth)
        inside = segments.visible & (inv_depth >= start) & (inv_depth <= end)
        at_an_end = ((inv_depth - start).abs() < 1e-8) | ((inv_depth - end).abs() < 1e-8)
        # Visible only at one depth, as when a line touches the corner: no sample to compare.
        assert ((inside == visible) | at_an_end | (visible & ~segments.visible & at_an_end)).all()
        # Its distance from the segment, not only from the line.
        offset = place - segments.start
        length = along.square().sum(dim=-1)
        foot = (offset * along).sum(dim=-1) / length.clamp(min=1e-30)
        nearest = segments.start + foot.clamp(0, 1)[..., None] * along
        distance = (place - nearest).norm(dim=-1)
        assert (torch.where(visible & ~at_an_end, distance, 0.0) < 1e-6).all()  # px


@given(rig=rigs())
def test_both_ends_lie_on_the_epipolar_line(
    rig: tuple[PosedViews, Tensor, tuple[float, float]],
) -> None:
    views, pixels, _ = rig
    segments = segments_of(rig)
    for source in (1, 2):
        # A short baseline defines the line badly; the constraint itself is in metres.
        fundamental = fundamental_between(views, source=source)
        for end in (segments.start[source - 1], segments.end[source - 1]):
            distance = epipolar_distance(fundamental, pixels, end)
            short = (views.proj[source] - views.proj[0])[:, 3].abs().amax() < 1e-3
            distance = torch.where(segments.visible[source - 1], distance, 0.0)
            assert short or (distance.abs() < 1e-4).all()  # px


@given(rig=rigs())
def test_segments_are_equivariant_to_resizing(
    rig: tuple[PosedViews, Tensor, tuple[float, float]],
) -> None:
    views, pixels, depth_range = rig
    segments = segments_of(rig)
    small = epipolar_segments(
        views.resize(old_size=IMAGE_SIZE, new_size=(120, 320)),
        resize_pixels(pixels, old_size=IMAGE_SIZE, new_size=(120, 320)),
        depth_range=depth_range,
        image_size=(120, 320),
    )
    both = small.visible & segments.visible
    # A single visible depth may or may not survive rounding.
    lone = (segments.inv_depth_end - segments.inv_depth_start).abs() < 1e-9
    lone = lone & ((small.inv_depth_end - small.inv_depth_start).abs() < 1e-9)
    assert ((small.visible == segments.visible) | lone).all()
    for name in ("start", "end"):
        wanted = resize_pixels(getattr(segments, name), old_size=IMAGE_SIZE, new_size=(120, 320))
        offset = torch.where(both[..., None], getattr(small, name) - wanted, 0.0)
        assert_close(offset, torch.zeros_like(offset), rtol=0, atol=1e-5)  # px


@given(rig=rigs())
def test_float32_is_within_its_bound_of_float64(
    rig: tuple[PosedViews, Tensor, tuple[float, float]],
) -> None:
    views, pixels, depth_range = rig
    single = epipolar_segments(
        views.to(torch.float32), pixels.float(), depth_range=depth_range, image_size=IMAGE_SIZE
    )
    assert in_image(single.start[single.visible], image_size=IMAGE_SIZE, border=-0.01).all()
    assert in_image(single.end[single.visible], image_size=IMAGE_SIZE, border=-0.01).all()
    # Where both see it, the stated inverse depth belongs to the stated pixel: 64 roundings of
    # 1000 px, more where the source's depth is a small part of the anchor's.
    for end, inv_depth in (
        (single.start, single.inv_depth_start),
        (single.end, single.inv_depth_end),
    ):
        place, _ = at_depth(views, pixels, inv_depth.double())
        anchors = views.select([0, 0])
        points = unproject(anchors, pixels.expand(2, 3, 2), 1 / inv_depth.double().clamp(1e-9))
        depth = torch.stack([project(views, points[i]).depth[i + 1] for i in range(2)])
        share = (depth * inv_depth.double()).abs().amin()
        bound = 64 * 6e-8 * 1000 / share.clamp(min=1e-3)
        offset = torch.where(single.visible, (place - end.double()).norm(dim=-1), 0.0)
        assert (share < 1e-3) or (offset < bound).all()


@given(pixels=extreme(4, 2))
def test_no_finite_keypoint_gives_nan_or_inf(pixels: Tensor) -> None:
    for dtype in (torch.float32, torch.float64):
        views = forward_motion(dtype=dtype).views
        K = views.K.clone().requires_grad_()
        keypoints = pixels.to(dtype).requires_grad_()
        segments = epipolar_segments(
            PosedViews(K, views.cam_from_world),
            keypoints,
            depth_range=(0.5, 10),
            image_size=IMAGE_SIZE,
        )
        total = segments.start.sum() + segments.end.sum()
        assert all(value.isfinite().all() for value in segments)
        for gradient in torch.autograd.grad(total, (keypoints, K)):
            assert gradient.isfinite().all()


def test_gradients_are_right() -> None:
    scene = forward_motion()
    K = scene.views.K.clone().requires_grad_()
    pose = scene.views.cam_from_world.clone().requires_grad_()

    def ends(K: Tensor, pose: Tensor, pixels: Tensor) -> tuple[Tensor, ...]:
        found = epipolar_segments(
            PosedViews(K, pose), pixels, depth_range=(0.7, 10), image_size=IMAGE_SIZE
        )
        return found.start, found.end, found.inv_depth_start, found.inv_depth_end

    assert torch.autograd.gradcheck(ends, (K, pose, scene.pixels[0].clone().requires_grad_()))


@pytest.mark.parametrize("scene", [zero_baseline(), pure_rotation()])
def test_without_a_baseline_a_segment_is_a_point(scene) -> None:  # type: ignore[no-untyped-def]
    segments = segments_of((scene.views, scene.pixels[0], (0.5, 10.0)))
    assert (segments.status == Status.NO_PARALLAX).all() and segments.visible.all()
    assert_close(segments.start[0], scene.pixels[1], rtol=0, atol=1e-9)  # px


def test_moving_forward_segments_run_away_from_the_epipole() -> None:
    scene = forward_motion()
    segments = segments_of((scene.views, scene.pixels[0], (0.6, float("inf"))))
    epipole = torch.tensor([320.0, 240.0]).double()
    outward = (segments.end - epipole).norm(dim=-1) > (segments.start - epipole).norm(dim=-1)
    assert outward.all() and (segments.status == Status.OK).all()
    assert_close(segments.start[0], scene.pixels[0], rtol=0, atol=1e-9)  # infinity stays, px


def test_a_keypoint_at_the_epipole_stays_there() -> None:
    segments = segments_of(
        (forward_motion().views, torch.tensor([[320.0, 240.0]]).double(), (1, 9))
    )
    assert segments.status.item() == Status.NO_PARALLAX


def test_a_range_behind_the_source_is_empty_with_zero_gradient() -> None:
    views = forward_motion().views
    pixels = torch.tensor([[100.0, 100.0]]).double().requires_grad_()
    segments = epipolar_segments(views, pixels, depth_range=(0.1, 0.4), image_size=IMAGE_SIZE)
    assert segments.status.item() == Status.EMPTY and not segments.visible.any()
    total = sum(value.sum() for value in segments[:4])
    assert total.item() == 0  # type: ignore[union-attr]
    assert (torch.autograd.grad(total, pixels)[0] == 0).all()


def test_a_keypoint_that_is_nan_spoils_no_gradient() -> None:
    views = forward_motion().views
    K = views.K.clone().requires_grad_()
    pixels = torch.tensor([[torch.nan, 100.0], [100.0, 100.0]]).double().requires_grad_()
    segments = epipolar_segments(
        PosedViews(K, views.cam_from_world), pixels, depth_range=(1, 4), image_size=IMAGE_SIZE
    )
    assert segments.status[0].tolist() == [Status.NOT_FINITE_INPUT, Status.OK]
    assert segments.visible[0].tolist() == [False, True]
    assert (segments.start[0, 0] == 0).all() and segments.inv_depth_end[0, 0] == 0
    for gradient in torch.autograd.grad(segments.start.sum() + segments.end.sum(), (pixels, K)):
        assert gradient.isfinite().all()


def test_an_anchor_alone_has_no_segments() -> None:
    views = PosedViews(default_intrinsics()[None], torch.eye(4).double()[None])
    segments = segments_of((views, torch.zeros(5, 2).double(), (1.0, 2.0)))
    assert segments.start.shape == (0, 5, 2)
