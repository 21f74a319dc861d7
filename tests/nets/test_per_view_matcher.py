"""Reading descriptors and multiplying them: the values of correlating first."""

from typing import NamedTuple

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch.testing import assert_close

from deltas_geom import Samples, correlate
from deltas_geom.testing.strategies import image_pixels, vectors
from deltas_nets.cost.operations import OperationCounter
from deltas_nets.network.paper.per_view_matcher import read_and_multiply

SIZE = (24, 32)  # of the image, px; the map has stride 4
CELLS = (6, 8)


class Scene(NamedTuple):
    """What is multiplied: ``(B, N, D)``, ``(B, V-1, D, h, w)``, and places in the sources."""

    descriptors: Tensor
    feature_map: Tensor
    samples: Samples


@st.composite
def scenes(draw: st.DrawFn) -> Scene:
    """A keypoint or more of a batch of views, some samples masked or beyond the border."""
    batch, views, keypoints, lines, places, dim = (draw(st.integers(1, 3)) for _ in range(6))
    count = batch * views * keypoints * lines * places
    shape = (batch, views, keypoints, lines, places)
    mask = torch.tensor(draw(st.lists(st.booleans(), min_size=count, max_size=count)))
    pixels = draw(image_pixels(count, image_size=SIZE))
    maps = draw(vectors(batch * views * dim, within=1.0, size=CELLS[0] * CELLS[1]))
    return Scene(
        draw(vectors(batch * keypoints, within=1.0, size=dim)).reshape(batch, keypoints, dim),
        maps.reshape(batch, views, dim, *CELLS),
        samples_at(pixels.reshape(*shape, 2), mask.reshape(shape)),
    )


def random_scene(
    dtype: torch.dtype = torch.float32,
    *,
    keypoints: int = 40,
    cells: tuple[int, int] = CELLS,
    dim: int = 8,
) -> Scene:
    """Two rooms of two sources each; a tenth of the samples is masked."""
    generator = torch.Generator().manual_seed(0)
    shape = (2, 2, keypoints, 3, 20)
    extent = torch.tensor([SIZE[1], SIZE[0]], dtype=dtype)
    pixels = (1.2 * torch.rand(*shape, 2, generator=generator, dtype=dtype) - 0.1) * extent
    return Scene(
        torch.randn(2, keypoints, dim, generator=generator, dtype=dtype),
        torch.randn(2, 2, dim, *cells, generator=generator, dtype=dtype),
        samples_at(pixels, torch.rand(shape, generator=generator) < 0.9),
    )


def samples_at(pixels: Tensor, mask: Tensor) -> Samples:
    return Samples(pixels, pixels[..., 0, :, 0], mask)


def assert_as_correlated(scene: Scene, *, atol: float) -> None:
    """Values, and gradients of both factors and of the places."""
    descriptors, feature_map, samples = scene
    descriptors, feature_map = descriptors.requires_grad_(), feature_map.requires_grad_()
    leaves = (descriptors, feature_map, samples.pixels.requires_grad_())
    found, wanted = (
        function(descriptors, feature_map, samples, image_size=SIZE)
        for function in (read_and_multiply, correlate)
    )
    assert found.dtype == wanted.dtype
    assert_close(found, wanted, rtol=0, atol=atol)
    weights = torch.linspace(-1, 1, found.numel(), dtype=found.dtype).reshape(found.shape)
    for ours, theirs in zip(
        torch.autograd.grad((weights * found).sum(), leaves),
        torch.autograd.grad((weights * wanted).sum(), leaves),
        strict=True,
    ):
        assert_close(ours, theirs, rtol=0, atol=20 * atol)


@given(scene=scenes())
def test_reading_then_multiplying_is_correlating_then_reading(scene: Scene) -> None:
    assert_as_correlated(scene, atol=1e-12)


def test_many_samples_of_many_channels_in_both_dtypes(dtype: torch.dtype) -> None:
    scene = random_scene(dtype, keypoints=300, dim=64)
    assert_as_correlated(scene, atol=1e-4 if dtype == torch.float32 else 1e-12)


def test_a_masked_sample_is_nothing_wherever_it_is() -> None:
    descriptors, feature_map, samples = random_scene(torch.float64)
    pixels = samples.pixels.masked_fill(~samples.mask[..., None], torch.nan).requires_grad_()
    leaves = (descriptors.requires_grad_(), feature_map.requires_grad_())
    found = read_and_multiply(*leaves, samples._replace(pixels=pixels), image_size=SIZE)
    assert (found[~samples.mask] == 0).all() and (found[samples.mask] != 0).all()
    gradients = torch.autograd.grad(found.square().sum(), (*leaves, pixels))
    assert all(gradient.isfinite().all() for gradient in gradients)
    assert (gradients[2][~samples.mask] == 0).all()
    # What only masked samples see has no say.
    nothing = samples._replace(mask=torch.zeros_like(samples.mask))
    for gradient in torch.autograd.grad(
        read_and_multiply(*leaves, nothing, image_size=SIZE).sum(), leaves
    ):
        assert (gradient == 0).all()


@pytest.mark.parametrize("empty", ["batch", "keypoints"])
def test_nothing_to_multiply_is_no_error(empty: str) -> None:
    batch, sources, keypoints = 0 if empty == "batch" else 2, 2, 0 if empty == "keypoints" else 2
    shape = (batch, sources, keypoints, 3, 5)
    samples = samples_at(torch.zeros(*shape, 2), torch.ones(shape, dtype=torch.bool))
    maps = torch.zeros(batch, sources, 4, *CELLS, requires_grad=True)
    found = read_and_multiply(torch.zeros(batch, keypoints, 4), maps, samples, image_size=SIZE)
    assert found.shape == shape
    (gradient,) = torch.autograd.grad(found.sum(), maps, allow_unused=True)
    assert gradient is None or (gradient == 0).all()


def test_half_precision_around_it_changes_nothing() -> None:
    descriptors, feature_map, samples = random_scene()
    leaves = (descriptors.requires_grad_(), feature_map.requires_grad_())
    plain = read_and_multiply(*leaves, samples, image_size=SIZE)
    wanted = torch.autograd.grad(plain.square().sum(), leaves)
    with torch.autocast("cpu", torch.bfloat16):
        mixed = read_and_multiply(*leaves, samples, image_size=SIZE)
        found = torch.autograd.grad(mixed.square().sum(), leaves)
    for ours, expected in zip((mixed, *found), (plain, *wanted), strict=True):
        assert_close(ours, expected, rtol=0, atol=0)
    half, coarse = (leaf.detach().bfloat16() for leaf in leaves)
    read = read_and_multiply(half, coarse, samples, image_size=SIZE)
    full = read_and_multiply(half.float(), coarse.float(), samples, image_size=SIZE)
    assert read.dtype == torch.float32
    assert_close(read, full, rtol=0, atol=0)


def test_backward_keeps_only_the_inputs() -> None:
    descriptors, feature_map, samples = random_scene(keypoints=300, dim=64)
    leaves = (descriptors.requires_grad_(), feature_map.requires_grad_())
    kept: dict[int, int] = {}

    def keep(tensor: Tensor) -> Tensor:
        storage = tensor.untyped_storage()
        kept[storage.data_ptr()] = storage.nbytes()
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        read_and_multiply(*leaves, samples, image_size=SIZE)
    for tensor in (*leaves, samples.pixels, samples.mask):
        kept.pop(tensor.untyped_storage().data_ptr(), None)
    assert not kept


@pytest.mark.parametrize("cells", [(6, 8), (12, 16)])
def test_products_are_those_of_the_samples_whatever_the_map(cells: tuple[int, int]) -> None:
    descriptors, feature_map, samples = random_scene(cells=cells)
    with torch.no_grad(), OperationCounter() as counter:
        read_and_multiply(descriptors, feature_map, samples, image_size=SIZE)
    assert counter.total().products == 2 * samples.mask.numel() * descriptors.shape[-1]
