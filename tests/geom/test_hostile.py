"""Hostile batches: whatever the numbers, nothing raises, all is finite, the status is the truth."""

from collections.abc import Iterator

import pytest
import torch
from operations import Inputs, chosen, followed
from solvers import SOLVERS, Fields, Solver
from torch import Tensor
from torch.testing import assert_close

from deltas_geom import Status
from deltas_geom.testing import default_intrinsics, rigid
from deltas_geom.triangulation.weights import NEGLIGIBLE_WEIGHT

KINDS = ("ordinary", "pixels", "weights", "cameras", "equal", "everything", "outliers", "behind")
# Who gives points alone, or takes no weights, gives those of another.
NAMES = [name for name in SOLVERS if "points, " not in name or "refine" in name]
NAMES = [name for name in NAMES if name not in ("triangulate_points", "triangulate, alike")]
EACH = pytest.mark.parametrize("name", NAMES)


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
) -> Inputs:
    """A batch that is hostile as its name says, the same on every machine.

    Args:
        name: of :data:`KINDS`.
        seed: which one.
        dtype: of all numbers.
        size: B, V, N.
        finite: leave out NaN and infinity.
    """
    generator = torch.Generator().manual_seed(1000 * seed + KINDS.index(name))
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
    # As hostile as the pixels.
    rays = (pixels - K[..., None, :2, 2]) / K[..., 0, 0, None, None]
    return {
        "poses": pose,
        "proj": proj,
        "pixels": pixels,
        "rays": torch.cat([rays, torch.ones_like(rays[..., :1])], dim=-1),
        "weights": weights,
        "mask": mask,
        "points": points,
    }


def batches(seed: int, dtype: torch.dtype, *, finite: bool = False) -> Iterator[tuple[str, Inputs]]:
    """Of every kind one, of rigs, pairs and five views in turn."""
    sizes = ((3, 3, 40), (2, 2, 40), (1, 5, 40))
    for number, kind in enumerate(KINDS):
        size = sizes[(number + dtype.itemsize) % 3]
        yield kind, hostile(kind, seed, dtype, size=size, finite=finite)


def given_to(solver: Solver, batch: Inputs) -> tuple[Tensor, Tensor, Tensor]:
    """Cameras ``(B, V, 3, 4)``, what they see ``(B, V, N, K)``, and its weights, 0 if unused."""
    cameras, seen = ("proj", "pixels") if solver.takes("proj") else ("poses", "rays")
    weights = batch["weights"].double().abs()
    weights = weights if solver.takes("weights") else torch.ones_like(weights)
    weights = torch.where(batch["mask"], weights, 0.0) if solver.takes("mask") else weights
    views = 2 if solver.views == 2 else None
    given = batch[cameras][..., :3, :], batch[seen], weights
    return given[0][:, :views], given[1][:, :views], given[2][:, :views]


def check_status(solver: Solver, batch: Inputs, status: Tensor) -> None:
    """What simple rules tell about a status ``(B, N)``, from the definitions."""
    cameras, seen, weight = given_to(solver, batch)
    counted = weight.nan_to_num(torch.inf)
    used = ~(counted <= NEGLIGIBLE_WEIGHT * counted.amax(dim=-2, keepdim=True))
    # An infinite weight leaves no ratio: all others count for nothing beside it or for all.
    odd_weight = ~weight.isfinite().all(dim=-2)
    sick = ~cameras.isfinite().flatten(2).all(dim=-1)
    wrong = ~seen.isfinite().all(dim=-1) | sick[..., None]
    wrong_used = (wrong & used & weight.isfinite()).any(dim=-2) & ~odd_weight
    assert (status[wrong_used | odd_weight] == Status.NOT_FINITE_INPUT).all()
    # What is huge may count as not finite; within 1e30 in each number it does not.
    small = (cameras.abs() < 1e30).flatten(2).all(dim=-1)[..., None]
    small = small & (seen.abs() < 1e30).all(dim=-1)
    fine = (small | ~used).all(dim=-2) & ~odd_weight
    few = used.sum(dim=-2) < 2
    assert (status[few & fine] == Status.TOO_FEW_VIEWS).all()
    assert (status[~few & fine] != Status.TOO_FEW_VIEWS).all()


def check_inliers(solver: Solver, batch: Inputs, found: Fields) -> None:
    """Used, finite and two or more, or none."""
    _, seen, weights = given_to(solver, batch)
    inliers = found["inliers"] if "inliers" in found else found["used"]
    assert torch.equal(inliers.any(dim=-2), found["valid"])
    assert not (inliers & ~((weights != 0) & seen.isfinite().all(dim=-1))).any()
    assert (inliers.sum(dim=-2)[found["valid"]] >= 2).all()


def check_refined(batch: Inputs, found: Fields) -> None:
    """What failed is where it was."""
    given = batch["points"]
    kept = ~found["valid"] & (given.abs() < 1e30).all(dim=-1)  # NaN is not below
    assert torch.equal(found["points"][kept], given[kept])


def check_without_others(solver: Solver, batch: Inputs, found: Fields) -> None:
    """Some points whose numbers are ordinary are as they are without all others."""
    _, seen, weights = given_to(solver, batch)
    plain = (seen.abs() < 1e4).all(dim=-1) & (batch["points"].abs() < 1e4).all(dim=-1)[:, None]
    plain = (plain & ((weights == 0) | (weights > 1e-5) & (weights < 2))).flatten(0, 1).all(dim=0)
    some = plain.nonzero().flatten()[:4]
    assert len(some)
    few = {
        name: value if name in ("poses", "proj") else value.index_select(dim, some)
        for name, value in batch.items()
        for dim in [-2 if name in ("pixels", "rays", "points") else -1]
    }
    alone = solver(chosen(solver.operation, few))
    near = 1e-6 if batch["points"].dtype == torch.float64 else 1e-4
    for field, dim in (("points", -2), ("depth", -1), ("residual", -1), ("status", -1)):
        if field in found:
            ours = found[field].detach().index_select(dim, some)
            assert_close(ours, alone[field], rtol=near, atol=near, msg=lambda m, f=field: f + m)


def check(name: str, batch: Inputs, *, gradients: bool) -> Fields:
    """All that is said of the results, and whether their gradients are finite."""
    solver = SOLVERS[name]
    leaves = followed(chosen(solver.operation, batch))
    found = solver(leaves)
    assert all(value.isfinite().all() for value in found.values())
    valid, robust = found["valid"], solver.robust
    assert (found["residual"] >= 0).all() and (found["residual"][~valid] == 0).all()
    if "status" in found:
        assert torch.equal(valid, found["status"] == Status.OK)
        assert (found["points"][~valid] == 0).all() and (found["depth"].mT[~valid] == 0).all()
        assert (found["parallax"] >= 0).all() and (found["parallax"] <= 3.1416).all()
        # In front of every view that is surely used is what OK says.
        weights = given_to(solver, batch)[2]
        used = weights > 2 * NEGLIGIBLE_WEIGHT * weights.amax(dim=-2, keepdim=True)
        ahead = (found["depth"] >= 0) | ~used | ~valid.unsqueeze(-2)
        assert robust or ahead.all()
        check_inliers(solver, batch, found) if robust else check_status(
            solver, batch, found["status"]
        )
    else:
        check_refined(batch, found)
    if gradients:
        # Added in double, where the terms do not overflow.
        some = [
            found[field] for field in ("points", "depth", "residual", "pixels") if field in found
        ]
        total = sum((value.double().sum() for value in some), torch.zeros(()).double())
        real = {name: leaf for name, leaf in leaves.items() if leaf.requires_grad}
        pulled = torch.autograd.grad(total, list(real.values()), materialize_grads=True)
        for leaf, gradient in zip(real, pulled, strict=True):
            # Of a weight of 1e-308, of which ratios count, the true one may be beyond numbers.
            beyond = (
                (gradient.abs() == torch.inf) & (leaf == "weights") & (real[leaf].abs() < 1e-300)
            )
            assert (gradient.isfinite() | beyond).all(), leaf
    return found


@EACH
def test_hostile_batches_are_finite_and_flagged(name: str, dtype: torch.dtype) -> None:
    for kind, batch in batches(0, dtype):
        found = check(name, batch, gradients=dtype == torch.float64)
        if kind in ("pixels", "weights", "outliers"):
            check_without_others(SOLVERS[name], batch, found)


@EACH
def test_true_gradients_that_can_be_held_are_finite_in_float32_too(name: str) -> None:
    # True derivatives by numbers of 1e30 do not fit float32: there ordinary ones, outliers,
    # points behind and equal cameras, with NaN and infinities among pixels and weights.
    for kind in ("ordinary", "equal", "outliers", "behind"):
        batch = hostile(kind, 1, torch.float32, size=(3, 3, 60))
        generator = torch.Generator().manual_seed(0)
        for value in (torch.nan, torch.inf):
            spoil = torch.rand(batch["weights"].shape, generator=generator) < 0.05
            for seen in ("pixels", "rays"):
                batch[seen] = torch.where(spoil[..., None], value, batch[seen])
            batch["weights"] = torch.where(spoil.roll(1, -1), value, batch["weights"])
        check(name, batch, gradients=True)


@EACH
def test_nothing_to_do_is_no_error(name: str, dtype: torch.dtype) -> None:
    sizes = [(2, 3, 0), (0, 3, 4), (2, 2, 1), *([(2, 1, 4)] if SOLVERS[name].views > 2 else [])]
    for size in sizes:
        check(name, hostile("ordinary", 0, dtype, size=size), gradients=True)
    nothing = hostile("everything", 0, dtype, size=(2, 3, 6))
    nothing |= {name: torch.zeros_like(nothing[name]) for name in ("mask", "weights")}
    found = check(name, nothing, gradients=True)
    assert SOLVERS[name].views == 2 or not found["valid"].any()


@pytest.mark.slow
@EACH
def test_a_million_hostile_points_are_finite_and_flagged(name: str) -> None:
    for seed in range(2, 26):
        for dtype in (torch.float32, torch.float64):
            for kind in KINDS:
                size = (3, 2 + seed % 4, 200)
                batch = hostile(kind, seed, dtype, size=size, finite=seed % 3 == 0)
                check(name, batch, gradients=dtype == torch.float64)
