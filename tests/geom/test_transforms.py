"""What PyTorch does to functions: derivatives of any kind, vmap, compile, export, autocast."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from deltas_geom import (
    Triangulation,
    triangulate,
    triangulate_points,
    triangulate_rays,
    triangulate_tracks,
)
from deltas_geom.testing import PosedScene, right_angle, ring
from deltas_geom.testing.fixed_scenes import seeded_scene

Inputs = tuple[Tensor, Tensor, Tensor]
"""Cameras, pixels (or rays) and weights."""
Known = tuple[Tensor, ...]

NEEDS_COMPILER = pytest.mark.skipif(
    shutil.which("g++") is None, reason="torch.compile needs a C++ compiler"
)


def weights_for(pixels: Tensor) -> Tensor:
    """Weights ``(*B, V, N)`` of 0.4 to 1.2, all different."""
    count = pixels[..., 0].numel()
    return (0.4 + 0.8 * torch.arange(count) / count).reshape(pixels.shape[:-1]).to(pixels.dtype)


def inputs_of(scene: PosedScene) -> Inputs:
    return scene.views.proj, scene.pixels, weights_for(scene.pixels)


def many(count: int, dtype: torch.dtype = torch.float64) -> Inputs:
    """Three views of points with 1 px of noise."""
    scene = seeded_scene(3, num_views=3, num_points=count, noise=1.0)
    proj, pixels, weights = inputs_of(scene)
    return proj.to(dtype), pixels.to(dtype), weights.to(dtype)


def rays_for(count: int) -> Inputs:
    """The same as rays of poses."""
    scene = seeded_scene(3, num_views=3, num_points=count, noise=1.0)
    ones = torch.ones_like(scene.pixels[..., :1])
    rays = torch.cat([scene.pixels, ones], dim=-1) @ torch.linalg.inv(scene.views.K).mT
    return scene.views.cam_from_world, rays, weights_for(scene.pixels)


def leaves(inputs: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    return tuple(tensor.detach().clone().requires_grad_() for tensor in inputs)


def all_known(proj: Tensor, pixels: Tensor, weights: Tensor) -> Known:
    """Everything of floating point; the square of the residual, which curves less at small ones."""
    result = triangulate(proj, pixels, weights, covariance=True)
    assert result.covariance is not None
    return result.points, result.depth, result.residual.square(), result.covariance


def all_known_of_rays(cam_from_world: Tensor, rays: Tensor, weights: Tensor) -> Known:
    result = triangulate_rays(cam_from_world, rays, weights)
    return result.points, result.depth, 1e3 * result.residual.square()


def all_known_of_tracks(proj: Tensor, pixels: Tensor, weights: Tensor) -> Known:
    """The same matches as a list, camera by camera."""
    views, count = pixels.shape[:2]
    result = triangulate_tracks(
        proj,
        pixels.flatten(0, 1),
        torch.arange(views).repeat_interleave(count),
        torch.arange(count).repeat(views),
        count,
        weights.flatten(),
    )
    return result.points, result.depth, result.residual.square()


TIES = pytest.mark.parametrize("scene", [right_angle(), ring()], ids=["90 degrees", "ring"])
FUNCTIONS: dict[str, tuple[Callable[..., Known], Callable[[int], Inputs]]] = {
    "points": (lambda *inputs: (triangulate_points(*inputs),), many),
    "world": (lambda *inputs: (triangulate_points(*inputs, frame="world"),), many),
    "all": (all_known, many),
    "rays": (all_known_of_rays, rays_for),
    "tracks": (all_known_of_tracks, many),
}
EACH = pytest.mark.parametrize("name", FUNCTIONS)


def rig_points_by_eigh(proj: Tensor, pixels: Tensor, weights: Tensor) -> Tensor:
    """The rig frame's minimiser as an eigenvector, twice differentiable off the ties."""
    centers = -torch.linalg.solve(proj[..., :3], proj[..., 3:]).squeeze(-1)  # (V, 3)
    squared = weights.square().mT  # (N, V)
    share = squared / squared.sum(dim=-1, keepdim=True)
    origin = share @ centers
    apart = (centers - origin[:, None]).square().sum(dim=-1)
    unit = (share * apart).sum(dim=-1).sqrt()
    moved = torch.einsum("vij,nj->nvi", proj[..., :3], origin) + proj[..., 3]
    near = torch.cat(
        [(proj[..., :3] * unit[:, None, None, None]), moved.unsqueeze(-1)], dim=-1
    )  # (N, V, 3, 4)
    rows = pixels.transpose(0, 1).unsqueeze(-1) * near[..., 2:, :] - near[..., :2, :]
    rows = (weights.mT[..., None, None] * rows).flatten(1, 2)
    vector = torch.linalg.eigh(rows.mT @ rows).eigenvectors[..., 0]
    return vector[:, :3] / vector[:, 3:] * unit[:, None] + origin


@pytest.mark.parametrize("seed", range(1, 3))
def test_first_and_second_derivatives_are_those_of_an_eigenvector(seed: int) -> None:
    # Scenes without ties, where the eigenvector's own derivatives would be NaN.
    inputs = inputs_of(seeded_scene(seed, num_views=3, num_points=2, noise=1.0))
    for argument in range(3):
        for transform in (torch.func.jacrev, torch.func.hessian):
            found = transform(triangulate_points, argnums=argument)(*inputs)
            wanted = transform(rig_points_by_eigh, argnums=argument)(*inputs)
            assert_close(found, wanted, rtol=0, atol=1e-8 * float(wanted.abs().max()))


@EACH
def test_gradients_are_right_in_both_modes_and_batched(name: str) -> None:
    function, make = FUNCTIONS[name]
    assert torch.autograd.gradcheck(
        function,
        leaves(make(2)),
        eps=1e-5,
        atol=1e-6,
        check_forward_ad=True,
        check_batched_grad=True,
        check_batched_forward_grad=True,
        fast_mode=True,
    )


@EACH
def test_second_derivatives_are_right(name: str) -> None:
    function, make = FUNCTIONS[name]
    # Entries of proj are in px: products of two changes need a coarser step than one.
    step = 1e-5 if name == "rays" else 1e-4
    assert torch.autograd.gradgradcheck(
        function, leaves(make(2)), eps=step, atol=1e-4, fast_mode=True
    )


@TIES
def test_at_ties_derivatives_of_both_orders_and_modes_are_right(scene: PosedScene) -> None:
    inputs = leaves(inputs_of(scene))
    assert torch.autograd.gradcheck(
        triangulate_points,
        inputs,
        eps=1e-5,
        atol=1e-6,
        check_forward_ad=True,
        check_batched_grad=True,
        fast_mode=True,
    )
    assert torch.autograd.gradgradcheck(
        triangulate_points, inputs, eps=1e-3, atol=1e-5, fast_mode=True
    )


@EACH
def test_vmap_is_a_batch_dim(name: str) -> None:
    function, make = FUNCTIONS[name]
    proj, pixels, weights = make(3)
    shift = torch.linspace(0, 1e-2, 4).double()
    all_pixels = pixels + shift[:, None, None, None]
    all_proj = proj.expand(4, *proj.shape)
    all_weights = weights * (1 + shift[:, None, None])
    mapped = torch.func.vmap(function)(all_proj, all_pixels, all_weights)
    shared = torch.func.vmap(function, in_dims=(None, 1, None))(
        proj, all_pixels.transpose(0, 1), weights
    )
    for item in range(4):
        wanted = function(all_proj[item], all_pixels[item], all_weights[item])
        for found, one in zip(mapped, wanted, strict=True):
            assert_close(found[item], one, rtol=1e-9, atol=1e-12)
        for found, one in zip(shared, function(proj, all_pixels[item], weights), strict=True):
            assert_close(found[item], one, rtol=1e-9, atol=1e-12)
    if name != "tracks":
        for found, one in zip(mapped, function(all_proj, all_pixels, all_weights), strict=True):
            assert_close(found, one, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_vmap_keeps_status_and_masks(dtype: torch.dtype) -> None:
    proj, pixels, weights = many(3, dtype)
    mask = torch.ones(4, 3, 3, dtype=torch.bool)
    mask[1, :, 0], mask[2, 0] = False, False

    def solve(mask: Tensor) -> Triangulation:
        # vmap takes no None among the outputs: with the covariance there is none.
        return triangulate(proj, pixels, weights, mask, covariance=True)

    mapped, batched = torch.func.vmap(solve)(mask), solve(mask)
    assert torch.equal(mapped.status, batched.status) and not mapped.valid.all()
    assert_close(mapped.points, batched.points)


@EACH
def test_transforms_nest(name: str) -> None:
    function, make = FUNCTIONS[name]
    cameras, pixels, weights = make(2)

    def solve(pixels: Tensor) -> Tensor:
        return function(cameras, pixels, weights)[0]

    curvature = torch.func.jacfwd(torch.func.jacrev(solve))(pixels)
    assert curvature.isfinite().all() and (curvature != 0).any()
    for other in (
        torch.func.jacrev(torch.func.jacrev(solve)),
        torch.func.jacrev(torch.func.jacfwd(solve)),
        torch.func.jacfwd(torch.func.jacfwd(solve)),
    ):
        size = float(curvature.abs().max())
        assert_close(other(pixels), curvature, rtol=0, atol=1e-9 * size)
    several = torch.stack([pixels, pixels + 1e-2])
    each = torch.func.vmap(torch.func.jacrev(solve))(several)
    for found, one in zip(each, several, strict=True):
        assert_close(found, torch.func.jacrev(solve)(one), rtol=1e-8, atol=1e-12)
    # The other nesting: an inner vmap hides from the outer derivative what it is taken of.
    across = torch.func.jacrev(torch.func.vmap(solve))(several)
    for item in range(2):
        assert_close(across[item, :, :, item], each[item], rtol=1e-8, atol=1e-12)
        assert (across[item, :, :, 1 - item] == 0).all()


def compiled_as_eager(
    name: str, backend: str, *counts: int, dynamic: bool = True, gradients: bool = True
) -> None:
    """Check values and gradients at several N, of one graph for all."""
    torch.compiler.reset()
    from torch._dynamo.testing import CompileCounterWithBackend

    function, make = FUNCTIONS[name]
    counter = CompileCounterWithBackend(backend)
    compiled = torch.compile(function, fullgraph=True, dynamic=dynamic, backend=counter)
    compilations = []
    for count in counts:
        inputs = leaves(make(count)) if gradients else make(count)
        found, wanted = compiled(*inputs), function(*inputs)
        # The first may begin anew: torch takes numbers for inputs until one cannot be.
        compilations.append(counter.frame_count)
        for ours, theirs in zip(found, wanted, strict=True):
            assert_close(ours, theirs, rtol=1e-9, atol=1e-12)
        if not gradients:
            continue
        totals = (sum(value.sum() for value in values) for values in (found, wanted))
        for ours, theirs in zip(*(torch.autograd.grad(t, inputs) for t in totals), strict=True):
            assert_close(ours, theirs, rtol=1e-7, atol=1e-9 * float(theirs.abs().max()))
    assert len(set(compilations)) == 1
    torch.compiler.reset()


@NEEDS_COMPILER
@pytest.mark.slow
@pytest.mark.parametrize("name", ["points", "all", "rays"])
def test_compiled_as_one_graph_for_any_number_of_points_it_is_the_same(name: str) -> None:
    compiled_as_eager(name, "inductor", 5, 9, 20)


@NEEDS_COMPILER
@pytest.mark.slow
def test_without_gradients_one_graph_serves_any_number_of_points() -> None:
    compiled_as_eager("all", "inductor", 5, 9, 20, gradients=False)


@pytest.mark.parametrize(
    "name", ["rays", *(pytest.param(name, marks=pytest.mark.slow) for name in ("world", "all"))]
)
def test_traced_as_one_graph_gradients_are_the_same(name: str) -> None:
    # What torch.compile does before a compiler sees the graph, which is what may break.
    compiled_as_eager(name, "aot_eager", 5, dynamic=False)


class Points(torch.nn.Module):
    """For export: points alone."""

    def forward(self, proj: Tensor, pixels: Tensor, weights: Tensor) -> Tensor:
        return triangulate_points(proj, pixels, weights)


class Everything(torch.nn.Module):
    """For export: all fields, status too."""

    def forward(self, proj: Tensor, pixels: Tensor, weights: Tensor) -> Known:
        found = triangulate(proj, pixels, weights, covariance=True)
        return tuple(value for value in found if value is not None)


def any_number() -> tuple[dict[int, torch.export.Dim] | None, ...]:
    count = torch.export.Dim("points", min=2, max=2**20)
    return None, {1: count}, {1: count}


def test_it_exports_for_any_number_of_points() -> None:
    exported = torch.export.export(Everything(), many(3), dynamic_shapes=any_number())
    inputs = many(11)
    for found, wanted in zip(exported.module()(*inputs), Everything()(*inputs), strict=True):
        assert found.dtype == wanted.dtype
        assert_close(found, wanted, rtol=1e-9, atol=1e-12)


# By day the exported network, which triangulates, stands for it (tests/nets/test_export.py).
@pytest.mark.slow
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_onnxruntime_finds_the_same_points(dtype: torch.dtype, tmp_path: Path) -> None:
    pytest.importorskip("onnx", reason="needs the extra 'export'")
    pytest.importorskip("onnxscript", reason="needs the extra 'export'")
    runtime = pytest.importorskip("onnxruntime", reason="needs the extra 'export'")
    path = tmp_path / "points.onnx"
    # The optimiser takes half of the time, and is not ours; onnxruntime has its own.
    options = {"dynamo": True, "verbose": False, "optimize": False}
    program = torch.onnx.export(Points(), many(3, dtype), dynamic_shapes=any_number(), **options)
    assert program is not None
    program.save(str(path))
    session = runtime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    names = [known.name for known in session.get_inputs()]
    for count in (11, 2):
        inputs = many(count, dtype)
        inputs[1][0, 0] = torch.nan
        fed = {name: value.numpy() for name, value in zip(names, inputs, strict=True)}
        (found,) = session.run(None, fed)
        wanted = Points()(*inputs)
        assert found.shape == (count, 3)
        assert_close(torch.from_numpy(found), wanted, rtol=0, atol=1e-6)  # m


@pytest.mark.parametrize("function", [triangulate, triangulate_rays], ids=["pixels", "rays"])
def test_autocast_changes_nothing(
    function: Callable[..., Triangulation], dtype: torch.dtype
) -> None:
    inputs = many(4) if function is triangulate else rays_for(4)
    cast = leaves(tuple(tensor.to(dtype) for tensor in inputs))
    plain = function(*cast)
    wanted = torch.autograd.grad(plain.points.sum() + plain.residual.sum(), cast)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        half = function(*cast)
        points = triangulate_points(*cast) if function is triangulate else half.points
    assert torch.equal(points, plain.points)
    for ours, theirs in zip(half, plain, strict=True):
        assert theirs is None if ours is None else torch.equal(ours, theirs)
    # Backward may run outside autocast, as it should, or inside.
    found = torch.autograd.grad(half.points.sum() + half.residual.sum(), cast, retain_graph=True)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        inside = torch.autograd.grad(half.points.sum() + half.residual.sum(), cast)
    for ours, other, theirs in zip(found, inside, wanted, strict=True):
        assert torch.equal(ours, theirs) and torch.equal(other, theirs)
