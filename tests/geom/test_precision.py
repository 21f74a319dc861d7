"""What operations compute in: the dtypes they are given, whatever autocast says."""

import pytest
import torch
from operations import METHODS, OPERATIONS, RANGE, SIZE, chosen, inputs_in, is_real, tensors_of
from torch import Tensor
from torch.testing import assert_close

import deltas_geom as geom
from deltas_geom.numerics.arithmetic import promoted, without_autocast

ALL = OPERATIONS | METHODS


@pytest.mark.parametrize("name", ALL)
def test_autocast_changes_no_bit_of_any_operation(name: str, dtype: torch.dtype) -> None:
    given = chosen(ALL[name], inputs_in(dtype))
    wanted = tensors_of(ALL[name](**given))
    with torch.autocast("cpu", torch.bfloat16):
        found = tensors_of(ALL[name](**given))
        assert torch.is_autocast_enabled("cpu")  # it is the caller's, after as before
    for ours, theirs in zip(found, wanted, strict=True):
        assert ours.dtype == theirs.dtype and torch.equal(ours, theirs)


# Ends of segments lie on the image's edge, where rounding decides what is in it.
AT_EDGES = {"sample_segments", "sample_segments, pixels", "EpipolarSampler", "correlate, lines"}


@pytest.mark.parametrize("name", ALL)
def test_dtypes_may_be_mixed(name: str) -> None:
    given = chosen(ALL[name], inputs_in(torch.float32))
    wanted = tensors_of(ALL[name](**given))
    for field in [field for field in given if is_real(given[field])]:
        found = tensors_of(ALL[name](**given | {field: given[field].double()}))
        for ours, theirs in zip(found, wanted, strict=True):
            assert ours.shape == theirs.shape
            if not ours.is_floating_point():
                assert name in AT_EDGES or torch.equal(ours, theirs)
                continue
            assert ours.dtype in (torch.float32, torch.float64) and ours.isfinite().all()
            if name in AT_EDGES:
                continue
            size = float(theirs.detach().abs().max())
            assert_close(ours.float(), theirs, rtol=0, atol=1e-3 * max(size, 0.1))


def cameras_and_points() -> tuple[Tensor, ...]:
    return tuple(inputs_in(torch.float32)[name] for name in ("K", "poses", "points"))


def test_what_is_mixed_is_promoted() -> None:
    half, single = torch.ones(2, dtype=torch.bfloat16), torch.ones(2)
    assert [t.dtype for t in promoted(half, single)] == [torch.float32] * 2
    assert [t.dtype for t in promoted(half, half.half())] == [torch.float32] * 2
    assert [t.dtype for t in promoted(torch.ones(2, dtype=torch.int64), half)] == [half.dtype] * 2
    K, poses, points = cameras_and_points()
    views = geom.PosedViews(K.double(), poses)
    assert views.proj.dtype == torch.float64
    assert geom.project(views, points).pixels.dtype == torch.float64
    single = geom.PosedViews(K, poses)
    assert geom.project(single, points.double()).depth.dtype == torch.float64
    pixels = geom.project(single, points).pixels.half().requires_grad_()
    found = geom.triangulate_points(single.proj, pixels)
    assert torch.equal(found, geom.triangulate_points(single.proj, pixels.float()))
    assert torch.autograd.grad(found.sum(), pixels)[0].dtype == torch.float16


def there_and_back(K: Tensor, cam_from_world: Tensor, points: Tensor) -> Tensor:
    views = geom.PosedViews(K, cam_from_world)
    pixels = geom.project(views, points).pixels
    segments = geom.epipolar_segments(views, pixels[0], depth_range=RANGE, image_size=SIZE)
    seen = geom.unproject(views, pixels, geom.project(views, points).depth).mean(dim=0)
    return seen + 0 * segments.start.sum() + geom.triangulate_points(views.proj, pixels)


def test_traced_as_one_graph_or_transformed_it_stays_outside_autocast() -> None:
    inputs = cameras_and_points()
    wanted = there_and_back(*inputs)
    torch.compiler.reset()
    traced = torch.compile(there_and_back, fullgraph=True, backend="aot_eager")
    with torch.autocast("cpu", torch.bfloat16):
        cast = traced(*inputs)
        mapped = torch.func.vmap(there_and_back, in_dims=(None, None, 0))(
            *inputs[:2], inputs[2].expand(2, *inputs[2].shape)
        )
        pushed = torch.func.jvp(lambda p: there_and_back(*inputs[:2], p), inputs[2:], inputs[2:])
    for found in (cast, mapped[0], pushed[0]):
        assert found.dtype == torch.float32
        assert_close(found, wanted, rtol=0, atol=1e-5)  # m
    torch.compiler.reset()


def test_without_autocast_a_graph_holds_no_region_of_it() -> None:
    # Such a region could not be loaded again.
    class Pixels(torch.nn.Module):
        def forward(self, K: Tensor, cam_from_world: Tensor, points: Tensor) -> Tensor:
            return geom.project(geom.PosedViews(K, cam_from_world), points).pixels

    inputs = cameras_and_points()
    names = [str(node.target) for node in torch.export.export(Pixels(), inputs).graph.nodes]
    assert names and not any("autocast" in name for name in names)


def test_what_has_no_tensor_or_no_autocast_is_left_to_the_operation() -> None:
    @without_autocast
    def kind(value: object, *, other: object = None) -> str:
        return type(value).__name__

    assert kind(3) == "int" and kind([]) == "list" and kind((), other=torch.ones(1)) == "tuple"
    assert kind(torch.ones(1, device="meta")) == "Tensor"
    assert kind.__name__ == "kind"


def test_what_half_precision_cannot_hold_is_its_largest_number() -> None:
    pixels = torch.tensor([[6e4, -6e4], [torch.nan, torch.inf]], dtype=torch.float16)
    twice = geom.resize_pixels(pixels, old_size=(4, 4), new_size=(8, 8))
    wanted = torch.tensor([[65504.0, -65504.0], [torch.nan, torch.inf]], dtype=torch.float16)
    assert_close(twice, wanted, rtol=0, atol=0, equal_nan=True)
