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


def rasterize(cloud: tuple[Tensor, Tensor, Tensor], kind: tuple[str, str]) -> SparseDepth:
    pixels, depth, weights = cloud
    reduce, splat = kind
    return rasterize_depth(
        pixels,
        depth,
        image_size=SIZE,
        weights=weights,
        reduce=reduce,  # type: ignore[arg-type]
        splat=splat,  # type: ignore[arg-type]
    )


def front_splat(
    pixels: Tensor, depth: Tensor, weights: Tensor, image_size: tuple[int, int]
) -> tuple[Tensor, Tensor]:
    found = rasterize_depth(pixels, depth, image_size=image_size, weights=weights, splat="bilinear")
    return found.depth[0], found.weight[0]


FRONT_SPLAT = Target("front, bilinear", splat=front_splat)


def test_wrong_arguments_are_named() -> None:
    pixels, depth = torch.zeros(5, 2), torch.ones(5)
    with pytest.raises(ShapeError, match="depth has N = 4 but pixels has N = 5"):
        rasterize_depth(pixels, depth[:4], image_size=SIZE)
    with pytest.raises(ValueError, match="image_size"):
        rasterize_depth(pixels, depth, image_size=(0, 5))
    with pytest.raises(ValueError, match="reduce must be"):
        rasterize_depth(pixels, depth, image_size=SIZE, reduce="back")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="splat must be"):
        rasterize_depth(pixels, depth, image_size=SIZE, splat="cubic")  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["weights", "mask"])
@pytest.mark.parametrize("shape", [(6, 1), (1,), (5,), (), (2, 6, 1)], ids=str)
def test_weights_and_mask_are_one_for_each_point(name: str, shape: tuple[int, ...]) -> None:
    wrong = torch.ones(shape, dtype=torch.bool if name == "mask" else torch.float32)
    arguments: dict[str, Any] = {name: wrong}
    with pytest.raises(ShapeError, match=rf"{name} (has N|must have shape \(\*B, N\))"):
        rasterize_depth(torch.zeros(6, 2), torch.ones(6), image_size=SIZE, **arguments)


@pytest.mark.parametrize("name", ["pixels", "depth", "weights", "mask"])
def test_batch_dims_that_do_not_broadcast_are_named(name: str) -> None:
    arguments: dict[str, Any] = {
        "pixels": torch.zeros(2, 6, 2),
        "depth": torch.ones(2, 6),
        "weights": torch.ones(2, 6),
        "mask": torch.ones(2, 6, dtype=torch.bool),
    }
    arguments[name] = torch.cat([arguments[name], arguments[name][:1]])
    with pytest.raises(ShapeError, match="leading batch dims must broadcast"):
        rasterize_depth(image_size=SIZE, **arguments)


def test_a_number_is_no_weights() -> None:
    with pytest.raises(TypeError, match=r"weights must be a torch\.Tensor, got float"):
        rasterize_depth(torch.zeros(6, 2), torch.ones(6), image_size=SIZE, weights=2.0)  # type: ignore[arg-type]


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_vmap_is_a_batch_dim_and_traced_as_one_graph_it_is_the_same(kind: tuple[str, str]) -> None:
    generator = torch.Generator().manual_seed(0)
    pixels = 4 * torch.rand(3, 6, 2, generator=generator)
    depth = 1 + torch.rand(3, 6, generator=generator)
    weights = torch.linspace(0.5, 1, 6)

    def image(pixels: Tensor, depth: Tensor) -> Tensor:
        reduce, splat = kind
        return rasterize_depth(
            pixels,
            depth,
            image_size=SIZE,
            weights=weights,
            mask=depth > 1.1,
            reduce=reduce,  # type: ignore[arg-type]
            splat=splat,  # type: ignore[arg-type]
        ).depth

    wanted = image(pixels, depth)
    assert wanted.shape == (3, 1, *SIZE) and (wanted > 0).any()
    assert_close(torch.func.vmap(image)(pixels, depth), wanted)
    torch.compiler.reset()
    traced = torch.compile(image, fullgraph=True, backend="aot_eager")
    assert_close(traced(pixels, depth), wanted)
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
    wanted = rasterize((pixels[rest], depth[rest], weights[rest]), kind)
    for spoilt, value in ((pixels, torch.nan), (depth, torch.inf), (weights, torch.nan)):
        spoilt[unused] = value
        inputs = [tensor.clone().requires_grad_() for tensor in (pixels, depth, weights)]
        reduce, splat = kind
        found = rasterize_depth(
            inputs[0],
            inputs[1],
            image_size=SIZE,
            weights=inputs[2],
            mask=rest,
            reduce=reduce,  # type: ignore[arg-type]
            splat=splat,  # type: ignore[arg-type]
        )
        assert_close(found.depth, wanted.depth, rtol=0, atol=1e-12)
        unmasked = rasterize((inputs[0], inputs[1], inputs[2]), kind)
        assert_close(unmasked.weight, wanted.weight, rtol=0, atol=1e-12)
        total = unmasked.depth.sum() + unmasked.weight.sum()
        for gradient in torch.autograd.grad(total, inputs, allow_unused=True):
            if gradient is not None:
                assert gradient.isfinite().all() and (gradient[unused] == 0).all()


def test_a_share_below_rounding_is_no_share() -> None:
    pixels = torch.tensor([[0.0, 0.0], [0.0, 1e-30]], requires_grad=True)
    depth = torch.tensor([1.0, 3e4], requires_grad=True)
    weights = torch.tensor([1.8e4, 1.0], requires_grad=True)
    sparse = rasterize((pixels, depth, weights), ("mean", "bilinear"))
    assert (sparse.weight > 0).sum() == 1
    total = sparse.depth.sum() + sparse.weight.sum()
    for gradient in torch.autograd.grad(total, (pixels, depth, weights)):
        assert gradient.isfinite().all()


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_are_right(kind: tuple[str, str]) -> None:
    generator = torch.Generator().manual_seed(0)
    pixels = 0.3 + 3 * torch.rand(6, 2, generator=generator, dtype=torch.float64)
    depth = torch.arange(1.0, 7).double().requires_grad_()
    weights = (0.5 + torch.rand(6, generator=generator, dtype=torch.float64)).requires_grad_()

    def image(depth: Tensor, weights: Tensor) -> tuple[Tensor, ...]:
        return tuple(rasterize((pixels, depth, weights), kind))

    assert torch.autograd.gradcheck(image, (depth, weights))
    if kind == ("mean", "bilinear"):

        def moved(pixels: Tensor) -> tuple[Tensor, ...]:
            return tuple(rasterize((pixels, depth.detach(), weights.detach()), kind))

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
