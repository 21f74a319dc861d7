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
    camera_centers,
    epipolar_distance,
    epipolar_segments,
    fundamental_between,
    in_image,
    sample_segments,
)
from deltas_geom.testing import (
    PosedScene,
    default_intrinsics,
    forward_motion,
    on_baseline,
    rigid,
)
from deltas_geom.testing.changes import ELSEWHERE
from deltas_geom.testing.invariants import INVARIANTS, World
from deltas_geom.testing.scenes import IMAGE_SIZE
from deltas_geom.testing.sights import on_edge, sights
from deltas_geom.testing.strategies import (
    depth_ranges,
    epipole_rigs,
    posed_scenes,
    rigs,
    scales,
    vectors,
)
from deltas_geom.testing.target import DepthRange
from deltas_geom.testing.targets import deltas

OURS = deltas()
CLIPPED = [
    "segment_ends_are_visible_depths_of_the_range",
    "every_visible_depth_lies_on_the_segment",
    "segments_follow_a_resize",
]
POSED = [
    "a_segment_out_of_sight_is_flagged",
    "without_a_baseline_a_segment_is_a_point",
    "a_keypoint_at_the_epipole_stays_there",
]


def segments_of(scene: PosedScene, depth_range: DepthRange) -> Segments:
    return epipolar_segments(
        scene.views, scene.pixels[0], depth_range=depth_range, image_size=IMAGE_SIZE
    )


def test_wrong_arguments_are_named() -> None:
    views = forward_motion().views
    with pytest.raises(ShapeError, match="pixels must have shape"):
        epipolar_segments(views, torch.zeros(3), depth_range=(1, 2), image_size=(4, 4))
    with pytest.raises(ValueError, match="near, far"):
        epipolar_segments(views, torch.zeros(1, 2), depth_range=(2, 1), image_size=(4, 4))


@given(scene=rigs(), depth_range=depth_ranges())
@pytest.mark.parametrize("name", CLIPPED)
def test_the_segment_is_what_is_visible(
    name: str, scene: PosedScene, depth_range: DepthRange
) -> None:
    INVARIANTS[name](OURS, scene, depth_range=depth_range)


@given(scene=posed_scenes(), depth_range=depth_ranges())
@pytest.mark.parametrize("name", POSED)
def test_degenerate_rigs_have_their_status(
    name: str, scene: PosedScene, depth_range: DepthRange
) -> None:
    INVARIANTS[name](OURS, scene, depth_range=depth_range)


@given(
    scene=rigs(),
    depth_range=depth_ranges(),
    turn=vectors(1, within=3.0),
    shift=vectors(1, within=10.0),
    scale=scales(),
)
def test_segments_do_not_know_the_worlds_frame(
    scene: PosedScene, depth_range: DepthRange, turn: Tensor, shift: Tensor, scale: float
) -> None:
    INVARIANTS["segments_do_not_know_the_worlds_frame"](
        OURS, scene, depth_range=depth_range, world=World(rigid(turn, shift)[0], scale)
    )


@given(scene=rigs(), left=st.integers(0, 320), top=st.integers(0, 240))
def test_a_crop_of_the_source_clips_segments(scene: PosedScene, left: int, top: int) -> None:
    INVARIANTS["a_crop_of_the_source_clips_segments"](OURS, scene, left=left, top=top)


@given(scene=rigs(), depth_range=depth_ranges())
def test_the_stated_inverse_depths_are_those_of_the_ends(
    scene: PosedScene, depth_range: DepthRange
) -> None:
    segments = segments_of(scene, depth_range)
    for end, inv_depth in (
        (segments.start, segments.inv_depth_start),
        (segments.end, segments.inv_depth_end),
    ):
        place, _ = sights(scene.views, scene.pixels[0]).seen(inv_depth.mT, IMAGE_SIZE)
        offset = torch.where(segments.visible[0, :, None], place[:, 0] - end[0], 0.0)
        assert_close(offset, torch.zeros_like(offset), rtol=0, atol=1e-5)  # px


@given(scene=rigs(), depth_range=depth_ranges())
def test_both_ends_lie_on_the_epipolar_line(scene: PosedScene, depth_range: DepthRange) -> None:
    segments = segments_of(scene, depth_range)
    # A short baseline defines the line badly; the constraint itself is in metres.
    fundamental = fundamental_between(scene.views)
    short = (scene.views.proj[1] - scene.views.proj[0])[:, 3].abs().amax() < 1e-3
    for end in (segments.start[0], segments.end[0]):
        distance = epipolar_distance(fundamental, scene.pixels[0], end)
        distance = torch.where(segments.visible[0], distance, 0.0)
        assert short or (distance.abs() < 1e-4).all()  # px


@given(scene=rigs(), depth_range=depth_ranges())
def test_float32_is_within_its_bound_of_float64(scene: PosedScene, depth_range: DepthRange) -> None:
    views, keypoints = scene.views, scene.pixels[0]
    half = scene._replace(views=views.to(torch.float32), pixels=scene.pixels.float())
    single = segments_of(half, depth_range)
    for end, inv_depth in (
        (single.start[0], single.inv_depth_start[0].double()),
        (single.end[0], single.inv_depth_end[0].double()),
    ):
        assert in_image(end[single.visible[0]], image_size=IMAGE_SIZE, border=-0.01).all()
        # The stated inverse depth belongs to the stated pixel: 64 roundings of 1000 px, more
        # where the source's depth is a small part of the anchor's.
        homogeneous = sights(views, keypoints).at(inv_depth[:, None])[:, 0]
        share = homogeneous[:, 2].abs().clamp(min=1e-3)
        offset = homogeneous[:, :2] / homogeneous[:, 2:] - end.double()
        bound = 64 * 6e-8 * 1000 / share
        ok = ~single.visible[0] | (share <= 1e-3) | (offset.norm(dim=-1) < bound)
        assert ok.all()


@given(scene=epipole_rigs(), depth_range=depth_ranges())
@pytest.mark.parametrize("name", CLIPPED)
def test_at_the_epipole_the_segment_is_what_is_visible(
    name: str, scene: PosedScene, depth_range: DepthRange
) -> None:
    INVARIANTS[name](OURS, scene, depth_range=depth_range)


@given(scene=epipole_rigs(), near=st.floats(0.05, 2.0))
def test_a_keypoint_at_the_epipole_has_the_far_projection_alone(
    scene: PosedScene, near: float
) -> None:
    for dtype in (torch.float32, torch.float64):
        cast = scene._replace(views=scene.views.to(dtype), pixels=scene.pixels.to(dtype))
        exact = cast._replace(
            views=cast.views.to(torch.float64), pixels=cast.pixels.to(torch.float64)
        )
        segments = segments_of(cast, (near, 50.0))
        far = torch.full((1, 1), 1 / 50.0, dtype=torch.float64)
        place, seen = sights(exact.views, exact.pixels[0]).seen(far, IMAGE_SIZE)
        if on_edge(place, IMAGE_SIZE, within=0.1).any():
            continue
        assert segments.status.item() == (Status.NO_PARALLAX if seen.item() else Status.EMPTY)
        assert_close(segments.start, segments.end, rtol=0, atol=0)
        # 32 roundings of terms up to 1000 px.
        atol = 32 * torch.finfo(dtype).eps * 1000
        offset = torch.where(seen, segments.start[0].double() - place[0], 0.0)
        assert_close(offset, torch.zeros_like(offset), rtol=0, atol=atol)  # px


@given(scene=epipole_rigs(16, within=100.0))
def test_near_the_epipole_ends_stay_accurate(scene: PosedScene) -> None:
    single = scene._replace(views=scene.views.to(torch.float32), pixels=scene.pixels.float())
    segments = segments_of(single, (0.05, torch.inf))  # past the source, if that is ahead
    exact = sights(single.views.to(torch.float64), single.pixels[0].double())
    baseline = camera_centers(scene.views.cam_from_world).diff(dim=0).norm()
    offset = scene.views.cam_from_world[:, :3, 3].norm(dim=-1).sum()  # from the world's origin, m
    for end, inv_depth in (
        (segments.start[0], segments.inv_depth_start.double()),
        (segments.end[0], segments.inv_depth_end.double()),
    ):
        place, _ = exact.seen(inv_depth.mT, IMAGE_SIZE)
        error = (place[:, 0] - end.double()).norm(dim=-1)
        # 4 roundings of terms up to 1000 px, by the least depth of eps^1/3.
        size = 1000 * (1 + inv_depth[0] * offset) / (1 + inv_depth[0] * baseline)
        bound = 4 * torch.finfo(torch.float32).eps ** (2 / 3) * size
        assert (error < bound)[segments.status[0] == Status.OK].all()  # px


@pytest.mark.parametrize("moved", [False, True])
def test_the_status_at_the_epipole_does_not_know_the_worlds_frame(
    moved: bool, dtype: torch.dtype
) -> None:
    scene = on_baseline()
    views, unit = (ELSEWHERE.views(scene.views), ELSEWHERE.scale) if moved else (scene.views, 1.0)
    # The source stands 0.5 m ahead: the range runs past its centre.
    found = epipolar_segments(
        views.to(dtype),
        scene.pixels[0].to(dtype),
        depth_range=(0.3 * unit, 50 * unit),
        image_size=IMAGE_SIZE,
    )
    assert found.status.item() == Status.NO_PARALLAX
    epipole = torch.tensor([320.0, 240.0], dtype=dtype)
    for end in (found.start, found.end):
        assert_close(end[0, 0], epipole, rtol=2 * torch.finfo(dtype).eps, atol=0)


def test_a_source_that_looks_back_has_the_near_projection_at_the_epipole() -> None:
    back = torch.diag(torch.tensor([-1.0, 1, -1, 1])).double()
    back[2, 3] = 5.0  # m ahead, face to face
    views = PosedViews(default_intrinsics().repeat(2, 1, 1), torch.stack([torch.eye(4), back]))
    epipole = torch.tensor([[320.0, 240.0]]).double()
    found = epipolar_segments(views, epipole, depth_range=(1, torch.inf), image_size=IMAGE_SIZE)
    assert found.status.item() == Status.NO_PARALLAX
    assert_close(found.start, found.end, rtol=0, atol=0)
    assert_close(found.start[0], epipole, rtol=0, atol=1e-9)  # px
    assert 0.2 < found.inv_depth_start.item() < 0.2001 and found.inv_depth_end.item() == 1


def test_segments_and_samples_export_for_any_number_of_keypoints() -> None:
    class Sampled(torch.nn.Module):
        def forward(self, K: Tensor, pose: Tensor, pixels: Tensor) -> tuple[Tensor, ...]:
            found = epipolar_segments(
                PosedViews(K, pose), pixels, depth_range=(0.3, 50.0), image_size=IMAGE_SIZE
            )
            return *found, *sample_segments(found, 5, offsets=(0, 1), image_size=IMAGE_SIZE)

    scene = forward_motion(dtype=torch.float32)
    keypoints = torch.export.Dim("keypoints", min=2, max=4096)
    inputs = (scene.views.K, scene.views.cam_from_world, scene.pixels[0])
    shapes = {"K": None, "pose": None, "pixels": {0: keypoints}}
    exported = torch.export.export(Sampled(), inputs, dynamic_shapes=shapes)
    more = (*inputs[:2], scene.pixels[0].repeat(5, 1) + torch.arange(15.0)[:, None])
    for found, wanted in zip(exported.module()(*more), Sampled()(*more), strict=True):
        assert_close(found, wanted, rtol=0, atol=0)


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


def test_moving_forward_segments_run_away_from_the_epipole() -> None:
    scene = forward_motion()
    segments = segments_of(scene, (0.6, float("inf")))
    epipole = torch.tensor([320.0, 240.0]).double()
    outward = (segments.end - epipole).norm(dim=-1) > (segments.start - epipole).norm(dim=-1)
    assert outward.all() and (segments.status == Status.OK).all()
    assert_close(segments.start[0], scene.pixels[0], rtol=0, atol=1e-9)  # infinity stays, px


def test_a_range_behind_the_source_is_empty_with_zero_gradient() -> None:
    views = forward_motion().views
    pixels = torch.tensor([[100.0, 100.0]]).double().requires_grad_()
    segments = epipolar_segments(views, pixels, depth_range=(0.1, 0.4), image_size=IMAGE_SIZE)
    assert segments.status.item() == Status.EMPTY and not segments.visible.any()
    total = sum(value.sum() for value in segments[:4])
    assert total.item() == 0
    assert (torch.autograd.grad(total, pixels)[0] == 0).all()


def test_an_anchor_alone_has_no_segments() -> None:
    views = PosedViews(default_intrinsics()[None], torch.eye(4).double()[None])
    segments = epipolar_segments(
        views, torch.zeros(5, 2).double(), depth_range=(1, 2), image_size=IMAGE_SIZE
    )
    assert segments.start.shape == (0, 5, 2)
