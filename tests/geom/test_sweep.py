"""What holds of every public function, whatever it is given."""

import inspect

import numpy as np
import pytest
import torch
from operations import METHODS, OPERATIONS, Inputs, chosen, followed, inputs_in, is_real, tensors_of
from torch import Tensor
from torch.testing import assert_close

import deltas_geom as geom

HALF = (torch.float16, torch.bfloat16)
INTEGERS = (torch.int8, torch.int16, torch.int32, torch.int64, torch.uint8)
# What only rewrites an item keeps what is NaN in it, for whatever uses the item next to tell.
REWRITES = {
    "camera_centers",
    "crop_intrinsics",
    "invert_pose",
    "relative_pose",
    "resize_intrinsics",
    "resize_pixels",
    "to_homogeneous",
    "undistort_pixels",
}
AT_LEAST_SINGLE = {
    "correlate",
    "correlate_normalized",
    "depth_variance",
    "fundamental_between",
    "point_covariance",
    "ray_covariance",
    "sample_map",
    "track_covariance",
}
# Ends of segments are in the image or not by rounding, and poses in half precision rigid.
BY_ROUNDING = {"correlate, lines", "is_rigid"}
SCORES = {"correlate", "correlate, lines", "correlate_normalized"}
TAKES_PARTS = {  # of tensors: the table above, not the function
    "correlate",
    "correlate_normalized",
    "match_joint",
    "match_per_view",
    "rasterize_depth",
    "ray_parallax",
    "sample_map",
    "refine_tracks",
    "sample_segments",
    "track_covariance",
    "triangulate_robust_tracks",
    "triangulate_tracks",
    "triangulate_two_view",
}
EACH = pytest.mark.parametrize("name", OPERATIONS)


def test_every_public_function_is_tried() -> None:
    public = {name for name in geom.__all__ if inspect.isfunction(getattr(geom, name))}
    # A diagnosis is no tensor operation: it has tests of its own.
    assert {name.split(",")[0] for name in OPERATIONS} == public - {"diagnose"}


def largest(tensor: Tensor) -> float:
    return float(tensor.detach().double().abs().max()) if tensor.numel() else 0.0


def real_names(inputs: Inputs) -> list[str]:
    return [name for name in inputs if is_real(inputs[name])]


def gradients_of(found: list[Tensor], inputs: Inputs) -> list[Tensor]:
    """Of the sum of all results, each with its own factor."""
    loss = [
        torch.linspace(1, 2, each.numel(), dtype=torch.float64).to(each) @ each.flatten()
        for each in found
        if each.requires_grad
    ]
    leaves = [tensor for tensor in inputs.values() if tensor.requires_grad]
    if not loss:
        return [torch.zeros_like(leaf) for leaf in leaves]
    return list(torch.autograd.grad(sum(loss), leaves, retain_graph=True, materialize_grads=True))


def others_of(found: list[Tensor], plain: list[Tensor]) -> list[Tensor]:
    """Items 0 and 2 of a batch of three; whole where a result has no batch."""
    pairs = zip(found, plain, strict=True)
    return [each if each.ndim == one.ndim else each[[0, 2]] for each, one in pairs]


@EACH
@pytest.mark.parametrize("turn", [0, *(pytest.param(k, marks=pytest.mark.slow) for k in (1, 2))])
def test_what_is_not_finite_is_answered_finitely_and_alone(name: str, turn: int) -> None:
    """A value a place, and each value at each place at night."""
    values = (torch.nan, torch.inf, -torch.inf)
    operation, given = OPERATIONS[name], chosen(OPERATIONS[name], inputs_in(torch.float64))
    plain = tensors_of(operation(**given))
    for spoilt in real_names(given):
        good = given | {spoilt: given[spoilt].expand(3, *given[spoilt].shape).clone()}
        size = given[spoilt].numel()
        inputs = followed(good)
        wanted = others_of(tensors_of(operation(**inputs)), plain)
        wanted_gradients = gradients_of(wanted, inputs)
        for number, place in enumerate((0, size // 2, size - 1)):
            value = values[(number + turn) % 3]
            bad = good[spoilt].clone(memory_format=torch.contiguous_format)
            bad[1].view(-1)[place] = value
            inputs = followed(good | {spoilt: bad})
            results = tensors_of(operation(**inputs))
            where = f"{spoilt}[{place}] = {value}"
            found = others_of(results, plain)
            for ours, theirs in zip(found, wanted, strict=True):
                assert_close(ours, theirs, rtol=1e-9, atol=1e-9, msg=lambda m, w=where: f"{w}: {m}")
            gradients = gradients_of(found, inputs)
            for leaf, ours, theirs in zip(
                real_names(good), gradients, wanted_gradients, strict=True
            ):
                size_of = largest(theirs)
                assert_close(
                    ours,
                    theirs,
                    rtol=1e-7,
                    atol=1e-9 * (1 + size_of),
                    msg=lambda m, w=where, g=leaf: f"gradient of {g}, {w}: {m}",
                )
            if name in REWRITES:
                assert any(not each[1].isfinite().all() for each in results), where
                continue
            assert all(each.isfinite().all() for each in results if is_real(each)), where
            for leaf, ours in zip(real_names(good), gradients_of(results, inputs), strict=True):
                assert ours.isfinite().all(), f"gradient of {leaf}, {where}"
                if leaf == spoilt:
                    assert ours[1].flatten()[place] == 0, where


# Sums of products of features overflow: a score that is not finite counts as masked.
@pytest.mark.parametrize(
    "name", sorted(OPERATIONS.keys() - REWRITES - SCORES | {"undistort_pixels"})
)
def test_finite_numbers_of_any_size_make_no_nan(name: str) -> None:
    operation, given = OPERATIONS[name], chosen(OPERATIONS[name], inputs_in(torch.float32))
    most = torch.finfo(torch.float32).max
    sizes = {"0": lambda x: 0 * x, "large": lambda x: most**0.5 * x, "most": lambda x: 0 * x + most}
    nan = [
        f"{size} {spoilt}"
        for spoilt in real_names(given)
        for size, of in sizes.items()
        if any(
            each.isnan().any()
            for each in tensors_of(operation(**given | {spoilt: of(given[spoilt])}))
        )
    ]
    assert not nan


@pytest.mark.parametrize("name", OPERATIONS | METHODS)
def test_defaults_of_torch_do_not_matter(name: str) -> None:
    operation = (OPERATIONS | METHODS)[name]
    given = chosen(operation, inputs_in(torch.float32))
    plain = tensors_of(operation(**given))
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    try:
        with torch.device("meta"):
            found = tensors_of(operation(**given))
    finally:
        torch.set_default_dtype(before)
    assert_close(found, plain)


@pytest.mark.parametrize("view", [0, 1, 2])
@pytest.mark.parametrize("field", ["K", "poses"])
def test_a_camera_that_is_not_finite_sees_nothing_and_passes_nothing(field: str, view: int) -> None:
    inputs = inputs_in(torch.float64)
    bad = inputs[field].clone()
    bad[view, 0, 1] = torch.nan
    inputs = followed(inputs | {field: bad})
    views = geom.PosedViews(inputs["K"], inputs["poses"])
    sources = [view - 1] if view else [0, 1]
    assert views.proj[view].isnan().all() and views.proj.isfinite().sum() == 24
    seen, points = (
        OPERATIONS[name](**chosen(OPERATIONS[name], inputs)) for name in ("project", "unproject")
    )
    assert not seen.in_front[view].any() and (seen.depth[view] == 0).all()
    segments, samples = (
        OPERATIONS[name](**chosen(OPERATIONS[name], inputs))
        for name in ("epipolar_segments", "sample_inv_depths")
    )
    assert (segments.status[sources] == geom.Status.NOT_FINITE_INPUT).all()
    assert not samples.mask[sources].any()
    fundamental = geom.fundamental_between(views, view, (view + 1) % 3)
    nothing = [
        seen.pixels[view],
        points[view],
        segments.start[sources],
        segments.end[sources],
        samples.pixels[sources],
        fundamental,
    ]
    assert all((each == 0).all() for each in nothing)
    assert all((each == 0).all() for each in gradients_of(nothing, inputs))


@EACH
def test_integers_arrays_and_lists_are_refused_with_the_cure(name: str) -> None:
    operation, given = OPERATIONS[name], chosen(OPERATIONS[name], inputs_in(torch.float32))
    for spoilt in real_names(given) if name != "pixel_grid" else ():
        for dtype in INTEGERS:
            with pytest.raises(TypeError, match=r"must be floating point, .*: use \w+\.float\(\)"):
                operation(**given | {spoilt: given[spoilt].to(dtype)})
        for kind, cure in ((np.asarray, r"torch\.from_numpy"), (list, r"torch\.stack")):
            if name.split(",")[0] not in TAKES_PARTS:
                with pytest.raises(TypeError, match=cure):
                    operation(**given | {spoilt: kind(given[spoilt])})


@EACH
@pytest.mark.parametrize("half", HALF, ids=str)
def test_half_precision_is_computed_in_single_and_rounded(name: str, half: torch.dtype) -> None:
    operation, given = OPERATIONS[name], chosen(OPERATIONS[name], inputs_in(half))
    single = {key: x.float() if is_real(x) else x for key, x in given.items()}
    inputs = followed(given)
    result = operation(**inputs)
    results, wanted = tensors_of(result), tensors_of(operation(**single))
    covariance = getattr(result, "covariance", None)
    for ours, theirs in zip(results, wanted, strict=True):
        exact = name.split(",")[0] in AT_LEAST_SINGLE or ours is covariance
        kind = torch.float32 if exact else half
        assert ours.dtype == (kind if is_real(theirs) else theirs.dtype)
        if not is_real(theirs):
            assert name in BY_ROUNDING or torch.equal(ours, theirs)
            continue
        assert ours.isfinite().all()
        if name not in BY_ROUNDING:
            least, largest = torch.finfo(kind).tiny, torch.finfo(kind).max
            expected = theirs.clamp(-largest, largest)
            assert_close(ours.float(), expected, rtol=torch.finfo(kind).eps, atol=least)
    assert not any(each.isnan().any() for each in gradients_of(results, inputs))  # may overflow


@pytest.mark.parametrize("name", [*OPERATIONS, *(name for name in METHODS if name != "kornia")])
def test_nothing_is_no_error(name: str, dtype: torch.dtype) -> None:
    operation = (OPERATIONS | METHODS)[name]
    none = chosen(operation, inputs_in(dtype, num=0))
    some = chosen(operation, inputs_in(dtype))
    for given in (none, {key: x.expand(0, *x.shape) for key, x in some.items()}):
        inputs = followed(given)
        results = tensors_of(operation(**inputs))
        assert all(each.isfinite().all() for each in results if is_real(each))
        assert all(each.dtype == dtype for each in results if is_real(each))
        assert all(each.isfinite().all() for each in gradients_of(results, inputs))


@EACH
def test_batch_dims_broadcast_and_vmap_is_one(name: str, dtype: torch.dtype) -> None:
    operation, given = OPERATIONS[name], chosen(OPERATIONS[name], inputs_in(dtype))
    plain = tensors_of(operation(**given))
    near = 4096 * torch.finfo(dtype).eps
    for batched in given if name != "pixel_grid" else ():
        many = given | {batched: given[batched].expand(2, 1, *given[batched].shape)}
        for ours, theirs in zip(tensors_of(operation(**many)), plain, strict=True):
            assert ours.dtype == theirs.dtype
            assert ours.shape == (2, 1, *theirs.shape)
            assert_close(ours, theirs.expand_as(ours), rtol=near, atol=near * largest(theirs))
    many = {key: each.expand(2, *each.shape) for key, each in given.items()}
    mapped = torch.func.vmap(lambda one: tensors_of(operation(**one)))(many)
    for ours, theirs in zip(mapped, plain, strict=True):
        assert ours.dtype == theirs.dtype
        assert_close(ours, theirs.expand(2, *theirs.shape), rtol=near, atol=near * largest(theirs))


@EACH
def test_how_numbers_lie_in_memory_does_not_matter(name: str, dtype: torch.dtype) -> None:
    operation, given = OPERATIONS[name], chosen(OPERATIONS[name], inputs_in(dtype))
    expanded = {key: x.expand(2, *x.shape) for key, x in given.items()}
    turned = {key: x.transpose(0, -1).contiguous().transpose(0, -1) for key, x in expanded.items()}
    # As of the imaginary part of a conjugate: the sign is turned when a number is read.
    signed = {key: torch._neg_view(-x) if is_real(x) else x for key, x in expanded.items()}
    wanted = tensors_of(operation(**{key: x.contiguous() for key, x in expanded.items()}))
    for other in (expanded, turned, signed):
        for ours, theirs in zip(tensors_of(operation(**other)), wanted, strict=True):
            near = 1024 * torch.finfo(dtype).eps  # of pixels, in a residual of a tenth
            assert_close(ours, theirs, rtol=near, atol=near * largest(theirs))


def far(inputs: Inputs, offset: Tensor) -> Inputs:
    """The world moved by ``offset``, metres."""

    def moved(poses: Tensor) -> Tensor:
        shift = torch.eye(4, dtype=poses.dtype)
        shift[:3, 3] = -offset
        return poses @ shift

    poses = moved(inputs["poses"])
    return inputs | {
        "poses": poses,
        "pose": moved(inputs["pose"]),
        "other_pose": moved(inputs["other_pose"]),
        "proj": inputs["K"] @ poses[:, :3],
        "points": inputs["points"] + offset,
    }


# Results that move with the world, and one that is asked to work far from its origin.
MOVES = {"camera_centers", "invert_pose", "unproject", "triangulate, world"}


@EACH
def test_in_float64_far_from_the_origin_nothing_changes(name: str) -> None:
    operation, near = OPERATIONS[name], inputs_in(torch.float64)
    offset = torch.tensor([4e6, -3e6, 5e5], dtype=torch.float64)
    given = followed(chosen(operation, far(near, offset)))
    result, wanted = operation(**given), operation(**chosen(operation, near))
    found, wanted = tensors_of(result), tensors_of(wanted)
    assert all(each.isfinite().all() for each in [*found, *gradients_of(found, given)])
    for ours, theirs in zip(found, wanted, strict=True):
        if name in MOVES | BY_ROUNDING:
            continue
        if name.startswith(("triangulate", "refine")) and ours.shape == (6, 3):
            ours = ours - offset
        assert_close(ours, theirs, rtol=1e-3, atol=1e-5)
