"""Sparse depth images: which pixel, and who wins."""

from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch.testing import assert_close

from deltas_geom import ShapeError, SparseDepth, rasterize_depth
from deltas_geom.testing.invariants import INVARIANTS
from deltas_geom.testing.planar import DepthScene
from deltas_geom.testing.strategies import depth_scenes
from deltas_geom.testing.target import Target
from deltas_geom.testing.targets import deltas

SIZE = (4, 5)
OURS = deltas()
DRAWN = [name for name, invariant in INVARIANTS.items() if invariant.scenes == "depths"]
OF_ANY = [name for name in DRAWN if INVARIANTS[name].needs == ("drawing",)]
KINDS = [(reduce, splat) for reduce in ("front", "mean") for splat in ("pixel", "bilinear")]


def rasterize(
    pixels: Tensor, depth: Tensor, weights: Any, kind: Any = ("front", "pixel"), **options: Any
) -> SparseDepth:
    reduce, splat = kind
    return rasterize_depth(
        pixels, depth, image_size=SIZE, weights=weights, reduce=reduce, splat=splat, **options
    )


def front_splat(
    pixels: Tensor, depth: Tensor, weights: Tensor, image_size: tuple[int, int]
) -> tuple[Tensor, Tensor]:
    found = rasterize_depth(pixels, depth, image_size=image_size, weights=weights, splat="bilinear")
    return found.depth[0], found.weight[0]


FRONT_SPLAT = Target("front, bilinear", splat=front_splat)


def test_wrong_arguments_are_named() -> None:
    pixels, depth, two = torch.zeros(5, 2), torch.ones(5), torch.ones(2, 5)
    with pytest.raises(ShapeError, match="depth has N = 4 but pixels has N = 5"):
        rasterize(pixels, depth[:4], None)
    with pytest.raises(ValueError, match="image_size"):
        rasterize_depth(pixels, depth, image_size=(0, 5))
    for wrong, word in ((("back", "pixel"), "reduce"), (("front", "cubic"), "splat")):
        with pytest.raises(ValueError, match=f"{word} must be"):
            rasterize(pixels, depth, None, wrong)
    with pytest.raises(TypeError, match=r"weights must be a torch\.Tensor, got float"):
        rasterize(pixels, depth, 2.0)
    # One for each point, not one for all.
    for shape in ((5, 1), (1,), (6,), (), (2, 5, 1)):
        other = torch.ones(shape)
        with pytest.raises(ShapeError, match=r"weights (has N|must have shape \(\*B, N\))"):
            rasterize(pixels, depth, other)
        with pytest.raises(ShapeError, match=r"mask (has N|must have shape \(\*B, N\))"):
            rasterize(pixels, depth, None, mask=other > 0)
    given = {"pixels": pixels.expand(2, 5, 2), "depth": two, "weights": two, "mask": two > 0}
    for name, each in given.items():
        with pytest.raises(ShapeError, match="leading batch dims must broadcast"):
            rasterize(**given | {name: torch.cat([each, each[:1]])})


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_traced_as_one_graph_it_is_the_same(kind: tuple[str, str]) -> None:
    generator = torch.Generator().manual_seed(0)
    pixels = 4 * torch.rand(3, 6, 2, generator=generator)
    depth = 1 + torch.rand(3, 6, generator=generator)
    weights = torch.linspace(0.5, 1, 6)

    def image(pixels: Tensor, depth: Tensor) -> Tensor:
        return rasterize(pixels, depth, weights, kind, mask=depth > 1.1).depth

    torch.compiler.reset()
    traced = torch.compile(image, fullgraph=True, backend="aot_eager")
    assert_close(traced(pixels, depth), image(pixels, depth))
    torch.compiler.reset()


@given(scene=depth_scenes())
@pytest.mark.parametrize("name", DRAWN)
def test_each_way_of_drawing_is_right(name: str, scene: DepthScene) -> None:
    INVARIANTS[name](OURS, scene)


@given(scene=depth_scenes(), order=st.permutations(range(8)))
def test_the_order_of_points_does_not_count(scene: DepthScene, order: list[int]) -> None:
    for target in (OURS, FRONT_SPLAT):
        INVARIANTS["the_order_of_points_does_not_count"](target, scene, order=order)


@given(scene=depth_scenes())
@pytest.mark.parametrize("name", OF_ANY)
def test_the_nearest_of_bilinear_splats_is_right(name: str, scene: DepthScene) -> None:
    INVARIANTS[name](FRONT_SPLAT, scene)


@given(scene=depth_scenes(), unused=st.integers(0, 7))
@pytest.mark.parametrize("kind", KINDS)
def test_a_masked_point_is_a_point_removed(
    kind: tuple[str, str], scene: DepthScene, unused: int
) -> None:
    pixels, depth, weights = (value.clone() for value in scene[:3])
    rest = torch.arange(8) != unused
    wanted = rasterize(pixels[rest], depth[rest], weights[rest], kind)
    for ours, theirs in zip(
        rasterize(pixels, depth, weights, kind, mask=rest), wanted, strict=True
    ):
        assert_close(ours, theirs, rtol=0, atol=1e-12)
    for spoilt, value in ((pixels, torch.nan), (depth, torch.inf), (weights, torch.nan)):
        spoilt[unused] = value
        inputs = [tensor.clone().requires_grad_() for tensor in (pixels, depth, weights)]
        found = rasterize(*inputs, kind, mask=rest)
        assert_close(found.depth, wanted.depth, rtol=0, atol=1e-12)
        unmasked = rasterize(*inputs, kind)
        assert_close(unmasked.weight, wanted.weight, rtol=0, atol=1e-12)
        total = unmasked.depth.sum() + unmasked.weight.sum()
        for gradient in torch.autograd.grad(total, inputs, allow_unused=True):
            if gradient is not None:
                assert gradient.isfinite().all() and (gradient[unused] == 0).all()


def test_a_share_below_rounding_is_no_share() -> None:
    pixels = torch.tensor([[0.0, 0.0], [0.0, 1e-30]], requires_grad=True)
    depth = torch.tensor([1.0, 3e4], requires_grad=True)
    weights = torch.tensor([1.8e4, 1.0], requires_grad=True)
    sparse = rasterize(pixels, depth, weights, ("mean", "bilinear"))
    assert (sparse.weight > 0).sum() == 1
    # Of both points at the pixel, weighted.
    wanted = (1.8e4 * 1.0 + 1.0 * 3e4) / (1.8e4 + 1.0)
    assert_close(sparse.depth.sum().item(), wanted, rtol=1e-6, atol=0)
    total = sparse.depth.sum() + sparse.weight.sum()
    for gradient in torch.autograd.grad(total, (pixels, depth, weights)):
        assert gradient.isfinite().all()


@pytest.mark.parametrize("splat", ["pixel", "bilinear"])
@pytest.mark.parametrize("size", [1e-45, 1e-40, 1e-37, 1.0, 1e37, 3e38])
def test_a_mean_does_not_depend_on_the_size_of_weights(size: float, splat: str) -> None:
    pixels = torch.tensor([[0.0, 0.0], [0.0, 0.0], [2.0, 0.0]], requires_grad=True)
    depth = torch.tensor([1.0, 3.0, 5.0], requires_grad=True)
    weights = torch.full((3,), size).requires_grad_(True)
    sparse = rasterize_depth(
        pixels, depth, image_size=(1, 3), weights=weights, reduce="mean", splat=splat
    )
    assert_close(sparse.depth.flatten(), torch.tensor([2.0, 0, 5]))
    assert sparse.weight.isfinite().all() and (sparse.weight > 0).sum() == 2
    inputs = (depth, weights) if splat == "pixel" else (pixels, depth, weights)
    for gradient in torch.autograd.grad(sparse.depth.sum(), inputs):
        assert gradient.isfinite().all()


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_are_right(kind: tuple[str, str]) -> None:
    generator = torch.Generator().manual_seed(0)
    pixels = 0.3 + 3 * torch.rand(6, 2, generator=generator, dtype=torch.float64)
    depth = torch.arange(1.0, 7).double().requires_grad_()
    weights = (0.5 + torch.rand(6, generator=generator, dtype=torch.float64)).requires_grad_()

    def image(depth: Tensor, weights: Tensor) -> tuple[Tensor, ...]:
        return tuple(rasterize(pixels, depth, weights, kind))

    assert torch.autograd.gradcheck(image, (depth, weights))
    if kind == ("mean", "bilinear"):

        def moved(pixels: Tensor) -> tuple[Tensor, ...]:
            return tuple(rasterize(pixels, depth.detach(), weights.detach(), kind))

        assert torch.autograd.gradcheck(moved, (pixels.requires_grad_(),))


def test_depths_that_float32_cannot_tell_apart_are_told_apart() -> None:
    depth = torch.tensor([2.0 + 1e-12, 2.0]).double()
    sparse = rasterize_depth(torch.zeros(2, 2).double(), depth, image_size=(1, 1))
    assert sparse.depth.item() == 2.0


def test_ties_go_to_the_first_and_it_alone_gets_the_gradient() -> None:
    depth = torch.tensor([3.0, 2.0, 2.0], requires_grad=True)
    weights = torch.tensor([1.0, 4.0, 5.0])
    sparse = rasterize_depth(torch.zeros(3, 2), depth, image_size=(1, 1), weights=weights)
    assert (sparse.depth.item(), sparse.weight.item()) == (2, 4)
    assert torch.autograd.grad(sparse.depth.sum(), depth)[0].tolist() == [0, 1, 0]


def test_a_pixel_owns_half_a_pixel_around_its_centre() -> None:
    pixels = torch.tensor([[-0.5, 0.0], [0.49, 0.0], [0.5, 0.0], [-0.51, 0.0]])
    sparse = rasterize_depth(pixels, torch.arange(1.0, 5), image_size=(1, 2))
    assert sparse.depth.tolist() == [[[1.0, 3.0]]]
