"""What holds of every solver of points, and of both ways in which few and many are solved."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from operations import Inputs, chosen, followed, is_real
from solvers import SEEN, SOLVERS, Fields, Solver, assert_same, inputs_of, moved, of_views, sights
from solvers import spoilt as without
from torch import Tensor
from torch.testing import assert_close
from triangulation_cases import NAMED_STATUS

from deltas_geom import ShapeError, Status, camera_centers, project
from deltas_geom.numerics import chunks
from deltas_geom.testing import (
    DEGENERATE_SCENES,
    PosedScene,
    forward_motion,
    on_baseline,
    right_angle,
    ring,
)
from deltas_geom.testing.strategies import extreme, posed_scenes, scales, vectors
from deltas_geom.triangulation import robust
from deltas_geom.triangulation import triangulate as dispatch

REFINES = {name for name in SOLVERS if name.startswith("refine")}
FEW = {"triangulate_two_view"}  # who takes no third view
# Drawn anew for each of twenty solvers: a few examples of each are many.
FEWER = settings(max_examples=max(1, settings.default.max_examples // 5))
EACH = pytest.mark.parametrize("name", SOLVERS)
OF_SOLVED = pytest.mark.parametrize("name", [name for name in SOLVERS if name not in REFINES])
OF_MORE = pytest.mark.parametrize("name", [name for name in SOLVERS if name not in FEW])


def drawn(data: st.DataObject, solver: Solver, views: int | None = None) -> Inputs:
    found: Inputs = data.draw(sights(views or solver.views, outliers=solver.robust))
    return found


def total(found: Fields) -> Tensor:
    """Of what has a gradient."""
    parts = [value.sum() for value in found.values() if is_real(value) and value.requires_grad]
    return sum(parts, torch.zeros(()).double())


def gradients(solver: Solver, inputs: Inputs) -> tuple[Fields, Inputs]:
    """Results, and the gradient of the points and the squared residuals, by input."""
    leaves = followed(chosen(solver.operation, inputs))
    found = solver(leaves)
    some = {"points": found["points"]}
    if "residual" in found:
        some["residual"] = found["residual"].square()  # at 0 it has a slope itself
    real = {name: leaf for name, leaf in leaves.items() if leaf.requires_grad}
    pulled = torch.autograd.grad(total(some), list(real.values()), materialize_grads=True)
    return found, dict(zip(real, pulled, strict=True))


@EACH
def test_wrong_shapes_are_named(name: str) -> None:
    solver = SOLVERS[name]
    scene = forward_motion()
    inputs = inputs_of(scene)
    cameras = "proj" if solver.takes("proj") else "poses"
    if "tracks" not in name:  # these are lists
        three = inputs | {cameras: inputs[cameras].repeat(3, 1, 1, 1)}
        for leaf in ("pixels", "rays", "weights", "mask", "points"):
            if solver.takes(leaf):
                two = inputs[leaf].expand(2, *inputs[leaf].shape)
                with pytest.raises(ShapeError, match="leading batch dims must broadcast"):
                    solver(three | {leaf: two})
    if name not in FEW and "tracks" not in name:  # exactly two
        many = inputs | {cameras: inputs[cameras][[0, 1, 1]]}
        with pytest.raises(ShapeError, match=r"has V = [23] but \w+ has V = [32]"):
            solver(many)
        for tensor in ("weights", "mask"):
            if not solver.takes(tensor):
                continue
            with pytest.raises(ShapeError, match=rf"{tensor} has N = 2 but \w+ has N = 3"):
                solver(inputs | {tensor: inputs[tensor][:, :2]})
            with pytest.raises(ShapeError, match=rf"{tensor} has V = 1 but \w+ has V = 2"):
                solver(inputs | {tensor: inputs[tensor][:1]})


@OF_SOLVED
@FEWER
@given(data=st.data())
def test_without_noise_points_are_exact(name: str, data: st.DataObject) -> None:
    solver = SOLVERS[name]
    scene: PosedScene = data.draw(posed_scenes(num_views=solver.views))
    found = solver(inputs_of(scene))
    assert_close(found["points"], scene.points, rtol=0, atol=1e-9)  # m
    if "depth" in found:
        centers = camera_centers(scene.views.cam_from_world)
        away = (scene.points - centers[:, None]).norm(dim=-1)
        ahead = project(scene.views, scene.points).depth
        wanted = ahead if solver.takes("proj") else away
        assert found["valid"].all() and (found["status"] == Status.OK).all()
        assert_close(found["depth"], wanted, rtol=0, atol=1e-9)  # m
        assert (found["residual"] < 1e-7).all()  # px or rad


@EACH
@FEWER
@given(data=st.data())
def test_neither_the_order_of_views_nor_the_length_of_rays_counts(
    name: str, data: st.DataObject
) -> None:
    solver = SOLVERS[name]
    inputs = drawn(data, solver)
    order = data.draw(st.permutations(range(solver.views)))
    other = of_views(inputs, order)
    # Nor does the length of rays.
    lengths = 1 + data.draw(vectors(solver.views, within=0.9, size=4))
    other["rays"] = other["rays"] * lengths[..., None]
    assert_same(solver(other), of_views(solver(inputs), order))


@OF_MORE
@FEWER
@given(data=st.data(), by_mask=st.booleans(), camera=st.booleans())
def test_a_view_that_is_masked_or_of_weight_0_is_a_view_removed(
    name: str, data: st.DataObject, by_mask: bool, camera: bool
) -> None:
    solver = SOLVERS[name]
    inputs = drawn(data, solver, views=solver.views + solver.robust)
    views = len(inputs["proj"])
    gone = data.draw(st.integers(0, views - 1))
    rest = [view for view in range(views) if view != gone]
    if not (solver.takes("mask") or solver.takes("weights")):
        return
    left = without(inputs, gone, camera=camera and "tracks" not in name)
    which = (
        "mask" if solver.takes("mask") and (by_mask or not solver.takes("weights")) else "weights"
    )
    left[which] = inputs[which].clone()
    left[which][gone] = 0
    found, of_found = gradients(solver, left)
    wanted, of_wanted = gradients(solver, of_views(inputs, rest))
    assert_same(of_views(found, rest), wanted)
    assert "inliers" not in found or not found["inliers"][gone].any()
    for leaf, gradient in of_found.items():
        assert gradient.isfinite().all(), leaf
        if leaf != "points":
            assert (gradient[gone] == 0).all(), leaf
            gradient = gradient[rest]
        bound = 1e-8 * (1 + float(of_wanted[leaf].abs().max()))
        assert_close(gradient, of_wanted[leaf], rtol=0, atol=bound)


@pytest.mark.parametrize("name", [n for n in SOLVERS if SOLVERS[n].takes("weights")])
@FEWER
@given(data=st.data(), factor=scales(decades=200))
def test_only_the_ratios_of_weights_count(name: str, data: st.DataObject, factor: float) -> None:
    solver = SOLVERS[name]
    inputs = drawn(data, solver)
    scaled = inputs | {"weights": factor * inputs["weights"]}
    assert_same(solver(scaled), solver(inputs), where=lambda field: field != "covariance")
    turned = inputs | {"weights": inputs["weights"] * torch.tensor([1.0, -1, 1, -1]).double()}
    assert_same(solver(turned), solver(inputs))


@pytest.mark.parametrize("name", [n for n in SOLVERS if SOLVERS[n].takes("weights")])
@FEWER
@given(data=st.data())
def test_a_doubled_view_is_a_doubled_squared_weight(name: str, data: st.DataObject) -> None:
    solver = SOLVERS[name]
    inputs = drawn(data, solver)
    twice = data.draw(st.integers(0, solver.views - 1))
    doubled = of_views(inputs, [*range(solver.views), twice])
    heavier = inputs | {"weights": inputs["weights"].clone()}
    heavier["weights"][twice] *= 2**0.5
    views = list(range(solver.views))
    # Of more than three observations a track's parallax is not the largest.
    same = {"where": lambda field: field != "parallax"} if "tracks" in name else {}
    assert_same(of_views(solver(doubled), views), solver(heavier), **same)


@pytest.mark.parametrize("name", [name for name in SOLVERS if "world" not in name])
@FEWER
@given(
    data=st.data(),
    turn=vectors(1, within=3.0),
    shift=vectors(1, within=10.0),
    scale=scales(decades=2),
)
def test_points_move_with_the_world(
    name: str, data: st.DataObject, turn: Tensor, shift: Tensor, scale: float
) -> None:
    solver = SOLVERS[name]
    inputs = drawn(data, solver)
    here, there = solver(inputs), solver(moved(inputs, turn[0], shift[0], scale))
    wanted = dict(here)
    wanted["points"] = moved(inputs | {"points": here["points"]}, turn[0], shift[0], scale)[
        "points"
    ]
    if "depth" in here:
        wanted["depth"] = scale * here["depth"]
    if "covariance" in here:
        rotation = moved(inputs, turn[0], 0 * shift[0], 1.0)["poses"][0, :3, :3].mT
        rotation = rotation @ inputs["poses"][0, :3, :3]
        wanted["covariance"] = scale**2 * rotation @ here["covariance"] @ rotation.mT
    assert_same(there, wanted, atol=1e-8 * max(1.0, scale))  # 10 nm in the old unit


@EACH
@FEWER
@given(data=st.data())
def test_float32_is_within_its_bound_of_float64(name: str, data: st.DataObject) -> None:
    solver = SOLVERS[name]
    inputs = {k: x.float() if is_real(x) else x for k, x in drawn(data, solver).items()}
    single = solver(inputs)
    exact = solver({k: x.double() if is_real(x) else x for k, x in inputs.items()})
    near = 1e-5 if "world" in name else 6e-8 * 8  # m: solved in float64, rounded at 5 m
    assert_close(single["points"].double(), exact["points"], rtol=0, atol=near)
    if "pixels" in single:
        assert_close(single["pixels"].double(), exact["pixels"], rtol=0, atol=6e-8 * 1024)
    assert all(torch.equal(single[k], exact[k]) for k in single if not is_real(single[k]))


@EACH
@FEWER
@given(data=st.data(), wild=st.booleans())
def test_no_finite_input_gives_nan_or_inf(name: str, data: st.DataObject, wild: bool) -> None:
    solver = SOLVERS[name]
    rig = chosen(solver.operation, inputs_of(ring()))
    views = min(solver.views, 4)
    drawn: Inputs = {}
    for leaf, tensor in rig.items():
        if leaf in ("proj", "poses") and not wild:
            drawn[leaf] = tensor[:views]
        elif leaf == "mask":
            drawn[leaf] = torch.ones(views, 4, dtype=torch.bool)
        else:
            shape = {"points": (4, 3), "proj": (views, 3, 4), "poses": (views, 4, 4)}.get(
                leaf, (views, 4, *tensor.shape[2:])
            )
            drawn[leaf] = data.draw(extreme(*shape))
    for dtype in (torch.float32, torch.float64):
        # True gradients of 1e40 do not fit float32: numbers up to 1e7 there.
        power = 0.25 if dtype == torch.float32 else 1
        leaves = {
            k: (x.sign() * x.abs() ** power).to(dtype).requires_grad_() if is_real(x) else x
            for k, x in drawn.items()
        }
        found = solver(leaves)
        for field, value in found.items():
            assert value.isfinite().all(), field
        some = {k: x for k, x in found.items() if k in ("points", "depth", "residual", "pixels")}
        real = [leaf for leaf in leaves.values() if is_real(leaf)]
        for gradient in torch.autograd.grad(total(some), real, materialize_grads=True):
            assert gradient.isfinite().all()


@EACH
@pytest.mark.parametrize("scene", DEGENERATE_SCENES)
def test_named_scenes_have_their_status_and_finite_gradients(
    scene: str, name: str, dtype: torch.dtype
) -> None:
    solver, status = SOLVERS[name], NAMED_STATUS[scene]
    some = DEGENERATE_SCENES[scene](dtype=dtype)
    inputs = of_views(inputs_of(some), list(range(min(len(some.pixels), solver.views))))
    found, pulled = gradients(solver, inputs)
    if "status" in found:
        assert (found["status"] == status).all()
    if "valid" in found:
        assert (found["valid"] == (status == Status.OK)).all()
    assert all(value.isfinite().all() for value in (*found.values(), *pulled.values()))
    if status == Status.OK:
        assert_close(found["points"], some.points, rtol=1e-5, atol=1e-5)  # m
        return
    if name not in REFINES:
        assert all((found[k] == 0).all() for k in ("points", "depth", "residual") if k in found)
    failed = [gradient for leaf, gradient in pulled.items() if leaf != "points"]
    assert all((gradient == 0).all() for gradient in failed)


def unsolved(dtype: torch.dtype) -> tuple[Inputs, list[Status]]:
    """Two views of points of which all but the first fail, and why."""
    scene = forward_motion(dtype=dtype)
    pixels = scene.pixels[:, :1].repeat(1, 10, 1)
    pixels[1, 1] = pixels[0, 1]  # a star
    pixels[0, 2, 0] = torch.nan
    pixels[1, 3, 1] = torch.inf
    pixels[:, 4] = on_baseline(dtype=dtype).pixels[:, 0]  # both epipoles
    pixels[:, 5] = pixels[:, 5].flip(0)  # the lines meet behind
    inputs = inputs_of(scene._replace(pixels=pixels, points=scene.points[:1].expand(10, 3)))
    inputs["mask"][1, 6] = False
    inputs["weights"][1, 7] = torch.inf
    # Of rays alone: the lines meet where they did, but behind; and one has no direction.
    inputs["rays"][:, 8] *= -1
    inputs["rays"][0, 9] = 0
    return inputs, [
        Status.OK,
        Status.AT_INFINITY,
        Status.NOT_FINITE_INPUT,
        Status.NOT_FINITE_INPUT,
        Status.NO_PARALLAX,
        Status.BEHIND_CAMERA,
        Status.TOO_FEW_VIEWS,
        Status.NOT_FINITE_INPUT,
        Status.BEHIND_CAMERA,
        Status.NOT_FINITE_INPUT,
    ]


@OF_SOLVED
def test_status_tells_the_truth_and_what_fails_has_no_gradient(
    name: str, dtype: torch.dtype
) -> None:
    solver = SOLVERS[name]
    inputs, wanted = unsolved(dtype)
    if not solver.takes("mask"):
        inputs["weights"] = torch.where(inputs["mask"], inputs["weights"], 0.0)
    cases = list(range(6))
    cases += [6] * (solver.takes("mask") or solver.takes("weights")) + [7] * solver.takes("weights")
    cases += [8, 9] * solver.takes("rays")
    inputs = {
        k: x if k in ("K", "poses", "proj") else x[cases] if k == "points" else x[:, cases]
        for k, x in inputs.items()
    }
    found, pulled = gradients(solver, inputs)
    if "status" in found:
        assert [Status(k) for k in found["status"].tolist()] == [wanted[k] for k in cases]
        assert torch.equal(found["valid"], found["status"] == Status.OK)
    assert (found["points"][1:] == 0).all() and (found["points"][0] != 0).any()
    for field in ("depth", "residual", "parallax"):
        if field in found:
            assert (found[field][..., 1:] == 0).all(), field
    assert all(gradient.isfinite().all() for gradient in pulled.values())
    for leaf in SEEN:
        if leaf in pulled:
            assert (pulled[leaf][:, 1:] == 0).all() and (pulled[leaf][:, 0] != 0).any(), leaf


@pytest.mark.parametrize("name", [n for n in SOLVERS if SOLVERS[n].takes("pixels")])
@pytest.mark.parametrize("size", [1e38, 1e39])  # squares of squares of 1e38 are numbers
def test_pixels_whose_products_overflow_are_not_finite(name: str, size: float) -> None:
    inputs = inputs_of(forward_motion())
    inputs["pixels"][1, 0] = size
    found = SOLVERS[name](inputs)
    if "status" in found:
        assert (found["status"][0] == Status.NOT_FINITE_INPUT) == (size > 1e38)
    assert size < 1e39 or "valid" not in found or not found["valid"][0]


@OF_SOLVED
def test_one_view_is_too_few(name: str) -> None:
    solver = SOLVERS[name]
    inputs = inputs_of(forward_motion())
    if name not in FEW:
        found = solver(of_views(inputs, [0]))
        assert (found["points"] == 0).all()
        assert "status" not in found or (found["status"] == Status.TOO_FEW_VIEWS).all()


@EACH
@pytest.mark.parametrize("noise", [0.0, 1.0])
@pytest.mark.parametrize(
    "scene", [forward_motion(), right_angle(), ring()], ids=["1", "90", "ring"]
)
def test_gradients_are_right(scene: PosedScene, noise: float, name: str) -> None:
    solver = SOLVERS[name]
    generator = torch.Generator().manual_seed(1)
    off = noise * torch.randn(scene.pixels.shape, generator=generator, dtype=torch.float64)
    weights = torch.linspace(0.5, 1.5, off[..., 0].numel()).double().reshape(off.shape[:-1])
    inputs = inputs_of(scene._replace(pixels=scene.pixels + off), weights)
    inputs["points"] = scene.points + noise * torch.tensor([0.02, -0.03, 0.04])
    if name in FEW:
        inputs = of_views(inputs, [0, 1])
    leaves = followed(chosen(solver.operation, inputs))
    if "implicit" in name:
        pytest.skip("after two steps a gradient of the minimum, see test_refine_gradients")

    def solve(*values: Tensor) -> list[Tensor]:
        found = solver(dict(zip(leaves, values, strict=True)))
        assert "valid" not in found or found["valid"].all()
        # Without noise the slope of a residual is a choice.
        fields = ("points", "depth", "pixels", *(("residual",) if noise else ()))
        return [found[field] for field in fields if field in found]

    # Entries of proj are in px: a coarser step keeps rounding below the tolerance.
    assert torch.autograd.gradcheck(
        solve, tuple(leaves.values()), eps=1e-5, atol=1e-5, fast_mode=True
    )


@pytest.mark.parametrize("name", [name for name in SOLVERS if "long" not in name])
def test_nothing_depends_on_how_many_are_solved_at_a_time(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dispatch, "FEW", 0)
    solver, count = SOLVERS[name], 70
    generator = torch.Generator().manual_seed(0)
    scene = forward_motion()
    pixels = scene.pixels.repeat(1, 24, 1)[:, :count]
    pixels = pixels + torch.randn(pixels.shape, generator=generator, dtype=torch.float64)
    pixels[0, 5] = torch.nan
    some = scene._replace(pixels=pixels, points=scene.points.repeat(24, 1)[:count])
    for weights in (None, 0.1 + torch.rand(2, count, generator=generator).double()):
        inputs = inputs_of(some, weights)
        wanted, of_wanted = gradients(solver, inputs)
        with monkeypatch.context() as patch:
            patch.setattr(chunks, "_SMALLEST_CHUNK", 5)
            patch.setattr(chunks, "SERIAL", 12)
            patch.setattr(robust, "_BUDGET", 64)
            found, of_found = gradients(solver, inputs)
            with torch.no_grad():
                plain = solver(inputs)
        assert_same(found, wanted, atol=1e-10)
        assert_same(plain, wanted, atol=1e-10)
        for leaf, gradient in of_found.items():
            size = 1 + float(of_wanted[leaf].abs().max())
            assert_close(gradient, of_wanted[leaf], rtol=0, atol=1e-9 * size)
