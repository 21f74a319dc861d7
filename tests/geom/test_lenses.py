"""Lenses there and back: whatever the model, a ray is right or there is none."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from lens_cases import CASES, TURNING, Array, Case, on_plane, pixels_of, seen_from_the_axis
from torch import Tensor
from torch.testing import assert_close

import deltas_geom as geom
from deltas_geom import Lens
from deltas_geom.cameras.lenses.many import MANY
from deltas_geom.cameras.lenses.tables import table_of
from deltas_geom.testing.strategies import vectors

ALL = CASES | TURNING
EACH = pytest.mark.parametrize("name", ALL)
SLOPES = {"SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "OPENCV_THIN_PRISM"}
ANGLES = {"SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE", "THIN_PRISM_FISHEYE"}
MODELS = pytest.mark.parametrize("model", CASES)


def test_there_is_a_case_of_every_model() -> None:
    assert set(CASES) == set(Lens.models())


def test_names_and_counts_that_are_wrong_are_told_with_the_right_ones() -> None:
    K = torch.eye(3)
    with pytest.raises(ValueError, match="did you mean OPENCV_FISHEYE"):
        Lens(K, torch.zeros(4), "OPENCV_FISHEY")
    with pytest.raises(ValueError, match="OPENCV"):
        Lens(K, torch.zeros(4), "xyz")
    with pytest.raises(geom.ShapeError, match=r"OPENCV must be 4 \(k1 k2 p1 p2\), got 5"):
        Lens(K, torch.zeros(5), "OPENCV")
    with pytest.raises(geom.ShapeError, match=r"RADIAL must be 5 \(f cx cy k1 k2\), got 4"):
        Lens.from_colmap("RADIAL", [1.0, 0, 0, 0])
    with pytest.raises(geom.ShapeError, match="4, 5, 8, 12 or 14 coefficients, got"):
        Lens.from_opencv(K, torch.zeros(6))
    with pytest.raises(ValueError, match="tilt"):
        Lens.from_opencv(K, torch.ones(14))
    with pytest.raises(geom.ShapeError, match="K must have shape"):
        Lens(torch.eye(4), torch.zeros(4), "OPENCV")
    with pytest.raises(geom.ShapeError, match=r"\(48, 64, 3\): use image.movedim\(-1, -3\)"):
        geom.undistort_image(Lens(K, torch.zeros(4), "OPENCV"), torch.rand(48, 64, 3))
    with pytest.raises(TypeError, match="coefficients must be"):
        Lens(K, [0.0] * 4, "OPENCV")


def assert_there_and_back(case: Case, pixels: Tensor) -> Tensor:
    """Returns which pixels were valid."""
    lens = case.lens()
    rays, valid = lens.unproject(pixels)
    assert rays.isfinite().all() and (rays[~valid] == 0).all()
    lengths = rays.norm(dim=-1)
    assert_close(lengths, valid.double(), rtol=0, atol=1e-14)
    again, seen = lens.project(rays)
    assert again.isfinite().all() and (again[~seen] == 0).all()
    assert float((seen != valid).double().mean()) < 1e-3 or len(pixels) < 1000
    both = (seen & valid).unsqueeze(-1)
    assert_close(torch.where(both, again, pixels), pixels, rtol=0, atol=1e-9)  # px
    return valid


@EACH
def test_a_pixel_comes_back_or_is_masked(name: str) -> None:
    case = ALL[name]
    valid = assert_there_and_back(case, pixels_of(5000))
    share = float(valid.double().mean())
    assert abs(share - case.share) < 0.02 if name in TURNING else share == 1


@pytest.mark.slow
@EACH
def test_a_million_pixels_come_back(name: str) -> None:
    assert_there_and_back(ALL[name], pixels_of(1_000_000, seed=1))


@EACH
@settings(max_examples=20)
@given(places=vectors(6, within=1.0), size=st.sampled_from([1e-3, 1.0, 1e3]))
def test_a_point_comes_back_as_its_own_ray_or_is_masked(
    name: str, places: Tensor, size: float
) -> None:
    lens = ALL[name].lens()
    points = size * (places + torch.tensor([0, 0, 1.0]))
    pixels, valid = lens.project(points)
    rays, found = lens.unproject(pixels)
    wanted = points / points.norm(dim=-1, keepdim=True).clamp(min=1e-300)
    # Where it is found at all: close to the end of the domain pixels are dense.
    both = (found & valid).unsqueeze(-1)
    assert_close(torch.where(both, rays, wanted), wanted, rtol=0, atol=1e-5)


@pytest.mark.parametrize("name", [n for n in ALL if ALL[n].model in SLOPES | ANGLES])
def test_the_mask_is_the_domain_that_can_be_seen_from_the_axis(name: str) -> None:
    case, pixels = ALL[name], pixels_of(4000)
    found = case.lens().unproject(pixels).valid.numpy()
    assert np.mean(found == seen_from_the_axis(case, pixels)) >= 0.999


@pytest.mark.parametrize("zero", [0.0, -0.0, 1e-300])
@pytest.mark.parametrize("model", [model for model in CASES if CASES[model].coefficients])
def test_without_distortion_a_lens_is_ideal(model: str, zero: float) -> None:
    lens, pixels = CASES[model].lens(), pixels_of(200)
    coefficients = torch.full_like(lens.coefficients, zero)
    if model == "EUCM":
        coefficients[1] = 1
    rays, valid = Lens(lens.K, coefficients, model).unproject(pixels)
    ideal = Lens(lens.K, coefficients[:0], "FISHEYE" if "FISHEYE" in model else "PINHOLE")
    assert valid.all()
    assert_close(rays, ideal.unproject(pixels).rays, rtol=0, atol=1e-14)
    seen = Lens(lens.K, coefficients, model).project(rays)
    assert seen.valid.all()
    assert_close(seen.pixels, pixels, rtol=0, atol=1e-10)


@EACH
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_many_pixels_have_the_rays_that_few_have(name: str, dtype: torch.dtype) -> None:
    lens, pixels = ALL[name].lens(dtype), pixels_of(MANY + 1000).to(dtype)
    lens.K[0, 1] = 3.0
    odd = torch.tensor([[math.nan, 0], [math.inf, 1], [1e20, 1e20], [-9e3, 4e3], [655, 470]])
    pixels[100:105] = odd.to(dtype)
    rays, valid = lens.unproject(pixels)
    few = [lens.unproject(some) for some in pixels.split(MANY // 2)]
    assert torch.equal(valid, torch.cat([part.valid for part in few]))
    error = 1e-12 if dtype == torch.float64 else 1.2e-7
    assert_close(rays, torch.cat([part.rays for part in few]), rtol=0, atol=error)


@pytest.mark.parametrize(
    "name", ["OPENCV_FISHEYE", "barrel", "OPENCV", "RAD_TAN_THIN_PRISM_FISHEYE"]
)
def test_many_pixels_have_the_derivatives_that_few_have(name: str) -> None:
    lens, pixels = ALL[name].lens(), pixels_of(MANY).reshape(2, -1, 2)
    weights = torch.linspace(-1, 1, 3).double()
    given = [t.clone().requires_grad_() for t in (lens.K, lens.coefficients, pixels)]
    through = Lens(given[0], given[1], lens.model)
    many = torch.autograd.grad((through.unproject(given[2]).rays * weights).sum(), given)
    parts = [(through.unproject(row).rays * weights).sum() for row in given[2]]
    assert_close(many, torch.autograd.grad(sum(parts[1:], parts[0]), given), rtol=1e-9, atol=1e-9)


@settings(max_examples=15)
@given(k=vectors(1, within=0.1, size=4))
def test_a_fisheye_sees_as_far_as_its_radius_grows(k: Tensor) -> None:
    lens = Lens(CASES["OPENCV_FISHEYE"].lens().K, k[0], "OPENCV_FISHEYE")
    pixels = pixels_of(MANY + 1)
    angle = np.linspace(0, np.pi, 400_001)
    radius = angle * (1 + sum(c * angle ** (2 * i + 2) for i, c in enumerate(k[0].tolist())))
    falls = np.diff(radius) <= 0
    farthest = radius[falls.argmax()] if falls.any() else radius[-1]
    distance = np.linalg.norm(on_plane(lens, pixels), axis=-1)
    seen = lens.unproject(pixels).valid.numpy()
    assert np.mean(seen == (distance < farthest)) > 0.999
    rays = lens.unproject(pixels).rays[torch.from_numpy(seen)].numpy()
    found = np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2])
    turns = falls.argmax() if falls.any() else len(angle) - 1
    exact = np.interp(distance[seen], radius[: turns + 1], angle[: turns + 1])
    inner = distance[seen] < 0.9 * farthest
    assert np.abs(found - exact)[inner].max(initial=0.0) < 1e-8


def test_a_table_is_read_where_it_is_exact_and_nowhere_else() -> None:
    def function(s: Array) -> tuple[Array, Array]:
        return np.exp(-s) + np.where(s > 0.7, s - 0.7, 0), s < 0.9

    table = table_of(function, 1.0, 1e-13)
    assert table is not None
    assert 0.6 < table.exact <= 0.7 and 0.85 < table.ends <= 0.95
    s = np.linspace(0, table.exact, 10_001)[:-1]
    place, work, out = np.empty((3, len(s)))
    table.read(s, place, np.empty(len(s), np.intp), work, out)
    assert np.abs(out - np.exp(-s)).max() < 2e-15
    assert table_of(lambda s: (np.abs(s - 0.01), s < 9), 1.0, 1e-13) is None
    assert table_of(lambda s: (s * np.nan, s < 0), 1.0, 1e-13) is None
    assert table_of(lambda s: (np.cos(30 * s), s < 9), 1.0, 1e-13) is None  # too coarse


@pytest.mark.parametrize("model", ["OPENCV", "FOV", "THIN_PRISM_FISHEYE"])
def test_a_compiled_lens_is_the_same(model: str) -> None:
    lens = CASES[model].lens()
    points = 2 * lens.unproject(pixels_of(60)).rays

    def project(K: Tensor, coefficients: Tensor, points: Tensor) -> tuple[Tensor, ...]:
        return tuple(Lens(K, coefficients, model).project(points))

    compiled = torch.compile(project, fullgraph=True, backend="aot_eager")
    given = lens.K, lens.coefficients, points
    assert_close(compiled(*given), project(*given), rtol=0, atol=1e-9)


@MODELS
def test_single_precision_is_as_good_as_its_pixels(model: str) -> None:
    case, pixels = CASES[model], pixels_of(5000)
    lens = case.lens(torch.float32)
    single = pixels.float()
    rays, valid = lens.unproject(single)
    exact, known = lens.to(torch.float64).unproject(single.double())
    assert rays.dtype == torch.float32 and torch.equal(valid, known)
    assert_close(rays.double(), exact, rtol=0, atol=6e-8)
    again = lens.project(rays).pixels
    condition = 1 / exact[valid][:, 2].abs().clamp(min=0.05).min().item() ** 2
    assert float((again - single)[valid].abs().max()) < 2e-4 * condition


@MODELS
def test_derivatives_are_those_of_differences(model: str) -> None:
    case, pixels = CASES[model], pixels_of(5, seed=3)
    lens = case.lens()
    points = 2 * lens.unproject(pixels).rays
    there = lambda K, c, x: Lens(K, c, model).project(x).pixels  # noqa: E731
    back = lambda K, c, x: Lens(K, c, model).unproject(x).rays  # noqa: E731
    for function, items in ((there, points), (back, pixels)):
        given = [t.clone().requires_grad_() for t in (lens.K, lens.coefficients, items)]
        assert torch.autograd.gradcheck(function, given, atol=2e-4, rtol=1e-4, eps=1e-6)


@pytest.mark.parametrize("model", ["OPENCV", "OPENCV_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE"])
def test_second_derivatives_are_those_of_differences(model: str) -> None:
    lens, pixels = CASES[model].lens(), pixels_of(2, seed=3)
    given = [t.clone().requires_grad_() for t in (lens.K, lens.coefficients, pixels)]
    back = lambda K, c, x: Lens(K, c, model).unproject(x).rays  # noqa: E731
    assert torch.autograd.gradgradcheck(back, given, atol=1e-4, rtol=1e-3, eps=1e-6)


@EACH
def test_on_the_axis_derivatives_are_finite(name: str) -> None:
    lens = ALL[name].lens()
    center = lens.K[:2, 2][None].clone().requires_grad_()
    rays, valid = lens.unproject(center)
    assert valid.all() and rays.tolist() == [[0, 0, 1]]
    (slope,) = torch.autograd.grad(rays.sum(), center)
    gain = 1.0
    if ALL[name].model == "FOV":
        omega = ALL[name].coefficients[0]
        gain = 2 * math.tan(omega / 2) / omega
    assert_close(slope[0], 1 / lens.K.diagonal()[:2] / gain)
    axis = torch.tensor([[0.0, 0, 2], [0, 0, -2]], dtype=torch.float64, requires_grad=True)
    pixels, seen = lens.project(axis)
    (slope,) = torch.autograd.grad(pixels.sum(), axis)
    assert_close(pixels[0], center[0].detach()) and seen[0]
    assert_close(slope[0, :2], lens.K.diagonal()[:2] / 2 * gain)
    if ALL[name].model != "EQUIRECTANGULAR":
        assert not seen[1] and (slope[1] == 0).all()


def test_what_was_measured_beyond_the_turn_of_the_polynomial_is_masked() -> None:
    lens = TURNING["barrel"].lens()
    turn = 1 / math.sqrt(3 * 0.2)  # of r - 0.2 r^3
    points = torch.tensor([[turn * 0.999, 0, 1], [turn * 1.001, 0, 1], [2.0, 0, 1]]).double()
    assert lens.project(points).valid.tolist() == [True, False, False]
    last = 655 + 500 * (2 / 3) * turn  # px
    pixels = torch.tensor([[last - 1e-3, 470], [last + 1e-3, 470], [1279.0, 959.0]]).double()
    rays, valid = lens.unproject(pixels.requires_grad_())
    assert valid.tolist() == [True, False, False]
    (slope,) = torch.autograd.grad(rays.sum(), pixels)
    assert (slope[1:] == 0).all() and slope.isfinite().all()


@MODELS
def test_of_the_points_all_around_none_is_seen_where_another_is(model: str) -> None:
    lens, generator = CASES[model].lens(), torch.Generator().manual_seed(0)
    points = torch.randn(1000, 3, generator=generator, dtype=torch.float64)
    points = points / points.norm(dim=-1, keepdim=True)
    pixels, seen = lens.project(points)
    rays, valid = lens.unproject(pixels[seen])
    assert_close(rays[valid], points[seen][valid], rtol=0, atol=1e-6)
    assert valid.double().mean() > 0.99  # but at the rim


def test_behind_the_camera_a_fisheye_sees_and_a_pinhole_does_not() -> None:
    beyond = {"EQUIRECTANGULAR", "SIMPLE_DIVISION", "EUCM"}
    behind = torch.tensor([[1.0, 0.5, -0.2]]).double()
    for model, case in CASES.items():
        seen = case.lens().project(behind).valid
        assert bool(seen) == ("FISHEYE" in model or model in beyond)


@EACH
@pytest.mark.parametrize("value", [math.nan, math.inf, -1e300, 1e-300])
def test_numbers_without_sense_are_masked_or_right_and_never_nan(name: str, value: float) -> None:
    lens = ALL[name].lens()
    odd = torch.full((1, 3), value, dtype=torch.float64)
    given = [odd, odd[:, :2], lens.K, lens.coefficients]
    for spoilt in range(4):
        points, pixels, K, coefficients = (
            torch.full_like(t, value) if k == spoilt else t
            for k, t in enumerate([odd.new_ones(1, 3), odd.new_ones(1, 2), *given[2:]])
        )
        inputs = [t.clone().requires_grad_() for t in (K, coefficients, points, pixels)]
        through = Lens(inputs[0], inputs[1], lens.model)
        results = [through.project(inputs[2])[0], through.unproject(inputs[3])[0]]
        assert all(result.isfinite().all() for result in results)
        gradients = torch.autograd.grad(sum(r.sum() for r in results), inputs, allow_unused=True)
        assert not any(g.isnan().any() for g in gradients if g is not None)


@EACH
def test_a_pixel_that_was_not_seen_stays_so(name: str) -> None:
    lens, odd = ALL[name].lens(), torch.tensor([[math.nan, 1], [1, math.inf], [1e9, 1]]).double()
    pixels, valid = geom.undistort_pixels(lens, odd.requires_grad_())
    assert pixels[:2].isnan().all() and pixels[2].isfinite().all() and not valid[:2].any()
    (slope,) = torch.autograd.grad(pixels[2].sum(), odd)
    assert slope.isfinite().all()


def test_lenses_of_a_batch_broadcast_with_points() -> None:
    case = CASES["OPENCV"]
    lens, pixels = case.lens(), pixels_of(7)
    many = Lens(lens.K.expand(2, 1, 3, 3), lens.coefficients.expand(3, 4), "OPENCV")
    found = many.unproject(pixels)
    assert found.rays.shape == (2, 3, 7, 3) and found.valid.shape == (2, 3, 7)
    assert_close(found.rays, lens.unproject(pixels).rays.expand(2, 3, 7, 3))
    plain = Lens(lens.K, lens.K.new_zeros(5, 0), "PINHOLE")
    assert plain.project(found.rays[0, 0]).pixels.shape == (5, 7, 2)
    with pytest.raises(geom.ShapeError, match="broadcast"):
        many.unproject(pixels.expand(4, 7, 2))
