"""Correlation first, sampling second: the same answers as the other way round."""

import shutil
from collections.abc import Callable

import pytest
import torch
import torch.nn.functional as F
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch.testing import assert_close

from deltas_geom import (
    Samples,
    ShapeError,
    correlate,
    correlate_normalized,
    sample_map,
)
from deltas_geom.matching import correlation
from deltas_geom.testing.strategies import image_pixels, vectors

SIZE = (24, 32)  # of the image, px; the map has stride 4
Correlation = Callable[..., Tensor]
BOTH = pytest.mark.parametrize("function", [correlate, correlate_normalized])


def samples_at(pixels: Tensor, mask: Tensor | None = None) -> Samples:
    """Samples ``(*B, V, N, O=1, S)`` at pixels ``(*B, V, N, S, 2)``."""
    places = pixels.unsqueeze(-3)
    every = torch.ones(places.shape[:-1], dtype=torch.bool)
    return Samples(places, places.select(-3, 0)[..., 0], every if mask is None else mask)


def sampled(
    descriptors: Tensor, feature_map: Tensor, pixels: Tensor, *, normalized: bool = False
) -> Tensor:
    """The same by reading all channels: ``(V, N, 1, S)`` of pixels ``(V, N, S, 2)``."""
    read = sample_map(feature_map, pixels.flatten(1, 2), image_size=SIZE)
    read = F.normalize(read, dim=-1, eps=1e-30) if normalized else read
    read = read.unflatten(1, pixels.shape[1:3])
    return (descriptors[:, None] * read).sum(dim=-1).unsqueeze(-2)


@st.composite
def scenes(draw: st.DrawFn) -> tuple[Tensor, Tensor, Tensor]:
    """Descriptors ``(5, 3)``, a map ``(1, 3, 6, 8)`` of lengths over 1, pixels ``(1, 5, 2, 2)``."""
    features = draw(vectors(48, within=1.0)).mT.reshape(1, 3, 6, 8)
    features[:, 0] += 2  # so that no two neighbours cancel
    pixels = draw(image_pixels(10, image_size=SIZE)).reshape(1, 5, 2, 2)
    return draw(vectors(5, within=1.0)), features, pixels


def random_scene(
    dtype: torch.dtype = torch.float64, *, count: int = 3, size: tuple[int, int] = (4, 5)
) -> tuple[Tensor, Tensor, Tensor]:
    """Two sources, two samples a keypoint, some of them beyond the border."""
    generator = torch.Generator().manual_seed(0)
    descriptors = torch.randn(count, 3, generator=generator, dtype=dtype)
    features = torch.randn(2, 3, *size, generator=generator, dtype=dtype)
    pixels = torch.rand(2, count, 2, 2, generator=generator, dtype=dtype)
    extent = torch.tensor([SIZE[1], SIZE[0]], dtype=dtype)
    return descriptors, features, (1.2 * pixels - 0.1) * extent


@BOTH
def test_wrong_arguments_are_named(function: Correlation) -> None:
    samples = samples_at(torch.zeros(1, 5, 1, 2))
    with pytest.raises(ShapeError, match="descriptors"):
        function(torch.zeros(3), torch.zeros(1, 3, 4, 4), samples, image_size=(4, 4))
    with pytest.raises(ShapeError, match="feature_map has D = 3 but descriptors has D = 2"):
        function(torch.zeros(5, 2), torch.zeros(1, 3, 4, 4), samples, image_size=(4, 4))


@given(scene=scenes())
def test_correlating_then_sampling_is_sampling_then_correlating(
    scene: tuple[Tensor, Tensor, Tensor],
) -> None:
    descriptors, features, pixels = scene
    scores = correlate(descriptors, features, samples_at(pixels), image_size=SIZE)
    assert_close(scores, sampled(descriptors, features, pixels), rtol=0, atol=1e-12)


@given(scene=scenes())
def test_lengths_are_those_of_the_sampled_features(scene: tuple[Tensor, Tensor, Tensor]) -> None:
    for dtype, atol in ((torch.float64, 1e-12), (torch.float32, 1e-5)):
        descriptors, features, pixels = (part.to(dtype) for part in scene)
        scores = correlate_normalized(descriptors, features, samples_at(pixels), image_size=SIZE)
        wanted = sampled(descriptors, features, pixels, normalized=True)
        assert_close(scores, wanted, rtol=0, atol=atol)


@BOTH
@given(scene=scenes(), drawn=vectors(5, within=1.0, size=2))
def test_what_is_masked_may_lie_anywhere(
    function: Correlation, scene: tuple[Tensor, Tensor, Tensor], drawn: Tensor
) -> None:
    descriptors, features, pixels = scene
    mask = (drawn > 0)[None, :, None]
    leaves = [descriptors.requires_grad_(), features.requires_grad_(), pixels.requires_grad_()]
    results = []
    for elsewhere in (0.0, torch.nan, torch.inf):
        places = torch.where(mask.squeeze(-2)[..., None], pixels, elsewhere)
        scores = function(descriptors, features, samples_at(places, mask), image_size=SIZE)
        results.append((scores, *torch.autograd.grad(scores.sum(), leaves)))
        assert (scores[~mask] == 0).all()
        assert (results[-1][3][~mask.squeeze(-2)] == 0).all()
        for found, wanted in zip(results[-1], results[0], strict=True):
            assert_close(found, wanted, rtol=0, atol=0)


@BOTH
def test_a_mask_may_lack_dims_and_hides_what_is_no_number(
    function: Correlation, dtype: torch.dtype
) -> None:
    descriptors, features, pixels = random_scene(dtype)
    every = function(descriptors, features, samples_at(pixels), image_size=SIZE)
    generator = torch.Generator().manual_seed(1)
    for shape in ((), (2,), (3, 1, 1), (2, 1, 1, 2), (4, 1, 3, 1, 2)):
        mask = torch.rand(shape, generator=generator) < 0.5
        samples = samples_at(pixels, mask)
        found = function(descriptors, features, samples, image_size=SIZE)
        assert_close(found, torch.where(mask, every, 0.0))
        for value in (torch.nan, torch.inf):
            unknown = torch.full_like(features, value)
            assert (function(descriptors, unknown, samples, image_size=SIZE) == 0)[
                ~mask.expand_as(found)
            ].all()


@pytest.mark.parametrize("normalized", [False, True])
def test_gradients_are_those_of_sampling_all_channels(dtype: torch.dtype, normalized: bool) -> None:
    leaves = [part.requires_grad_() for part in random_scene(dtype, count=300, size=(6, 8))]
    function = correlate_normalized if normalized else correlate
    ours = function(*leaves[:2], samples_at(leaves[2]), image_size=SIZE)
    wanted = sampled(*leaves, normalized=normalized)
    weights = torch.linspace(-1, 1, ours.numel(), dtype=dtype).reshape(ours.shape)
    tolerance = 1e-5 if dtype == torch.float32 else 1e-12
    assert_close(ours, wanted, rtol=tolerance, atol=tolerance)
    for found, expected in zip(
        torch.autograd.grad((weights * ours).sum(), leaves),
        torch.autograd.grad((weights * wanted).sum(), leaves),
        strict=True,
    ):
        # Relative to the largest: where neighbours nearly cancel, both lose digits.
        assert (found - expected).abs().max() <= 100 * tolerance * expected.abs().max()


@BOTH
@pytest.mark.parametrize("limit", [1, 100, 500, 2000])
@pytest.mark.parametrize("batch", [(), (5,), (3, 2)])
def test_pieces_of_any_size_make_the_whole(
    function: Correlation, batch: tuple[int, ...], limit: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By groups of views, view by view, or by chunks of keypoints, as memory allows."""
    descriptors, features, pixels = random_scene(count=40)
    generator = torch.Generator().manual_seed(1)

    def varied(tensor: Tensor) -> Tensor:
        scale = 1 + 0.1 * torch.rand(*batch, *[1] * tensor.ndim, generator=generator)
        return (scale.to(tensor.dtype) * tensor).requires_grad_()

    inputs = [varied(descriptors), varied(features)]
    samples = samples_at(varied(pixels))
    pull = torch.randn(*batch, 2, 40, 1, 2, generator=generator, dtype=torch.float64)

    def outcome() -> tuple[Tensor, ...]:
        found = function(*inputs, samples, image_size=SIZE)
        return found, *torch.autograd.grad((found * pull).sum(), inputs)

    whole = outcome()
    monkeypatch.setattr("deltas_geom.matching.correlation._CACHED_ELEMENTS", limit)
    for piece, expected in zip(outcome(), whole, strict=True):
        assert_close(piece, expected, rtol=0, atol=1e-11)


@given(
    st.lists(st.integers(1, 4), max_size=2),
    st.integers(1, 60),
    st.integers(1, 9),
    st.integers(1, 9),
)
def test_no_piece_holds_more_than_the_limit(
    batch: list[int], count: int, elements: int, tens: int
) -> None:
    """But for the fewest keypoints that are worth a call."""
    held = []

    def record(maps: Tensor, keypoints: Tensor) -> Tensor:
        held.append(keypoints.numel() * elements)
        return keypoints

    keypoints = torch.rand(*batch, count)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(correlation, "_CACHED_ELEMENTS", 10 * tens)
        whole = correlation._in_pieces(
            record, torch.zeros(*batch, 3, 1, 1), keypoints, elements=elements
        )
    assert torch.equal(whole, keypoints)
    assert max(held) <= max(10 * tens, 16 * elements)


@BOTH
def test_first_and_second_derivatives_are_right(function: Correlation) -> None:
    mask = torch.rand(2, 3, 1, 2, generator=torch.Generator().manual_seed(1)) < 0.8

    def score(descriptors: Tensor, features: Tensor, pixels: Tensor) -> Tensor:
        return function(descriptors, features, samples_at(pixels, mask), image_size=SIZE)

    leaves = tuple(part.requires_grad_() for part in random_scene())
    fixed = (*leaves[:2], leaves[2].detach())
    for inputs in (leaves, fixed):
        assert torch.autograd.gradcheck(score, inputs)
        assert torch.autograd.gradgradcheck(score, inputs, fast_mode=True)


@BOTH
def test_backward_keeps_only_the_inputs(function: Correlation) -> None:
    descriptors, features, pixels = random_scene(torch.float32, count=200, size=(60, 80))
    samples = samples_at(pixels)
    leaves = [descriptors.requires_grad_(), features.requires_grad_()]
    kept: dict[int, int] = {}

    def count(tensor: Tensor) -> Tensor:
        kept[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage().nbytes()
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(count, lambda tensor: tensor):
        scores = function(descriptors, features, samples, image_size=SIZE)
    for tensor in (*leaves, pixels, samples.mask):
        kept.pop(tensor.untyped_storage().data_ptr(), None)
    # Beside them the normalised scores keep both factors, and nine numbers a pixel of the map.
    table = 9 * features[:, 0].numel() * 4
    extra = 0 if function is correlate else 2 * scores.numel() * 4 + table
    assert sum(kept.values()) <= extra


@BOTH
def test_vmap_and_jacrev_agree_with_plain_calls(function: Correlation) -> None:
    descriptors, features, pixels = random_scene()

    def score(descriptors: Tensor, features: Tensor, pixels: Tensor) -> Tensor:
        return function(descriptors, features, samples_at(pixels[None]), image_size=SIZE)

    # Keypoints shared, a map and pixels for each of two.
    mapped = torch.func.vmap(score, in_dims=(None, 0, 0))(descriptors, features[:, None], pixels)
    plain = function(descriptors, features, samples_at(pixels), image_size=SIZE)
    assert_close(mapped.squeeze(1), plain, rtol=0, atol=1e-12)
    inputs = (descriptors, features[:1], pixels[0])
    wanted = torch.autograd.functional.jacobian(score, inputs)
    for found, expected in zip(
        torch.func.jacrev(score, argnums=(0, 1, 2))(*inputs), wanted, strict=True
    ):
        assert_close(found, expected, rtol=0, atol=1e-10)
    per_map = torch.func.vmap(torch.func.jacrev(score, argnums=2), in_dims=(None, 0, 0))
    found = per_map(descriptors, features[:, None], pixels)[0]
    assert_close(found, wanted[2], rtol=0, atol=1e-10)

    # The other nesting: an inner vmap hides from the outer derivative what it is taken of.
    def mapped_score(pixels: Tensor) -> Tensor:
        return torch.func.vmap(score, in_dims=(None, 0, 0))(descriptors, features[:, None], pixels)

    found = torch.func.jacrev(mapped_score)(pixels)
    assert_close(found[0, ..., 0, :, :, :], wanted[2], rtol=0, atol=1e-10)


NEEDS_COMPILER = pytest.mark.skipif(
    shutil.which("g++") is None, reason="torch.compile needs a C++ compiler"
)


# What torch.compile does before a compiler sees the graph is what may break.
@pytest.mark.parametrize(
    "backend",
    ["aot_eager", pytest.param("inductor", marks=(NEEDS_COMPILER, pytest.mark.slow))],
)
def test_both_compile_without_a_graph_break(backend: str) -> None:
    *leaves, pixels = random_scene()
    leaves = [leaf.requires_grad_() for leaf in leaves]

    def score(descriptors: Tensor, features: Tensor) -> Tensor:
        pair = (
            function(descriptors, features, samples_at(pixels), image_size=SIZE)
            for function in (correlate, correlate_normalized)
        )
        return sum(scores.square().sum() for scores in pair)

    compiled = torch.compile(score, fullgraph=True, backend=backend)
    found = torch.autograd.grad(compiled(*leaves), leaves)
    for ours, wanted in zip(found, torch.autograd.grad(score(*leaves), leaves), strict=True):
        assert_close(ours, wanted, rtol=1e-9, atol=1e-9)


@BOTH
def test_it_exports_for_any_number_of_keypoints(function: Correlation) -> None:
    class Score(torch.nn.Module):
        def forward(self, descriptors: Tensor, features: Tensor, pixels: Tensor) -> Tensor:
            return function(descriptors, features, samples_at(pixels), image_size=SIZE)

    keypoints = torch.export.Dim("keypoints", min=2, max=4096)
    exported = torch.export.export(
        Score(), random_scene(count=3), dynamic_shapes=({0: keypoints}, None, {1: keypoints})
    )
    scene = random_scene(count=7)
    assert_close(exported.module()(*scene), Score()(*scene))


@BOTH
def test_autocast_around_it_does_not_move_the_samples(function: Correlation) -> None:
    descriptors, features, pixels = random_scene(torch.float32, size=(60, 80))
    leaves = [descriptors.requires_grad_(), features.requires_grad_()]
    plain = function(*leaves, samples_at(pixels), image_size=SIZE)
    wanted = torch.autograd.grad(plain.square().sum(), leaves)
    with torch.autocast("cpu", torch.bfloat16):
        mixed = function(*leaves, samples_at(pixels), image_size=SIZE)
        found = torch.autograd.grad(mixed.square().sum(), leaves)
    for ours, expected in zip((mixed, *found), (plain, *wanted), strict=True):
        assert_close(ours, expected, rtol=0, atol=0)


def test_features_that_cancel_have_no_direction(dtype: torch.dtype) -> None:
    one = torch.tensor([0.6, -0.3, 1.7], dtype=dtype)
    row = torch.stack([one, -one, torch.zeros_like(one)], dim=-1).reshape(1, 3, 1, 3)
    features = row.requires_grad_()
    places = torch.tensor([[0.5, 0.0], [2.0, 0.0], [0.0, 0.0]], dtype=dtype).requires_grad_()
    descriptors = one[None].clone().requires_grad_()
    scores = correlate_normalized(
        descriptors, features, samples_at(places[None, None]), image_size=(1, 3)
    )
    assert_close(scores[0, 0, 0], torch.stack([one[0] * 0, one[0] * 0, one.norm()]))
    for gradient in torch.autograd.grad(scores[..., :2].sum(), (descriptors, features, places)):
        assert (gradient == 0).all()


@BOTH
def test_a_map_of_one_pixel_is_everywhere_the_same(function: Correlation) -> None:
    descriptors, features, pixels = random_scene(size=(1, 1))
    scores = function(descriptors, features, samples_at(pixels), image_size=SIZE)
    wanted = sampled(descriptors, features, pixels, normalized=function is correlate_normalized)
    assert_close(scores, wanted, rtol=0, atol=1e-12)
