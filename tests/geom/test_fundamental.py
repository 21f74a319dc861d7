"""Fundamental matrices, epipolar lines, distances."""

import cv2
import kornia.geometry.epipolar as kornia_epipolar
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch.testing import assert_close

from deltas_geom import (
    PosedViews,
    ShapeError,
    epipolar_distance,
    epipolar_lines,
    fundamental_between,
)
from deltas_geom.testing import PosedScene, forward_motion, rigid, zero_baseline
from deltas_geom.testing.invariants import INVARIANTS, World
from deltas_geom.testing.scenes import IMAGE_SIZE
from deltas_geom.testing.strategies import extreme, image_pixels, posed_scenes, scales, vectors
from deltas_geom.testing.targets import deltas

OURS = deltas()
EXACT = [
    "a_match_lies_on_its_epipolar_line",
    "the_fundamental_matrix_back_is_the_transpose",
    "the_fundamental_matrix_follows_a_crop_and_a_resize",
]


def test_wrong_shapes_are_named() -> None:
    with pytest.raises(ShapeError, match="fundamental must have shape"):
        epipolar_lines(torch.zeros(3, 4), torch.zeros(5, 2))
    with pytest.raises(ShapeError, match="second has N = 4 but first has N = 5"):
        epipolar_distance(torch.zeros(3, 3), torch.zeros(5, 2), torch.zeros(4, 2))
    with pytest.raises(ShapeError, match=r"must broadcast, got \(3,\), \(2,\)"):
        epipolar_lines(torch.zeros(3, 3, 3), torch.zeros(2, 5, 2))
    with pytest.raises(ShapeError, match=r"must broadcast, got \(\), \(3,\), \(2,\)"):
        epipolar_distance(torch.zeros(3, 3), torch.zeros(3, 5, 2), torch.zeros(2, 5, 2))


@given(scene=posed_scenes())
@pytest.mark.parametrize("name", EXACT)
def test_lines_are_exact(name: str, scene: PosedScene) -> None:
    INVARIANTS[name](OURS, scene, tolerance=1e-8)  # px


@given(scene=posed_scenes(num_views=3))
def test_swapping_the_views_transposes(scene: PosedScene) -> None:
    forth = fundamental_between(scene.views, anchor=0, source=2)
    back = fundamental_between(scene.views, anchor=2, source=0)
    assert_close(forth, back.mT, rtol=0, atol=1e-14)


@given(
    scene=posed_scenes(),
    turn=vectors(1, within=3.0),
    shift=vectors(1, within=100.0),
    scale=scales(decades=2),
)
def test_lines_do_not_know_the_worlds_origin_axes_or_unit(
    scene: PosedScene, turn: Tensor, shift: Tensor, scale: float
) -> None:
    world = World(rigid(turn, shift)[0], scale)
    INVARIANTS["the_fundamental_matrix_does_not_know_the_worlds_frame"](OURS, scene, world=world)
    # Metric, the scale included: F is in metres of baseline.
    moved, fundamental = (
        fundamental_between(views) for views in (world.views(scene.views), scene.views)
    )
    assert_close(moved, scale * fundamental, rtol=1e-8, atol=1e-11 * scale)
    distance = epipolar_distance(moved, scene.pixels[0], scene.pixels[1])
    assert_close(distance, torch.zeros_like(distance), rtol=0, atol=1e-7)  # px


@given(
    scene=posed_scenes(), left=st.integers(-99, 99), top=st.integers(-99, 99), half=st.booleans()
)
def test_distances_are_equivariant_to_resizing_and_cropping(
    scene: PosedScene, left: int, top: int, half: bool
) -> None:
    beside = scene.pixels[1] + torch.tensor([3.0, -2.0])
    distance = epipolar_distance(fundamental_between(scene.views), scene.pixels[0], beside)
    views, scale = scene.views.crop(left=left, top=top), 1.0
    corner = torch.tensor([left, top])
    first, second = scene.pixels[0] - corner, beside - corner
    if half:
        views = views.resize(old_size=IMAGE_SIZE, new_size=(240, 320))
        scale, first, second = 0.5, (first + 0.5) / 2 - 0.5, (second + 0.5) / 2 - 0.5
    changed = epipolar_distance(fundamental_between(views), first, second)
    assert_close(changed, scale * distance, rtol=0, atol=1e-8)  # px


@given(scene=posed_scenes())
def test_float32_is_within_its_bound_of_float64(scene: PosedScene) -> None:
    single = scene.views.to(torch.float32)
    pixels = scene.pixels.float()
    distance = epipolar_distance(fundamental_between(single), pixels[0], pixels[1])
    # Rounding of the pose, times the focal length, over the shortest baseline: 6e-8 500 / 0.09.
    assert_close(distance, torch.zeros_like(distance), rtol=0, atol=64 * 6e-8 * 500 / 0.09)  # px


@given(pixels=extreme(3, 2), fundamental=extreme(3, 3))
def test_no_finite_input_gives_nan_or_inf(pixels: Tensor, fundamental: Tensor) -> None:
    # The lines of a matrix that float32 cannot multiply with its pixels are left out here.
    for dtype, power in ((torch.float32, 0.5), (torch.float64, 1.0)):
        first = (pixels.sign() * pixels.abs() ** power).to(dtype).requires_grad_()
        matrix = (fundamental.sign() * fundamental.abs() ** power).to(dtype).requires_grad_()
        lines = epipolar_lines(matrix, first)
        assert lines[..., :2].isfinite().all()
        for gradient in torch.autograd.grad(lines[..., :2].sum(), (first, matrix)):
            assert gradient.isfinite().all()


@given(scene=posed_scenes())
def test_opencv_draws_the_same_lines(scene: PosedScene) -> None:
    fundamental = fundamental_between(scene.views)
    theirs = cv2.computeCorrespondEpilines(scene.pixels[0].numpy()[:, None], 1, fundamental.numpy())
    ours = epipolar_lines(fundamental, scene.pixels[0])
    assert_close(ours, torch.from_numpy(theirs[:, 0]).to(ours), rtol=1e-6, atol=1e-6)


@given(scene=posed_scenes())
def test_kornia_builds_the_same_matrix_up_to_scale(scene: PosedScene) -> None:
    first, second = scene.views.proj[:, None]
    theirs = kornia_epipolar.fundamental_from_projections(first, second)[0]
    ours = fundamental_between(scene.views)
    cosine = (ours * theirs).sum() / (ours.norm() * theirs.norm())
    assert_close(cosine.abs(), torch.ones_like(cosine), rtol=0, atol=1e-8)


def test_gradients_are_right() -> None:
    scene = forward_motion()
    K = scene.views.K.clone().requires_grad_()
    pose = scene.views.cam_from_world.clone().requires_grad_()

    def distances(K: Tensor, pose: Tensor, pixels: Tensor) -> Tensor:
        return epipolar_distance(fundamental_between(PosedViews(K, pose)), pixels[0], pixels[1] + 1)

    assert torch.autograd.gradcheck(distances, (K, pose, scene.pixels.clone().requires_grad_()))


@given(pixels=image_pixels(4), turn=vectors(1, within=3.0), shift=vectors(1, within=100.0))
@pytest.mark.parametrize("kind", [torch.float32, torch.float64], ids=str)
def test_without_a_baseline_there_are_no_lines_wherever_the_origin_is(
    kind: torch.dtype, pixels: Tensor, turn: Tensor, shift: Tensor
) -> None:
    K, poses = zero_baseline().views
    views = PosedViews(K, poses @ rigid(turn, shift)).to(kind)
    moving = views.cam_from_world.clone().requires_grad_()
    fundamental = fundamental_between(views._replace(cam_from_world=moving))
    assert (fundamental == 0).all()
    assert torch.autograd.grad(fundamental[..., 0, 1].sum(), moving)[0].any()
    fundamental = fundamental.detach().requires_grad_()
    lines = epipolar_lines(fundamental, pixels.to(kind))
    assert (lines == 0).all()
    assert (torch.autograd.grad(lines.sum(), fundamental)[0] == 0).all()


def test_the_epipole_has_no_line_and_its_neighbour_has(dtype: torch.dtype) -> None:
    fundamental = fundamental_between(forward_motion(dtype=dtype).views)
    pixels = torch.tensor([[320.0, 240.0], [321.0, 240.0]], dtype=dtype)
    lines = epipolar_lines(fundamental, pixels)
    assert (lines[0] == 0).all()
    assert_close(lines[1, :2].norm(), torch.ones((), dtype=dtype))


def test_the_scale_of_the_matrix_is_nothing_even_where_its_square_does_not_fit() -> None:
    fundamental = torch.tensor([[0.0, 0, 1e-26], [0, 0, 2e-26], [1e-26, 1e-26, 0]])
    fundamental.requires_grad_()
    lines = epipolar_lines(fundamental, torch.zeros(1, 2))
    assert_close(lines[0, :2], torch.tensor([1.0, 2]) / 5**0.5)
    gradient = torch.autograd.grad(lines[0, 0], fundamental)[0]
    assert gradient.isfinite().all() and (gradient != 0).any()
