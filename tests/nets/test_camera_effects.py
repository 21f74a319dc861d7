"""Vignetting, rolling exposure and blurred corners."""

from collections.abc import Callable

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from stand_in_device import DEVICE, on_device, one_device
from torch import Tensor, nn
from torch.testing import assert_close

from deltas_nets.datasets.augment import Photometry
from deltas_nets.datasets.camera_effects import (
    CORNER_SIGMA,
    RandomCornerBlur,
    RandomRollingExposure,
    RandomVignetting,
    blur_corners,
    exposure_wave,
    vignetting_gain,
)

EFFECTS = [RandomCornerBlur, RandomVignetting, RandomRollingExposure]
SIZES = st.tuples(st.integers(1, 40), st.integers(1, 40))
CORNERS = st.floats(0.3, 1.0)


def gain_of(corner: float, size: tuple[int, int]) -> Tensor:
    return vignetting_gain(torch.tensor([corner], dtype=torch.float64), image_size=size)[0, 0]


def radii(size: tuple[int, int]) -> Tensor:
    """Distance of each pixel from the image's centre, in px."""
    y, x = (torch.arange(length).double() - (length - 1) / 2 for length in size)
    return torch.hypot(y[:, None], x)


def wave_of(amplitude: float, periods: float, phase: float, length: int) -> Tensor:
    drawn = (torch.tensor([value], dtype=torch.float64) for value in (amplitude, periods, phase))
    return exposure_wave(*drawn, length=length)[0]


WAVES = st.builds(
    wave_of, st.floats(0, 0.15), st.floats(0.5, 3.0), st.floats(0, 1), st.integers(1, 50)
)


@given(corner=CORNERS, half=SIZES)
def test_vignetting_leaves_the_centre(corner: float, half: tuple[int, int]) -> None:
    gain = gain_of(corner, (2 * half[0] + 1, 2 * half[1] + 1))
    assert gain[half] == 1
    assert gain.max() == 1


@given(corner=CORNERS, size=SIZES)
def test_vignetting_is_the_same_all_around(corner: float, size: tuple[int, int]) -> None:
    gain = gain_of(corner, size)
    assert_close(gain, gain.flip(0), rtol=0, atol=0)
    assert_close(gain, gain.flip(1), rtol=0, atol=0)
    assert_close(gain, gain_of(corner, size[::-1]).T, rtol=0, atol=1e-15)


@given(corner=CORNERS, size=SIZES)
def test_vignetting_falls_with_the_radius(corner: float, size: tuple[int, int]) -> None:
    outwards = gain_of(corner, size).flatten()[radii(size).flatten().argsort()]
    assert (outwards.diff() <= 1e-15).all()
    assert outwards[-1] >= corner - 1e-15  # which holds half a pixel further out


@given(corner=CORNERS, size=SIZES)
def test_vignetting_is_the_fourth_power_of_a_cosine(corner: float, size: tuple[int, int]) -> None:
    # A camera whose corners are at the angle with that gain.
    steepest = torch.tensor(corner, dtype=torch.float64).pow(0.25).acos()
    focal = torch.hypot(*torch.tensor(size).double() / 2) / steepest.tan().clamp(min=1e-12)
    angle = torch.atan2(radii(size), focal)
    assert_close(gain_of(corner, size), angle.cos() ** 4, rtol=0, atol=1e-12)


@given(wave=WAVES)
def test_exposure_stays_within_its_amplitude(wave: Tensor) -> None:
    assert ((wave - 1).abs() <= 0.15 + 1e-12).all()
    assert (wave.mean() - 1).abs() <= 0.15 + 1e-12


@given(periods=st.integers(1, 3), phase=st.floats(0, 1), length=st.integers(8, 50))
def test_exposure_waves_as_often_as_it_says(periods: int, phase: float, length: int) -> None:
    spectrum = torch.fft.rfft(wave_of(0.15, periods, phase, length)) / length
    expected = torch.zeros_like(spectrum)
    expected[0] = 1  # whole waves keep the mean
    at_first_row = 2 * torch.pi * (phase + 0.5 * periods / length)
    turned = torch.tensor([0.15 / 2, at_first_row - torch.pi / 2], dtype=torch.float64)
    expected[periods] = torch.polar(*turned)
    assert_close(spectrum, expected, rtol=0, atol=1e-12)


@given(shade=st.floats(0, 1), strength=st.floats(0, 1), size=SIZES)
def test_a_plain_image_has_nothing_to_blur(
    shade: float, strength: float, size: tuple[int, int]
) -> None:
    images = torch.full((1, 3, *size), shade)
    assert_close(blur_corners(images, torch.tensor([strength])), images, rtol=0, atol=1e-6)


@given(seed=st.integers(0, 99), strength=st.floats(0, 1), half=SIZES)
def test_the_centre_stays_sharp(seed: int, strength: float, half: tuple[int, int]) -> None:
    size = (2 * half[0] + 1, 2 * half[1] + 1)
    images = torch.rand(2, 3, *size, generator=torch.Generator().manual_seed(seed))
    blurred = blur_corners(images, torch.tensor([strength, 0.0]))
    assert (blurred[0, :, half[0], half[1]] == images[0, :, half[0], half[1]]).all()
    assert (blurred[1] == images[1]).all()


def test_stripes_fade_towards_the_corners() -> None:
    images = torch.arange(64).remainder(2).float().expand(1, 3, 48, 64)
    contrast = (blur_corners(images, torch.ones(1)) - 0.5).abs()[0, 0]
    # Taps of both neighbours cancel: stripes one pixel wide vanish under a blur this wide.
    share = radii((48, 64)).square().float() / (24**2 + 32**2)
    inside = slice(4, -4)
    assert_close(contrast[:, inside], 0.5 * (1 - share)[:, inside], rtol=0, atol=0.01)


def test_corners_are_blurred_by_a_gaussian() -> None:
    images = torch.zeros(1, 1, 201, 201)
    images[0, 0, 5, 5] = 1
    blurred = blur_corners(images, torch.ones(1))[0, 0]
    share = (2 * 95**2) / (2 * 100.5**2)
    taps = torch.exp(-(torch.arange(-3.0, 4) ** 2) / (2 * CORNER_SIGMA**2))
    taps = taps / taps.sum()
    assert_close(blurred[5, 5], 1 - share + share * taps[3] ** 2, rtol=0, atol=1e-6)
    assert_close(blurred[4, 7], share * taps[2] * taps[5], rtol=0, atol=2e-3)


@pytest.mark.parametrize("effect", EFFECTS)
def test_images_keep_shape_dtype_and_range(
    effect: Callable[..., nn.Module], dtype: torch.dtype
) -> None:
    for size in ((1, 1), (2, 31), (24, 32)):
        images = torch.rand(6, 3, *size, dtype=dtype)
        images[0], images[1] = 0, 1
        changed = effect(p=1.0)(images)
        assert (changed.shape, changed.dtype) == (images.shape, dtype)
        assert ((changed >= 0) & (changed <= 1)).all()  # NaN would fail


@pytest.mark.parametrize("effect", [RandomVignetting, RandomRollingExposure])
def test_light_keeps_its_colour(effect: Callable[..., nn.Module]) -> None:
    changed = effect(p=1.0)(torch.full((8, 3, 24, 32), 0.5))
    assert (changed == changed[:, :1]).all()
    assert (changed[:, 0].flatten(1).std(dim=1) > 1e-4).all()


def test_bands_lie_along_rows_or_columns() -> None:
    torch.manual_seed(0)
    changed = RandomRollingExposure(amplitude=(0.1, 0.15), p=1.0)(torch.full((32, 1, 24, 40), 0.5))
    by_row = (changed == changed[..., :1]).flatten(1).all(dim=1)
    by_column = (changed == changed[..., :1, :]).flatten(1).all(dim=1)
    assert (by_row ^ by_column).all()
    assert by_row.any() and by_column.any()


@pytest.mark.parametrize("effect", EFFECTS)
def test_about_p_of_all_images_are_changed_each_by_its_own_strength(
    effect: Callable[..., nn.Module],
) -> None:
    torch.manual_seed(0)
    images = torch.rand(3, 12, 16).expand(400, 3, 12, 16)
    changed = effect(p=0.3)(images)
    touched = (changed != images).flatten(1).any(dim=1)
    assert 90 < touched.sum() < 150
    assert len(changed[touched].flatten(1).unique(dim=0)) == touched.sum()


def test_strengths_fill_their_ranges() -> None:
    torch.manual_seed(0)
    for step in list(Photometry().steps)[: len(EFFECTS)]:
        strengths = step.forward_parameters((2000, 3, 8, 8))
        for name, (low, high) in step.flags.items():
            near = 0.01 * (high - low)
            assert low <= strengths[name].min() < low + near
            assert high - near < strengths[name].max() <= high


@pytest.mark.parametrize("effect", EFFECTS)
def test_what_the_device_draws_and_changes_stays_there(
    effect: Callable[..., nn.Module],
) -> None:
    change = effect(p=0.5)
    with one_device() as copies:
        change.set_rng_device_and_dtype(DEVICE, torch.float32)
        changed = change(torch.rand(4, 3, 24, 32, device=DEVICE))
    assert on_device(changed) and not copies


@given(seed=st.integers(0, 2**31), rooms=st.integers(1, 4), data=st.data())
def test_a_room_sees_the_same_in_any_company(seed: int, rooms: int, data: st.DataObject) -> None:
    photometry = Photometry()
    photometry.steps = nn.Sequential(*(effect(p=0.5) for effect in EFFECTS))
    place = data.draw(st.integers(0, rooms - 1))
    images = torch.rand(rooms, 2, 3, 8, 10, generator=torch.Generator().manual_seed(0))
    together = photometry(images, seed)
    alone = photometry(images[place : place + 1], seed, first=place, places=rooms)
    assert_close(alone[0], together[place], rtol=0, atol=1e-6)


def test_photometry_repeats_itself_by_seed() -> None:
    images = torch.rand(2, 3, 3, 24, 32, generator=torch.Generator().manual_seed(0))
    torch.manual_seed(0)
    first = Photometry()(images, seed=5)
    torch.manual_seed(1)
    assert torch.equal(Photometry()(images, seed=5), first)
    assert not torch.equal(Photometry()(images, seed=6), first)


def test_photometry_has_all_three_before_the_tone_curve() -> None:
    names = [type(step).__name__ for step in Photometry().steps]
    assert names[:4] == [effect.__name__ for effect in EFFECTS] + ["RandomGamma"]
