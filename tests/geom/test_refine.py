"""Gauss-Newton refinement of points, by its invariants."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from refinement_cases import LOSSES, SCALE, near_misses, robust_cost, scene_at
from torch import Tensor
from torch.testing import assert_close

from deltas_geom import PosedViews, ShapeError, refine_points, reprojection_residual
from deltas_geom.testing import DEGENERATE_SCENES, PosedScene, forward_motion, rigid, ring
from deltas_geom.testing.strategies import extreme, posed_scenes, scales, vectors
from deltas_geom.triangulation.refine import Loss


def test_wrong_arguments_are_named() -> None:
    proj, pixels, points = torch.zeros(2, 3, 4), torch.zeros(2, 5, 2), torch.zeros(5, 3)
    with pytest.raises(ShapeError, match="points has N = 4 but pixels has N = 5"):
        refine_points(proj, pixels, points[:4])
    with pytest.raises(ShapeError, match="weights has N = 4 but pixels has N = 5"):
        refine_points(proj, pixels, points, torch.ones(2, 4))
    with pytest.raises(ShapeError, match="mask has V = 1 but pixels has V = 2"):
        refine_points(proj, pixels, points, mask=torch.ones(1, 5, dtype=torch.bool))
    with pytest.raises(ValueError, match="or 'cauchy', got 'l1'"):
        refine_points(proj, pixels, points, loss="l1")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="or 'implicit', got 'none'"):
        refine_points(proj, pixels, points, gradient="none")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="steps must not be negative, got -1"):
        refine_points(proj, pixels, points, steps=-1)
    with pytest.raises(ValueError, match="scale must be positive, got 0"):
        refine_points(proj, pixels, points, scale=0)


def test_batch_dims_broadcast(dtype: torch.dtype) -> None:
    scene = forward_motion(dtype=dtype)
    pixels = scene.pixels.expand(4, 1, 2, 3, 2)
    weights = torch.ones(5, 2, 3, dtype=dtype)
    refined = refine_points(scene.views.proj, pixels, scene.points, weights)
    assert refined.points.shape == (4, 5, 3, 3) and refined.points.dtype == dtype
    assert refined.residual.shape == refined.valid.shape == (4, 5, 3)
    none = refine_points(scene.views.proj, scene.pixels[:, :0], scene.points[:0])
    assert none.points.shape == (0, 3) and none.residual.shape == none.valid.shape == (0,)


def test_many_points_are_refined_as_few_are() -> None:
    scene = forward_motion()
    pixels, points = scene.pixels.repeat(1, 5000, 1) + 0.3, scene.points.repeat(5000, 1)
    whole = refine_points(scene.views.proj, pixels, points)
    part = refine_points(scene.views.proj, pixels[:, 8190:8200], points[8190:8200])
    assert_close(whole.points[8190:8200], part.points, rtol=0, atol=1e-12)
    assert_close(whole.residual[8190:8200], part.residual, rtol=0, atol=1e-12)


@given(drawn=near_misses(), steps=st.integers(0, 4), loss=st.sampled_from(LOSSES))
def test_the_cost_never_grows(
    drawn: tuple[PosedScene, Tensor, Tensor], steps: int, loss: Loss
) -> None:
    scene, weights, start = drawn
    proj, pixels = scene.views.proj, scene.pixels
    refined = refine_points(proj, pixels, start, weights, steps=steps, loss=loss, scale=SCALE)
    assert refined.valid.all()
    before = robust_cost(proj, start, pixels, weights, loss)
    after = robust_cost(proj, refined.points, pixels, weights, loss)
    assert (after <= before + 1e-10).all()  # px^2, rounding at 600 px
    stated = reprojection_residual(proj, refined.points, pixels, weights)
    assert_close(refined.residual, stated, rtol=0, atol=1e-9)  # px
    if loss == "squared":
        at_start = reprojection_residual(proj, start, pixels, weights)
        assert (refined.residual <= at_start + 1e-9).all()  # px, rounding


@given(scene=posed_scenes(num_views=3), loss=st.sampled_from(LOSSES))
def test_a_point_without_noise_stays(scene: PosedScene, loss: Loss) -> None:
    refined = refine_points(
        scene.views.proj, scene.pixels, scene.points, steps=3, loss=loss, scale=SCALE
    )
    assert refined.valid.all()
    assert_close(refined.points, scene.points, rtol=0, atol=1e-11)  # m
    assert (refined.residual < 1e-9).all()  # px


@given(scene=posed_scenes(num_views=2), offset=vectors(4, within=0.1))
def test_without_noise_the_true_point_is_found(scene: PosedScene, offset: Tensor) -> None:
    refined = refine_points(scene.views.proj, scene.pixels, scene.points + offset, steps=8)
    assert_close(refined.points, scene.points, rtol=0, atol=1e-9)  # m


@given(drawn=near_misses(), order=st.permutations([0, 1, 2]), loss=st.sampled_from(LOSSES))
def test_the_order_of_views_does_not_count(
    drawn: tuple[PosedScene, Tensor, Tensor], order: list[int], loss: Loss
) -> None:
    scene, weights, start = drawn
    proj, pixels = scene.views.proj, scene.pixels
    one = refine_points(proj, pixels, start, weights, loss=loss, scale=SCALE)
    other = refine_points(proj[order], pixels[order], start, weights[order], loss=loss, scale=SCALE)
    assert_close(other.points, one.points, rtol=0, atol=1e-10)  # m
    assert_close(other.residual, one.residual, rtol=0, atol=1e-9)  # px


@given(
    drawn=near_misses(),
    view=st.integers(0, 2),
    by_mask=st.booleans(),
    spoil=st.booleans(),
    loss=st.sampled_from(LOSSES),
)
def test_a_view_that_is_masked_or_of_weight_0_is_a_view_removed(
    drawn: tuple[PosedScene, Tensor, Tensor], view: int, by_mask: bool, spoil: bool, loss: Loss
) -> None:
    scene, weights, start = drawn
    rest = [other for other in range(3) if other != view]
    proj, pixels, mask = scene.views.proj.clone(), scene.pixels.clone(), None
    wanted = refine_points(proj[rest], pixels[rest], start, weights[rest], loss=loss, scale=SCALE)
    pixels[view] = torch.nan
    if spoil:
        proj[view] = torch.nan
    if by_mask:
        mask = (torch.arange(3) != view)[:, None].expand(3, 4)
    else:
        weights = weights * (torch.arange(3) != view)[:, None]
    result = refine_points(proj, pixels, start, weights, mask, loss=loss, scale=SCALE)
    assert_close(result.points, wanted.points, rtol=0, atol=1e-10)  # m
    assert_close(result.residual, wanted.residual, rtol=0, atol=1e-9)  # px
    assert torch.equal(result.valid, wanted.valid)


@given(drawn=near_misses(), factor=scales(decades=200))
def test_only_the_ratios_of_weights_count(
    drawn: tuple[PosedScene, Tensor, Tensor], factor: float
) -> None:
    scene, weights, start = drawn
    one = refine_points(scene.views.proj, scene.pixels, start, weights, loss="huber")
    other = refine_points(scene.views.proj, scene.pixels, start, factor * weights, loss="huber")
    assert_close(other.points, one.points, rtol=0, atol=1e-10)  # m


@given(
    drawn=near_misses(),
    turn=vectors(1, within=3.0),
    shift=vectors(1, within=10.0),
    scale=scales(decades=2),
    loss=st.sampled_from(LOSSES),
)
def test_refined_points_move_with_the_world(
    drawn: tuple[PosedScene, Tensor, Tensor],
    turn: Tensor,
    shift: Tensor,
    scale: float,
    loss: Loss,
) -> None:
    scene, weights, start = drawn
    new_from_world = rigid(turn, shift)[0]
    rotation, translation = new_from_world[:3, :3], new_from_world[:3, 3]
    cam_from_new = scene.views.cam_from_world @ torch.linalg.inv(new_from_world)
    cam_from_new[:, :3, 3] *= scale
    proj = PosedViews(scene.views.K, cam_from_new).proj
    points = refine_points(
        scene.views.proj, scene.pixels, start, weights, loss=loss, scale=SCALE
    ).points
    new_start = scale * (start @ rotation.mT + translation)
    moved = refine_points(proj, scene.pixels, new_start, weights, loss=loss, scale=SCALE).points
    wanted = scale * (points @ rotation.mT + translation)
    assert_close(moved, wanted, rtol=0, atol=1e-8 * scale)  # 10 nm in the old unit


@given(drawn=near_misses())
def test_float32_is_within_its_bound_of_float64(drawn: tuple[PosedScene, Tensor, Tensor]) -> None:
    scene, weights, start = drawn
    inputs = [value.float() for value in (scene.views.proj, scene.pixels, start, weights)]
    single = refine_points(*inputs, loss="cauchy")
    exact = refine_points(*(value.double() for value in inputs), loss="cauchy")
    # Computed in float64 either way: only the result is rounded, at 5 m.
    assert_close(single.points.double(), exact.points, rtol=0, atol=6e-8 * 8)  # m


def test_a_compiled_step_is_the_same() -> None:
    scene = scene_at(30, num_views=3, count=40)
    proj, pixels = scene.views.proj, scene.pixels.clone()
    pixels[1, 3] = torch.nan
    torch.compiler.reset()
    compiled = torch.compile(refine_points, fullgraph=True)(proj, pixels, scene.points)
    eager = refine_points(proj, pixels, scene.points)
    assert_close(compiled.points, eager.points, rtol=0, atol=1e-9)  # m
    assert_close(compiled.residual, eager.residual, rtol=0, atol=1e-9)  # px
    assert torch.equal(compiled.valid, eager.valid) and eager.valid.sum() == 39


def test_half_precision_is_computed_in_double() -> None:
    scene = forward_motion()
    halves = [value.half() for value in (scene.views.proj, scene.pixels, scene.points + 0.02)]
    found = refine_points(*halves, steps=3)
    exact = refine_points(*(value.double() for value in halves), steps=3)
    assert found.points.dtype == found.residual.dtype == torch.float16
    assert torch.equal(found.points, exact.points.half())


def test_what_cannot_be_refined_comes_back(dtype: torch.dtype) -> None:
    scene = forward_motion(dtype=dtype)
    pixels, points = scene.pixels.repeat(1, 2, 1), scene.points.repeat(2, 1)
    points[1] = torch.tensor([0.0, 0.1, -2.0])  # behind
    points[2, 1] = torch.nan
    pixels[1, 3, 0] = torch.inf
    mask = torch.ones(2, 6, dtype=torch.bool)
    mask[0, 4] = False  # one view left
    weights = torch.ones(2, 6, dtype=dtype)
    inputs = [
        value.clone().requires_grad_() for value in (scene.views.proj, pixels, points, weights)
    ]
    refined = refine_points(*inputs, mask)
    assert refined.valid.tolist() == [True, False, False, False, False, True]
    kept = points.clone()
    kept[2] = 0
    failed = ~refined.valid
    assert torch.equal(refined.points[failed], kept[failed])
    assert (refined.residual[failed] == 0).all()
    gradients = torch.autograd.grad((refined.points.sum() + refined.residual.sum()), inputs)
    assert all(gradient.isfinite().all() for gradient in gradients)
    for gradient in (gradients[1], gradients[3]):
        assert (gradient[:, failed] == 0).all() and (gradient[:, 5] != 0).any()
    assert (gradients[2][failed] == 0).all()


@pytest.mark.parametrize("name", DEGENERATE_SCENES)
def test_named_scenes_are_finite(name: str, dtype: torch.dtype) -> None:
    scene = DEGENERATE_SCENES[name](dtype=dtype)
    inputs = [
        value.clone().requires_grad_() for value in (scene.views.proj, scene.pixels, scene.points)
    ]
    refined = refine_points(*inputs, steps=2)
    assert refined.valid.all() == (name in ("right_angle", "ring", "forward_motion"))
    gradients = torch.autograd.grad(refined.points.sum() + refined.residual.sum(), inputs)
    assert all(value.isfinite().all() for value in (*refined, *gradients))


@given(
    pixels=extreme(3, 4, 2),
    weights=extreme(3, 4),
    proj=extreme(3, 3, 4),
    points=extreme(4, 3),
    wild=st.booleans(),
    loss=st.sampled_from(LOSSES),
)
def test_no_finite_input_gives_nan_or_inf(
    pixels: Tensor, weights: Tensor, proj: Tensor, points: Tensor, wild: bool, loss: Loss
) -> None:
    rig = ring().views.proj[:3]
    for dtype in (torch.float32, torch.float64):
        # True gradients of 1e40 do not fit float32: numbers up to 1e7 there.
        power = 0.25 if dtype == torch.float32 else 1
        inputs = [
            (value.sign() * value.abs() ** power).to(dtype).requires_grad_()
            for value in (proj if wild else rig, pixels, points, weights)
        ]
        refined = refine_points(*inputs, steps=2, loss=loss)
        assert all(value.isfinite().all() for value in refined)
        total = refined.points.sum() + refined.residual.sum()
        for gradient in torch.autograd.grad(total, inputs):
            assert gradient.isfinite().all()
