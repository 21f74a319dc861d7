"""Hostile batches: whatever the numbers, nothing raises, all is finite, the status is the truth."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import pytest
import torch
from solvers import WAYS, by
from torch import Tensor

from deltas_geom import (
    PosedViews,
    Status,
    epipolar_segments,
    rasterize_depth,
    refine_points,
    sample_segments,
    soft_argmax,
    triangulate,
    triangulate_midpoint,
    triangulate_points,
    triangulate_rays,
    triangulate_robust,
    triangulate_tracks,
    triangulate_two_view,
)
from deltas_geom.testing import default_intrinsics, rigid
from deltas_geom.triangulation.weights import NEGLIGIBLE_WEIGHT

IMAGE_SIZE = (480, 640)
NAMES = ("ordinary", "pixels", "weights", "cameras", "equal", "everything", "outliers", "behind")


class Batch(NamedTuple):
    """A hostile batch: B rigs of V views and N points.

    Attributes:
        name: what is wrong with it.
        K: ``(B, V, 3, 3)``.
        pose: ``(B, V, 4, 4)``.
        proj: ``(B, V, 3, 4)``; not always K [R | t].
        pixels: ``(B, V, N, 2)``.
        weights: ``(B, V, N)``.
        mask: ``(B, V, N)``.
        points: ``(B, N, 3)`` near the truth, or anything.
    """

    name: str
    K: Tensor
    pose: Tensor
    proj: Tensor
    pixels: Tensor
    weights: Tensor
    mask: Tensor
    points: Tensor


def special(dtype: torch.dtype, *, finite: bool) -> Tensor:
    """Numbers that break arithmetic."""
    info = torch.finfo(dtype)
    numbers = [0.0, -0.0, 1e30, -1e30, 1e-30, -1e-30, info.tiny, info.tiny / 64, info.max]
    if not finite:
        numbers += [torch.nan, torch.inf, -torch.inf, torch.nan]
    return torch.tensor(numbers, dtype=dtype)


def spoilt(values: Tensor, share: float, generator: torch.Generator, *, finite: bool) -> Tensor:
    """Values, a share of them replaced by special numbers or by any of 60 decades."""
    dtype = values.dtype
    numbers = special(dtype, finite=finite)
    index = torch.randint(len(numbers), values.shape, generator=generator)
    power = 60 * torch.rand(values.shape, generator=generator, dtype=torch.float64) - 30
    wild = (10.0**power).to(dtype) * torch.randn(values.shape, generator=generator, dtype=dtype)
    other = torch.where(torch.rand(values.shape, generator=generator) < 0.7, numbers[index], wild)
    return torch.where(torch.rand(values.shape, generator=generator) < share, other, values)


def hostile(
    name: str,
    seed: int,
    dtype: torch.dtype,
    *,
    size: tuple[int, int, int] = (3, 3, 40),
    finite: bool = False,
) -> Batch:
    """A batch that is hostile as its name says, the same on every machine.

    Args:
        name: of :data:`NAMES`.
        seed: which one.
        dtype: of all numbers.
        size: B, V, N.
        finite: leave out NaN and infinity.
    """
    generator = torch.Generator().manual_seed(1000 * seed + NAMES.index(name))
    batch, views, count = size

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    center = 0.3 * normal(batch, views, 3)
    pose = rigid(0.15 * normal(batch, views, 3), torch.zeros(batch, views, 3).double())
    pose[..., :3, 3:] = -pose[..., :3, :3] @ center[..., None]
    K = default_intrinsics().repeat(batch, views, 1, 1)
    points = normal(batch, count, 3) + torch.tensor([0, 0, 5.0])
    if name == "behind":
        points[..., 2] = 0.5 * normal(batch, count)
    if name == "equal":
        pose[:, 1:] = pose[:, :1]
    proj = K @ pose[..., :3, :]
    seen = torch.einsum("bvij,bnj->bvni", proj[..., :3], points) + proj[..., None, :, 3]
    pixels = seen[..., :2] / seen[..., 2:] + normal(batch, views, count, 2)
    weights = 10 ** (-4 * torch.rand(batch, views, count, generator=generator).double())
    mask = torch.rand(batch, views, count, generator=generator) < 0.8
    mask[:, :, : count // 10] = False
    if name == "outliers":
        wrong = torch.rand(batch, views, count, 1, generator=generator) < 0.4
        pixels = torch.where(wrong, 3000 * normal(*pixels.shape), pixels)

    proj, pixels, weights = proj.to(dtype), pixels.to(dtype), weights.to(dtype)
    K, pose, points = K.to(dtype), pose.to(dtype), points.to(dtype)
    share = 0.15
    if name in ("pixels", "everything"):
        pixels = spoilt(pixels, share, generator, finite=finite)
        points = spoilt(points, share, generator, finite=finite)
    if name in ("weights", "everything"):
        weights = spoilt(weights, share, generator, finite=finite)
        weights = weights * torch.where(torch.rand(weights.shape, generator=generator) < 0.2, 0, 1)
        weights = weights * torch.where(torch.rand(weights.shape, generator=generator) < 0.2, -1, 1)
    if name in ("cameras", "everything"):
        # A third of the cameras each: whole, spoilt in few numbers, zero or huge.
        proj = spoilt(proj, 0.03, generator, finite=finite)
        pose = spoilt(pose, 0.03, generator, finite=finite)
        kind = torch.rand(batch, views, 1, 1, generator=generator)
        proj = torch.where(kind < 0.1, 0.0, proj)
        proj = torch.where((kind > 0.1) & (kind < 0.15), 1e12 * proj, proj)
    return Batch(name, K, pose, proj, pixels, weights, mask, points)


def batches(seed: int, dtype: torch.dtype, count: int = 40, *, finite: bool) -> Iterator[Batch]:
    """Of every name one, of rigs, pairs and five views in turn."""
    sizes = ((3, 3, count), (2, 2, count), (1, 5, count))
    for number, name in enumerate(NAMES):
        size = sizes[(number + dtype.itemsize) % 3]
        yield hostile(name, seed, dtype, size=size, finite=finite)


def rays_of(batch: Batch) -> Tensor:
    """Rays ``(B, V, N, 3)`` as hostile as the pixels."""
    focal, center = batch.K[..., 0, 0, None, None], batch.K[..., None, :2, 2]
    rays = (batch.pixels - center) / focal
    return torch.cat([rays, torch.ones_like(rays[..., :1])], dim=-1)


def tracks_of(batch: Batch) -> tuple[Tensor, Tensor, Tensor, Tensor, int]:
    """The observations of all rigs as one list: pixels, cameras, points, weights, N."""
    rigs, views, count = batch.weights.shape
    camera = torch.arange(rigs * views).repeat_interleave(count)
    point = torch.arange(rigs * count).reshape(rigs, 1, count).expand(rigs, views, count)
    weights = torch.where(batch.mask, batch.weights, 0.0)
    return batch.pixels.flatten(0, 2), camera, point.flatten(), weights.flatten(), rigs * count


def finite_of(values: tuple[Tensor | None, ...]) -> list[Tensor]:
    return [value for value in values if value is not None]


def leaf(tensor: Tensor) -> Tensor:
    return tensor.detach().clone().requires_grad_()


def check_pixel_status(batch: Batch, status: Tensor, cameras: Tensor, seen: Tensor) -> None:
    """What simple rules tell about a status, from the definitions.

    Args:
        batch: the inputs.
        status: ``(B, N)``.
        cameras: ``(B, V, ...)`` matrices.
        seen: ``(B, V, N, K)`` what is seen.
    """
    weight = torch.where(batch.mask, batch.weights.double(), 0.0).abs()
    counted = weight.nan_to_num(torch.inf)
    used = ~(counted <= NEGLIGIBLE_WEIGHT * counted.amax(dim=-2, keepdim=True))
    # An infinite weight leaves no ratio: all others count for nothing beside it or for all.
    odd_weight = ~weight.isfinite().all(dim=-2)
    sick = ~cameras.isfinite().flatten(2).all(dim=-1)
    wrong = ~seen.isfinite().all(dim=-1) | sick[..., None]
    wrong_used = (wrong & used & weight.isfinite()).any(dim=-2) & ~odd_weight
    must_fail = wrong_used | odd_weight
    assert (status[must_fail] == Status.NOT_FINITE_INPUT).all(), batch.name
    # What is huge may count as not finite; within 1e30 in each number it does not.
    small = (seen.abs() < 1e30).all(dim=-1) & (cameras.abs() < 1e30).flatten(2).all(dim=-1)[
        ..., None
    ]
    fine = (small | ~used).all(dim=-2) & ~odd_weight
    few = used.sum(dim=-2) < 2
    assert (status[few & fine] == Status.TOO_FEW_VIEWS).all(), batch.name
    assert (status[~few & fine] != Status.TOO_FEW_VIEWS).all(), batch.name


def check_found(batch: Batch, found: tuple[Tensor | None, ...], *, masked: bool = True) -> None:
    for value in finite_of(found):
        assert value.isfinite().all(), batch.name
    fields = found._asdict()  # type: ignore[attr-defined]
    status, valid, points = fields["status"], fields["valid"], fields["points"]
    assert torch.equal(valid, status == Status.OK), batch.name
    assert ((status >= 0) & (status <= 5)).all()
    assert (points[~valid] == 0).all(), batch.name
    assert (fields["residual"] >= 0).all()
    assert (fields["residual"][~valid] == 0).all(), batch.name
    depth = fields["depth"]
    if masked:
        failed = (~valid).unsqueeze(-2).expand_as(depth)
        assert (depth[failed] == 0).all(), batch.name


def total(*values: Tensor) -> Tensor:
    """A sum whose own gradient is 1 and whose terms do not overflow where they are added."""
    return sum((value.double().sum() for value in values), torch.zeros(()).double())


def check_gradients(
    batch: Batch, value: Tensor, inputs: tuple[Tensor, ...], *, again: bool = False
) -> None:
    if not value.requires_grad:
        return
    for gradient in torch.autograd.grad(value, inputs, retain_graph=again, allow_unused=True):
        if gradient is not None:
            assert gradient.isfinite().all(), f"{batch.name}: {gradient.shape}"


def run_triangulate(batch: Batch, gradients: bool) -> None:
    for way in WAYS:
        with by(way):
            run_one_way(batch, gradients)


def run_one_way(batch: Batch, gradients: bool) -> None:
    inputs = leaf(batch.proj), leaf(batch.pixels), leaf(batch.weights)
    found = triangulate(*inputs, batch.mask, covariance=True)
    check_found(batch, found)
    check_pixel_status(batch, found.status, batch.proj, batch.pixels)
    assert (found.parallax >= 0).all() and (found.parallax <= 3.1416).all()
    assert torch.equal(triangulate_points(*inputs, batch.mask), found.points)
    world = triangulate(*inputs, batch.mask, frame="world")
    check_found(batch, world)
    check_pixel_status(batch, world.status, batch.proj, batch.pixels)
    # In front of every used view is what OK says, by the depths it reports.
    weight = torch.where(batch.mask, batch.weights, 0.0).abs()
    used = weight > 2 * NEGLIGIBLE_WEIGHT * weight.amax(dim=-2, keepdim=True)
    ahead = (found.depth >= 0) | ~used | ~found.valid.unsqueeze(-2)
    assert ahead.all(), batch.name
    if gradients:
        check_gradients(batch, total(found.points, found.depth, found.residual), inputs)
        check_gradients(batch, total(world.points), inputs)


def run_rays(batch: Batch, gradients: bool) -> None:
    for function in (triangulate_rays, triangulate_midpoint):
        inputs = leaf(batch.pose), leaf(rays_of(batch)), leaf(batch.weights)
        found = function(*inputs, batch.mask)
        check_found(batch, found)
        check_pixel_status(batch, found.status, batch.pose[..., :3, :], inputs[1].detach())
        if gradients:
            check_gradients(batch, total(found.points, found.depth, found.residual), inputs)


def run_tracks(batch: Batch, gradients: bool) -> None:
    pixels, camera, point, weights, count = tracks_of(batch)
    inputs = leaf(batch.proj.flatten(0, 1)), leaf(pixels), leaf(weights)
    found = triangulate_tracks(*inputs[:2], camera, point, count, inputs[2])
    check_found(batch, found, masked=False)
    check_pixel_status(
        batch, found.status.reshape(batch.weights[:, 0].shape), batch.proj, batch.pixels
    )
    assert (found.depth[~found.valid[point]] == 0).all()
    if gradients:
        check_gradients(batch, total(found.points, found.depth, found.residual), inputs)


def run_refine(batch: Batch, gradients: bool) -> None:
    for loss, gradient, steps in (
        ("squared", "unrolled", 3),
        ("huber", "unrolled", 2),
        ("cauchy", "implicit", 5),
    ):
        inputs = leaf(batch.proj), leaf(batch.pixels), leaf(batch.points), leaf(batch.weights)
        found = refine_points(
            *inputs,
            batch.mask,
            steps=steps,
            loss=loss,
            gradient=gradient,  # type: ignore[arg-type]
        )
        assert all(value.isfinite().all() for value in found), (batch.name, loss)
        assert (found.residual[~found.valid] == 0).all()
        given = batch.points.isfinite().all(dim=-1)
        kept = ~found.valid & given & (batch.points.abs() < 1e30).all(dim=-1)
        assert torch.equal(found.points[kept], batch.points[kept]), (batch.name, loss)
        if gradients:
            check_gradients(batch, total(found.points, found.residual), inputs)


def run_two_view(batch: Batch, gradients: bool) -> None:
    inputs = leaf(batch.proj[:, :2]), leaf(batch.pixels[:, :2])
    mask = batch.mask[:, :2]
    found = triangulate_two_view(*inputs, mask)
    check_found(batch, found)
    first = batch._replace(
        proj=batch.proj[:, :2],
        pixels=batch.pixels[:, :2],
        weights=torch.ones_like(batch.weights[:, :2]),
        mask=mask,
    )
    check_pixel_status(first, found.status, first.proj, first.pixels)
    if gradients:
        sums = total(found.points, found.depth, found.residual, found.pixels)
        check_gradients(batch, sums, inputs)


def run_robust(batch: Batch, gradients: bool) -> None:
    inputs = leaf(batch.proj), leaf(batch.pixels), leaf(batch.weights)
    found = triangulate_robust(*inputs, batch.mask, covariance=True)
    check_found(batch, found)
    assert torch.equal(found.inliers.any(dim=-2), found.valid), batch.name
    assert not (found.inliers & ~batch.mask).any()
    assert (found.inliers.sum(dim=-2)[found.valid] >= 2).all()
    seen = batch.pixels.isfinite().all(dim=-1)
    assert not (found.inliers & ~seen).any()
    if gradients:
        check_gradients(batch, total(found.points, found.depth, found.residual), inputs)


def run_segments(batch: Batch, gradients: bool) -> None:
    # Poses are checked by their own function (PosedViews.check_values): here they are rigid.
    if not batch.pose.isfinite().all() or batch.name in ("cameras", "everything"):
        return
    keypoints = leaf(batch.pixels[:, 0])
    views = PosedViews(batch.K, batch.pose)
    for depth_range in ((0.5, torch.inf), (1.0, 20.0)):
        found = epipolar_segments(views, keypoints, depth_range=depth_range, image_size=IMAGE_SIZE)
        for value in found:
            assert value.isfinite().all(), batch.name
        # A keypoint that cannot be seen by a finite camera: anything but a crash.
        unknown = ~keypoints.isfinite().all(dim=-1).unsqueeze(-2).expand_as(found.status)
        assert (found.status[unknown] == Status.NOT_FINITE_INPUT).all()
        assert (found.status[~unknown] != Status.NOT_FINITE_INPUT).all()
        hidden = ~found.visible
        assert (found.start[hidden] == 0).all() and (found.end[hidden] == 0).all()
        for spacing in ("inv_depth", "pixels"):
            samples = sample_segments(
                found,
                8,
                spacing=spacing,
                offsets=(-1.0, 0.0, 1.0),
                image_size=IMAGE_SIZE,  # type: ignore[arg-type]
            )
            assert samples.pixels.isfinite().all() and samples.inv_depth.isfinite().all()
            assert not (samples.mask & hidden[..., None, None]).any()
            if gradients:
                reached = total(samples.pixels, samples.inv_depth)
                check_gradients(batch, reached, (keypoints,), again=True)


def run_raster(batch: Batch, gradients: bool) -> None:
    inputs = leaf(batch.pixels[:, 0]), leaf(batch.points[..., 2]), leaf(batch.weights[:, 0])
    for reduce in ("front", "mean"):
        for splat in ("pixel", "bilinear"):
            found = rasterize_depth(
                inputs[0], inputs[1], image_size=(24, 32), mask=batch.mask[:, 0],
                weights=inputs[2], reduce=reduce, splat=splat,  # type: ignore[arg-type]
            )  # fmt: skip
            assert found.depth.isfinite().all(), batch.name
            # A sum of weights may overflow; a weight that is not NaN is what it is.
            assert not found.weight.isnan().any() and (found.depth >= 0).all()
            assert (found.depth[found.weight == 0] == 0).all(), batch.name
            if gradients:
                check_gradients(batch, total(found.depth), inputs)


def run_soft_argmax(batch: Batch, gradients: bool) -> None:
    logits = batch.weights.mT.reshape(-1, batch.weights.shape[-2])
    positions = batch.pixels.transpose(1, 2).flatten(0, 1)
    mask = batch.mask.mT.reshape(logits.shape)
    # What is possible has to be finite, and its square representable; the rest is anything.
    mask = mask & logits.isfinite() & (positions.abs() < 1e15).all(dim=-1)
    inputs = leaf(logits), leaf(positions)
    for window in (None, 1):
        found = soft_argmax(*inputs, mask=mask, window=window)
        for value in found:
            assert value.isfinite().all(), batch.name
        nothing = ~mask.any(dim=-1)
        assert all((value[nothing] == 0).all() for value in (found.position, found.peak))
        if gradients:
            check_gradients(batch, total(*found), inputs)


RUNS: dict[str, Callable[[Batch, bool], None]] = {
    "triangulate": run_triangulate,
    "rays": run_rays,
    "tracks": run_tracks,
    "refine": run_refine,
    "two_view": run_two_view,
    "robust": run_robust,
    "segments": run_segments,
    "raster": run_raster,
    "soft_argmax": run_soft_argmax,
}
EACH = pytest.mark.parametrize("name", RUNS)


@EACH
def test_hostile_batches_are_finite_and_flagged(name: str, dtype: torch.dtype) -> None:
    for batch in batches(0, dtype, finite=False):
        RUNS[name](batch, dtype == torch.float64)


@EACH
def test_true_gradients_that_can_be_held_are_finite_in_float32_too(name: str) -> None:
    # True derivatives by numbers of 1e30 do not fit float32: there ordinary ones, outliers,
    # points behind and equal cameras, with NaN and infinities among pixels and weights.
    for kind in ("ordinary", "equal", "outliers", "behind"):
        batch = hostile(kind, 1, torch.float32, size=(3, 3, 60))
        generator = torch.Generator().manual_seed(0)
        for value in (torch.nan, torch.inf):
            spoil = torch.rand(batch.weights.shape, generator=generator) < 0.05
            batch = batch._replace(
                pixels=torch.where(spoil[..., None], value, batch.pixels),
                weights=torch.where(spoil.roll(1, -1), value, batch.weights),
            )
        RUNS[name](batch, True)


@EACH
def test_nothing_to_do_is_no_error(name: str, dtype: torch.dtype) -> None:
    for size in ((2, 3, 0), (0, 3, 4), (2, 2, 1)):
        RUNS[name](hostile("ordinary", 0, dtype, size=size), True)
    if name not in ("two_view", "segments"):
        RUNS[name](hostile("ordinary", 0, dtype, size=(2, 1, 4)), True)
    nothing = hostile("everything", 0, dtype, size=(2, 3, 6))
    RUNS[name](nothing._replace(mask=torch.zeros_like(nothing.mask)), True)


@pytest.mark.slow
@EACH
def test_a_million_hostile_points_are_finite_and_flagged(name: str) -> None:
    # Nine functions, two types: 58 000 points of each.
    count = 0
    for seed in range(2, 100):
        for dtype in (torch.float32, torch.float64):
            for kind in NAMES:
                size = (3, 2 + seed % 4, 200)
                batch = hostile(kind, seed, dtype, size=size, finite=seed % 3 == 0)
                RUNS[name](batch, dtype == torch.float64)
                count += 600
        if count >= 112_000:
            break
