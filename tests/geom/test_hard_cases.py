"""Accuracy where it is hard, against the exact minimiser in 60 digits.

The oracle minimises the same algebraic error of the same rounded inputs, so that what is left is
the solver's own error. An SVD of the rows, in the inputs' type, is the measure.
"""

from functools import cache
from typing import NamedTuple

import mpmath
import pytest
import torch
from solvers import WAYS, by
from torch import Tensor

from deltas_geom import refine_points, reprojection_residual, triangulate, triangulate_points

DIGITS = 60
COUNT = 16  # points of a case
DEPTH = 4.0  # of the points from the rig, in metres
CASES = (
    "1 degree at f = 3000",
    "depth 1000 baselines",
    "depth 1000 baselines in mm",
    "origin 10 km away",
    "weights 1e-6 to 1",
    "weights 1e-6 to 1 at 1 degree",
    "weights 1e-6 to 1 at 1 degree and noise",
    "ring",
    "90 degrees",
    "noise",
    "90 degrees and noise",
)


class Case(NamedTuple):
    """Inputs of one hard case.

    Attributes:
        proj: ``(V, 3, 4)``.
        pixels: ``(V, N, 2)``.
        weights: ``(V, N)``.
        unit: of length, per metre.
    """

    proj: Tensor
    pixels: Tensor
    weights: Tensor
    unit: float


def looking_at_origin(centers: Tensor) -> Tensor:
    """Poses ``(V, 4, 4)`` of upright cameras."""
    z = torch.nn.functional.normalize(-centers, dim=-1)
    up = torch.tensor([0.0, 1, 0]).double().expand_as(z)
    x = torch.nn.functional.normalize(torch.linalg.cross(up, z), dim=-1)
    rotation = torch.stack([x, torch.linalg.cross(z, x), z], dim=-2)
    pose = torch.eye(4).double().repeat(len(centers), 1, 1)
    pose[:, :3, :3] = rotation
    pose[:, :3, 3] = -(rotation @ centers[..., None])[..., 0]
    return pose


def hard(name: str, views: int, dtype: torch.dtype, count: int = COUNT) -> Case:
    """Cameras 4 m around points within 40 cm of the world's origin, or as the name says."""
    generator = torch.Generator().manual_seed(0)
    focal = 3000.0 if "3000" in name else 600.0
    unit = 1000.0 if "mm" in name else 1.0
    angle = 90.0 if "90" in name else 1.0 if "1 degree" in name else 10.0
    noise = 1.0 if "noise" in name else 0.0
    if "1000 baselines" in name:
        angle, noise = 0.0573, 0.2
    share = torch.linspace(-0.5, 0.5, views).double()
    around = torch.deg2rad(angle * share)
    height = 2 * share * DEPTH * angle / 600
    if name == "ring":
        around = 2 * torch.pi * torch.arange(views).double() / views
        height = torch.zeros_like(height)
    centers = torch.stack([around.sin() * DEPTH, height, -around.cos() * DEPTH], dim=-1)
    pose = looking_at_origin(centers)
    K = torch.tensor([[focal, 0, 0.6 * focal], [0, focal, 0.4 * focal], [0, 0, 1]]).double()
    proj = K @ pose[:, :3]
    points = DEPTH * 0.2 * (torch.rand(count, 3, generator=generator).double() - 0.5)
    seen = torch.einsum("vij,nj->vni", proj[..., :3], points) + proj[:, None, :, 3]
    pixels = seen[..., :2] / seen[..., 2:]
    pixels = pixels + noise * torch.randn(pixels.shape, generator=generator).double()
    weights = torch.ones(views, count).double()
    if "weights" in name:
        weights = 10 ** (-6 * torch.rand(views, count, generator=generator).double())
    origin = torch.zeros(3).double()
    if "10 km" in name:
        origin = torch.tensor([1e4, -3e3, 5e3]).double()
    last = unit * (proj[..., 3:] - proj[..., :3] @ origin[:, None])
    proj = torch.cat([proj[..., :3], last], dim=-1)
    return Case(proj.to(dtype), pixels.to(dtype), weights.to(dtype), unit)


class Frame(NamedTuple):
    """A point's frame and its cameras there, exactly: X = unit x + origin."""

    origin: mpmath.matrix
    unit: mpmath.mpf
    cameras: list[mpmath.matrix]


def exact_frames(case: Case, frame: str) -> list[Frame]:
    """The frame of each point, in 60 digits."""
    cameras = [mpmath.matrix(camera.tolist()) for camera in case.proj]
    centers = [-mpmath.lu_solve(camera[:, :3], camera[:, 3]) for camera in cameras]
    found = []
    for weights in case.weights.mT.tolist():
        origin, unit = mpmath.matrix([0, 0, 0]), mpmath.mpf(1)
        if frame == "rig":
            squared = [mpmath.mpf(weight) ** 2 for weight in weights]
            total = sum(squared)
            for center, share in zip(centers, squared, strict=True):
                origin += center * (share / total)
            spread = mpmath.mpf(0)
            for center, share in zip(centers, squared, strict=True):
                spread += mpmath.norm(center - origin) ** 2 * (share / total)
            unit = mpmath.sqrt(spread)
        moved = []
        for camera in cameras:
            local = mpmath.matrix(3, 4)
            last = camera[:, :3] * origin + camera[:, 3]
            for row in range(3):
                for column in range(3):
                    local[row, column] = camera[row, column] * unit
                local[row, 3] = last[row]
            moved.append(local)
        found.append(Frame(origin, unit, moved))
    return found


def exact_points(case: Case, frames: list[Frame]) -> list[mpmath.matrix]:
    """The minimisers of the algebraic error, by eigenvectors in 60 digits."""
    points = []
    for index, (origin, unit, cameras) in enumerate(frames):
        normal = mpmath.matrix(4, 4)
        for view, camera in enumerate(cameras):
            squared = mpmath.mpf(float(case.weights[view, index])) ** 2
            for axis in range(2):
                place = mpmath.mpf(float(case.pixels[view, index, axis]))
                row = camera[2, :] * place - camera[axis, :]
                normal += squared * (row.T * row)
        _, vectors = mpmath.eigsy(normal)
        points.append(vectors[:3, 0] / vectors[3, 0] * unit + origin)
    return points


def svd_points(case: Case, frames: list[Frame]) -> list[mpmath.matrix]:
    """By torch's SVD of rows in the inputs' type, in frames that are exact."""
    points = []
    for index, (origin, unit, cameras) in enumerate(frames):
        local = torch.tensor(
            [[[float(c[i, j]) for j in range(4)] for i in range(3)] for c in cameras],
            dtype=torch.float64,
        ).to(case.proj.dtype)
        rows = case.pixels[:, index, :, None] * local[:, 2:] - local[:, :2]
        rows = (case.weights[:, index, None, None] * rows).flatten(0, 1)
        null = torch.linalg.svd(rows).Vh[-1]
        place = mpmath.matrix([float(null[i]) for i in range(4)])
        points.append(place[:3, 0] / place[3] * unit + origin)
    return points


def error(found: mpmath.matrix, wanted: mpmath.matrix, case: Case) -> float:
    """Relative to the distance from the rig."""
    return float(max(abs(found[i] - wanted[i]) for i in range(3)) / (DEPTH * case.unit))


class Oracle(NamedTuple):
    """What others find in a case, by frame.

    Attributes:
        exact: the minimisers in 60 digits.
        by_svd: torch's of rows in the inputs' type, in frames that are exact.
    """

    exact: dict[str, list[mpmath.matrix]]
    by_svd: dict[str, list[mpmath.matrix]]


@cache
def oracle(name: str, views: int, dtype: torch.dtype) -> Oracle:
    """Of a hard case."""
    case = hard(name, views, dtype)
    frames = {frame: exact_frames(case, frame) for frame in ("rig", "world")}
    return Oracle(
        {frame: exact_points(case, some) for frame, some in frames.items()},
        {frame: svd_points(case, some) for frame, some in frames.items()},
    )


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("frame", ["rig", "world"])
@pytest.mark.parametrize("views", [2, 5])
@pytest.mark.parametrize("name", CASES)
def test_points_are_as_exact_as_an_svd_makes_them(
    name: str, views: int, frame: str, way: str, dtype: torch.dtype
) -> None:
    if name == "ring" and views == 2:
        pytest.skip("two cameras that face each other see no depth")
    case = hard(name, views, dtype)
    with mpmath.workdps(DIGITS):
        known = oracle(name, views, dtype)
        exact, exact_in_world = known.exact[frame], known.exact["world"]
        by_svd, by_world_svd = known.by_svd[frame], known.by_svd["world"]
        with by(way):
            found = triangulate(case.proj, case.pixels, case.weights, frame=frame)
        # Noise of 1000 baselines leaves little to the world's frame: most points lie behind.
        assert found.valid.sum() >= (2 if "baselines" in name else COUNT // 2)
        ours, theirs = [], []
        for index in range(COUNT):
            if not bool(found.valid[index]):
                continue
            place = mpmath.matrix([float(found.points[index, i]) for i in range(3)])
            # A point cannot be stored better than its largest coordinate's rounding.
            largest = max(abs(exact[index][i]) for i in range(3)) / (DEPTH * case.unit)
            floor = 4 * torch.finfo(dtype).eps * float(max(1, largest))
            ours.append(max(error(place, exact[index], case) - floor, 0.0))
            # The exact rig frame is a gift: no one has it who is given the world's cameras, whose
            # own rounding is what an SVD of the world's rows shows.
            in_world = error(by_world_svd[index], exact_in_world[index], case)
            theirs.append(max(error(by_svd[index], exact[index], case), in_world))
    assert max(ours) <= 3 * max(theirs), f"{max(ours):.1e}, an SVD {max(theirs):.1e}"
    middle = sorted(ours)[len(ours) // 2], sorted(theirs)[len(theirs) // 2]
    assert middle[0] <= 3 * middle[1], f"{middle[0]:.1e}, an SVD {middle[1]:.1e}: medians"


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("name", CASES)
def test_in_the_rig_frame_float32_loses_only_what_its_outputs_cannot_hold(
    name: str, way: str
) -> None:
    case = hard(name, 5, torch.float32)
    with by(way):
        single = triangulate(case.proj, case.pixels, case.weights)
        double = triangulate(*(tensor.double() for tensor in case[:3]))
    both = single.valid & double.valid
    assert both.sum() >= COUNT // 2
    apart = (single.points.double() - double.points).abs().amax(dim=-1)
    largest = double.points.abs().amax(dim=-1).clamp(min=DEPTH * case.unit)
    # Half a rounding, and where weights are extreme what the squared rows lose of float64.
    assert (apart[both] <= 4 * torch.finfo(torch.float32).eps * largest[both]).all()


def test_at_one_degree_the_cost_is_almost_the_least_there_is() -> None:
    clean = hard("1 degree", 5, torch.float64, count=2000)
    generator = torch.Generator().manual_seed(1)
    noise = torch.randn(clean.pixels.shape, generator=generator, dtype=torch.float64)
    pixels = clean.pixels + noise
    points = triangulate_points(clean.proj, pixels)
    best = refine_points(clean.proj, pixels, points, steps=20)
    assert best.valid.all()
    ones = torch.ones_like(clean.weights)
    cost = reprojection_residual(clean.proj, points, pixels, ones).square().mean()
    least = best.residual.square().mean()
    assert least <= cost <= 1.001 * least
    # 10 equations, 3 unknowns: 7 px^2 over 5 views.
    assert 1.3 < least < 1.5
