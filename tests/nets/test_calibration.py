"""Uncertainty on errors of known size: measured right, mended right, kept in files."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from rich.console import Console
from run_command import Run, assert_one_line

from deltas_nets import load_model
from deltas_nets.captures.opening import open_capture
from deltas_nets.captures.posed_images import PosedImages
from deltas_nets.captures.view_choice import choose_view_sets
from deltas_nets.commands import calibrate
from deltas_nets.config import DetectorConfig, NetworkConfig
from deltas_nets.errors import UserError
from deltas_nets.evaluate.calibration import CalibrationMeter
from deltas_nets.evaluate.capture import evaluate_network
from deltas_nets.evaluate.fit_calibration import fit_calibration, fit_curve
from deltas_nets.evaluate.rooms import (
    CALIBRATION_SEEDS,
    EVALUATION_SEEDS,
    DisturbedRooms,
    held_out_rooms,
)
from deltas_nets.network.deltas import Deltas
from deltas_nets.network.lite.calibration import NUM_KNOTS, VIEWS, Curve, SpreadCalibration
from deltas_nets.predict.depth_map import PredictConfig, frames_of
from deltas_nets.predict.encoded_frames import EncodedFrames
from deltas_nets.predict.ours import DeltasPredictor, predict_frame
from deltas_nets.rooms import Rooms
from deltas_nets.terminal import table_console
from deltas_nets.weights_file import load_weights, read_metadata, save_weights

MakeCapture = Callable[..., Path]
Array = NDArray[np.float64]
Draw = Callable[[np.random.Generator, Array], Array]

PIXELS = 200_000

ERRORS: dict[str, Draw] = {
    "laplace": lambda random, std: random.laplace(size=std.shape) * std / 2**0.5,
    "normal": lambda random, std: random.normal(size=std.shape) * std,
    # Student's t with 5 degrees of freedom has variance 5/3, and a tail heavier than Laplace's.
    "heavy": lambda random, std: random.standard_t(5, size=std.shape) * std * 0.6**0.5,
}
LAPLACE_RATIO = {"laplace": 1.0, "normal": 2 / np.pi**0.5, "heavy": 1.0392}
"""sqrt(2) E|e| of unit variance; of t5 it is sqrt(2) 8 / (3 pi sqrt(5)) sqrt(3 / 5) 5 / 4."""


def spread_of(random: np.random.Generator, count: int = PIXELS) -> Array:
    """Standard deviations from 1 % to 30 %, as networks predict them."""
    return np.exp(random.uniform(np.log(0.01), np.log(0.3), count))


def measured(std: Array, error: Array, *, maps: int = 4) -> CalibrationMeter:
    """A meter that saw pixels with these errors of log depth."""
    meter = CalibrationMeter()
    truth = np.full(len(std), 2.0)
    for part in np.array_split(np.arange(len(std)), maps):
        meter.add(2.0 * np.exp(error[part]), std[part], truth[part], depth_range=(0.5, 10.0))
    return meter


def tiny(seed: int = 0) -> Deltas:
    torch.manual_seed(seed)
    return Deltas(NetworkConfig(name="mine", detector=DetectorConfig(num_keypoints=32))).eval()


# Measuring


@pytest.mark.parametrize("kind", ERRORS)
def test_a_perfect_prediction_has_ratio_one_in_every_decile(kind: str) -> None:
    random = np.random.default_rng(1)
    std = spread_of(random)
    found = measured(std, ERRORS[kind](random, std)).result()
    assert found.pixels == PIXELS
    for decile in found.deciles:
        assert decile.rms_ratio == pytest.approx(1, abs=0.1)
        assert decile.laplace_ratio == pytest.approx(LAPLACE_RATIO[kind], abs=0.05)


@settings(max_examples=20)
@given(factor=st.floats(0.1, 10), kind=st.sampled_from(sorted(ERRORS)))
def test_scaling_the_prediction_scales_the_ratios(factor: float, kind: str) -> None:
    random = np.random.default_rng(2)
    std = spread_of(random, 20_000)
    error = ERRORS[kind](random, std)
    once = measured(std, error).result()
    scaled = measured(factor * std, error).result()
    for one, other in zip(once.deciles, scaled.deciles, strict=True):
        assert other.std == pytest.approx(factor * one.std, rel=0.01)
        assert other.rms_ratio == pytest.approx(one.rms_ratio / factor, rel=0.03)
        assert other.laplace_ratio == pytest.approx(one.laplace_ratio / factor, rel=0.03)
    # Not to the last digit: pooled halves are cut within a bin.
    assert scaled.sparsification == pytest.approx(once.sparsification, rel=0.01)
    assert scaled.sparsification[:2] == once.sparsification[:2]


def test_deciles_agree_with_sorting_all_pixels() -> None:
    random = np.random.default_rng(3)
    std = spread_of(random, 50_000)
    error = ERRORS["heavy"](random, std**1.5)  # not calibrated: nothing is 1 by chance
    found = measured(std, error).result().deciles
    for part, decile in zip(np.array_split(np.argsort(std), 10), found, strict=True):
        assert decile.std == pytest.approx(std[part].mean(), rel=2e-3)
        assert decile.rms == pytest.approx(np.sqrt((error[part] ** 2).mean()), rel=0.01)
        assert decile.laplace == pytest.approx(2**0.5 * np.abs(error[part]).mean(), rel=0.01)


@settings(max_examples=20)
@given(maps=st.integers(1, 9))
def test_deciles_do_not_depend_on_how_pixels_are_spread_over_maps(maps: int) -> None:
    random = np.random.default_rng(4)
    std = spread_of(random, 5_000)
    error = ERRORS["laplace"](random, std)
    one, other = (measured(std, error, maps=count).result() for count in (1, maps))
    assert np.array(one.deciles) == pytest.approx(np.array(other.deciles))


def test_a_perfect_order_halves_best_and_a_random_one_does_nothing() -> None:
    random = np.random.default_rng(5)
    error = np.abs(random.normal(size=40_000)) * 0.05
    perfect = measured(error + 1e-6, error).result().sparsification
    reverse = measured(1 / (error + 1e-6), error).result().sparsification
    chance = measured(spread_of(random, 40_000), error).result().sparsification
    relative = np.sort(np.exp(error) - 1)
    assert perfect.every == pytest.approx(relative.mean(), rel=1e-6)
    assert perfect.half == pytest.approx(relative[:20_000].mean(), rel=0.01)
    assert chance.ratio == pytest.approx(1, abs=0.03)
    assert chance.pooled_ratio == pytest.approx(1, abs=0.03)
    assert perfect.pooled_ratio == pytest.approx(perfect.ratio, rel=0.01)
    assert reverse.half + perfect.half == pytest.approx(2 * perfect.every, rel=1e-3)


def test_each_map_keeps_its_own_half() -> None:
    meter = CalibrationMeter()
    # A map without error beside a bad one whose order is right: pooled halves would be perfect.
    meter.add([2.0, 2.0, 2.0, 2.0], [0.01] * 4, [2.0] * 4)
    meter.add([2.0, 2.2, 3.0, 3.0], [0.1, 0.2, 0.3, 0.4], [2.0] * 4)
    found = meter.result().sparsification
    assert found.every == pytest.approx((0 + (0 + 0.1 + 0.5 + 0.5) / 4) / 2)
    assert found.half == pytest.approx((0 + (0 + 0.1) / 2) / 2)
    assert found.pooled_every == pytest.approx((0.1 + 0.5 + 0.5) / 8)
    assert found.pooled_half == pytest.approx(0)


def test_what_has_no_truth_or_no_prediction_counts_nowhere() -> None:
    meter = CalibrationMeter()
    meter.add([2.0, 2.0], [0.1, 0.1], [0.0, 11.0])
    assert meter.empty
    with pytest.raises(ValueError, match="no depth map"):
        meter.result()
    nan, inf = float("nan"), float("inf")
    meter.add([0.0, nan, inf, 2.2], [0.1, 0.1, 0.1, 0.1], [2.0, 2.0, 2.0, nan])
    assert meter.empty
    meter.add([2.2, 2.2, 2.2, 2.2], [0.1, nan, inf, 0.0], [2.0, 2.0, 2.0, 2.0])
    assert meter.result().pixels == 1
    assert meter.result().sparsification.half == pytest.approx(0.1)
    with pytest.raises(ValueError, match="shapes differ"):
        meter.add([1.0], [1.0, 1.0], [1.0])


# Fitting


def corrected(curve: Curve, std: Array) -> Array:
    """What a calibrated network would predict."""
    changed: Array = curve(torch.tensor(std).log()).exp().double().numpy()
    return changed


@settings(max_examples=10)
@given(shift=st.floats(-1.5, 1.5), slope=st.floats(0.4, 2.0))
def test_a_fit_recovers_a_power_law(shift: float, slope: float) -> None:
    random = np.random.default_rng(6)
    std = spread_of(random, 40_000)
    right = np.exp(shift) * std**slope
    curve = fit_curve(measured(std, ERRORS["laplace"](random, right)))
    inside = np.linspace(float(curve.knots[0]), float(curve.knots[-1]), 20)
    found = corrected(curve, np.exp(inside))
    assert np.log(found) == pytest.approx(shift + slope * inside, abs=0.1)


@pytest.mark.parametrize("kind", ERRORS)
def test_after_a_fit_other_pixels_have_ratios_near_one(kind: str) -> None:
    random = np.random.default_rng(7)
    std = spread_of(random)
    # As seen on rooms: sure pixels are right, of middling ones more are wrong than predicted.
    right = std * (1 + 2 * np.exp(-((np.log(std) + 2.5) ** 2)))
    error = ERRORS[kind](random, right)
    half = len(std) // 2
    before = measured(std[half:], error[half:]).result()
    assert max(decile.rms_ratio for decile in before.deciles) > 2
    curve = fit_curve(measured(std[:half], error[:half]))
    after = measured(corrected(curve, std[half:]), error[half:]).result()
    for decile in after.deciles:
        assert 1 / 1.2 < decile.rms_ratio < 1.2
        assert 1 / 1.2 < decile.laplace_ratio < 1.2
    assert after.sparsification[:2] == before.sparsification[:2]


def test_a_fit_is_to_the_mean_absolute_error_and_a_heavy_tail_shows_beside_it() -> None:
    random = np.random.default_rng(8)
    std = spread_of(random)
    wrong = random.random(PIXELS) < 0.02
    error = ERRORS["laplace"](random, np.where(wrong, 10 * std, std))
    curve = fit_curve(measured(std, error))
    for decile in measured(corrected(curve, std), error).result().deciles:
        assert decile.laplace_ratio == pytest.approx(1, abs=0.06)
        # By hand: sqrt(0.98 + 0.02 * 100) / (0.98 + 0.02 * 10)
        assert decile.rms_ratio == pytest.approx(1.46, abs=0.15)


@settings(max_examples=30)
@given(
    sizes=st.lists(st.floats(0, 1), min_size=NUM_KNOTS, max_size=NUM_KNOTS),
    constant=st.booleans(),
)
def test_whatever_the_errors_the_order_of_pixels_stays(sizes: list[float], constant: bool) -> None:
    std = np.full(800, 0.1) if constant else np.geomspace(0.01, 0.3, 800)
    error = np.repeat(sizes, 100)
    curve = fit_curve(measured(std, error, maps=1))
    finely = np.geomspace(1e-3, 3, 500)
    assert (np.diff(corrected(curve, finely)) > 0).all()


def test_neighbours_that_violate_the_order_are_averaged() -> None:
    # By hand: (2, 1) and (3, 3.5, 2.5) become their means.
    logs = np.array([0.0, 2.0, 1.0, 3.0, 3.5, 2.5, 4.0, 5.0]) / 2 - 4
    std = np.geomspace(0.01, 0.3, NUM_KNOTS)
    error = np.repeat(np.exp(logs), 100) / 2**0.5
    curve = fit_curve(measured(np.repeat(std, 100), error, maps=1))
    expected = np.array([0.0, 1.5, 1.5, 3.0, 3.0, 3.0, 4.0, 5.0]) / 2 - 4
    # The least slope keeps a twentieth of a knot's distance between those that are equal.
    assert curve.values.numpy() == pytest.approx(expected, abs=0.05)


# The network


def test_the_identity_changes_nothing_and_a_curve_only_the_deviation() -> None:
    values = torch.linspace(-9, 5, 50, dtype=torch.float64)
    assert torch.allclose(SpreadCalibration()(values, 3), values, atol=1e-5)
    model, room = tiny(), Rooms(1, num_views=2, image_size=(48, 64))[0]
    images = room.images.float() / 255
    with torch.no_grad():
        before = model(images, room.views)
        model.calibration.set(2, Curve(torch.arange(-6.0, 2.0), 2 * torch.arange(-6.0, 2.0) + 1))
        after = model(images, room.views)
    assert torch.equal(before.depth, after.depth)
    log_std = (before.std / before.depth).log()
    assert (log_std > -6).all() and (log_std < 1).all()  # between the knots
    expected = (2 * log_std + 1).exp() * after.depth
    assert torch.allclose(after.std, expected, rtol=1e-4)


def test_a_curve_agrees_with_numpys_interpolation() -> None:
    random = np.random.default_rng(9)
    knots, values = (np.sort(random.normal(size=NUM_KNOTS)) for _ in range(2))
    curve = Curve(torch.tensor(knots), torch.tensor(values))
    x = torch.linspace(-4, 4, 101)
    beyond = np.minimum(x.numpy() - knots[0], 0) + np.maximum(x.numpy() - knots[-1], 0)
    assert curve(x).numpy() == pytest.approx(np.interp(x, knots, values) + beyond, abs=1e-5)


def test_curves_that_lose_the_order_are_refused() -> None:
    rising = torch.arange(float(NUM_KNOTS))
    for knots, values in ((rising, rising.flip(0)), (rising * 0, rising), (rising[:3], rising)):
        with pytest.raises(ValueError, match="increasing"):
            SpreadCalibration().set(3, Curve(knots, values))


def test_between_two_numbers_of_views_lies_the_mean_of_their_curves() -> None:
    calibration, knots = SpreadCalibration(), torch.linspace(-5, 1, NUM_KNOTS)
    for views in VIEWS:
        calibration.set(views, Curve(knots + views / 10, knots + float(np.log(views))))
    x = torch.linspace(-8, 3, 40)
    for views in (2, 3, 5, 8):
        assert torch.equal(calibration(x, views), calibration.curve(views)(x))
        expected = Curve(knots + views / 10, knots + float(np.log(views)))(x)
        assert torch.allclose(calibration(x, views), expected, atol=1e-5)
    # Their values rise by the log of the number, so those between do as well.
    for views in (4, 6, 7):
        assert torch.allclose(calibration.curve(views).values, knots + float(np.log(views)))
        assert (calibration(x, views).diff() > 0).all()
    assert torch.equal(calibration(x, 1), calibration(x, 2))
    assert torch.equal(calibration(x, 30), calibration(x, 8))
    with pytest.raises(ValueError, match="one of"):
        calibration.set(4, Curve(knots, knots))


def test_a_lone_curve_of_older_weights_is_that_of_any_number_of_views() -> None:
    model, state = tiny(1), tiny().state_dict()
    knots = torch.linspace(-5, 1, NUM_KNOTS)
    state["densifier.calibration.knots"] = knots
    state["densifier.calibration.values"] = 2 * knots
    model.load_state_dict(state)
    for views in (2, 4, 7):
        assert torch.allclose(model.calibration.curve(views).values, 2 * knots)


def test_a_calibration_survives_a_file(tmp_path: Path) -> None:
    model = tiny()
    model.calibration.set(5, Curve(torch.arange(-6.0, 2.0), 0.5 * torch.arange(-6.0, 2.0) - 1))
    save_weights(tmp_path / "w.safetensors", model, {})
    loaded = load_model(tmp_path / "w.safetensors").calibration
    assert torch.equal(loaded.knots, model.calibration.knots)
    assert torch.equal(loaded.values, model.calibration.values)


def test_weights_without_a_calibration_load_as_the_identity(tmp_path: Path) -> None:
    old = {name: t for name, t in tiny().state_dict().items() if "calibration" not in name}
    model = tiny(1)
    model.calibration.set(3, Curve(torch.arange(-6.0, 2.0), torch.arange(-6.0, 2.0) + 3))
    model.load_state_dict(dict(old))
    assert torch.equal(model.calibration.values, SpreadCalibration().values)
    assert "densifier.calibration.knots" not in old
    # Half a calibration is a damaged file.
    half = old | {"densifier.calibration.knots": torch.zeros(NUM_KNOTS)}
    with pytest.raises(RuntimeError, match=r"calibration\.values"):
        model.load_state_dict(half)
    save_weights(tmp_path / "w.safetensors", model, {})
    with pytest.raises(UserError, match="do not fit"):
        load_weights(torch.nn.Linear(1, 1), tmp_path / "w.safetensors")


def test_fitting_on_rooms_replaces_what_was_fitted_before() -> None:
    model = tiny()
    kept: dict[int, list[PosedImages]] = {}
    for views in VIEWS:
        rooms = Rooms(2, seed=CALIBRATION_SEEDS.start, num_views=views, image_size=(48, 64))
        kept[views] = [rooms[0], rooms[1]]
    before = {name: tensor.clone() for name, tensor in model.state_dict().items()}
    counted: list[str] = []
    first = fit_calibration(model, kept, report=counted.append)
    values = model.calibration.values.clone()
    assert not torch.equal(values, before["densifier.calibration.values"])
    second = fit_calibration(model, kept)
    assert first == second and torch.equal(values, model.calibration.values)
    assert len(counted) == 2 * len(VIEWS) and len({tuple(row) for row in values.tolist()}) == 4
    changed = [n for n, t in model.state_dict().items() if not torch.equal(t, before[n])]
    assert changed == ["densifier.calibration.knots", "densifier.calibration.values"]


# Rooms and commands


def test_rooms_to_report_on_are_in_no_fit_and_no_training() -> None:
    assert not set(EVALUATION_SEEDS) & set(CALIBRATION_SEEDS)
    assert max(*EVALUATION_SEEDS, *CALIBRATION_SEEDS) < 1000
    with pytest.raises(ValueError, match="within 1 to 500"):
        held_out_rooms(501, EVALUATION_SEEDS)


def test_disturbed_rooms_keep_the_truth_and_repeat_themselves() -> None:
    rooms = Rooms(2, seed=3, num_views=2, image_size=(48, 64))
    plain, once, again = rooms[1], DisturbedRooms(rooms)[1], DisturbedRooms(rooms)[1]
    assert torch.equal(once.depth, plain.depth)
    assert torch.equal(once.images, again.images) and not torch.equal(once.images, plain.images)
    assert torch.equal(once.views.cam_from_world[0], plain.views.cam_from_world[0])
    moved = (once.views.cam_from_world - plain.views.cam_from_world)[1].abs()
    assert 0 < moved.max() < 0.05
    assert len(DisturbedRooms(rooms)) == 2


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("weights") / "tiny.safetensors"
    save_weights(file, tiny(), {"step": "5", "licence": "Apache-2.0"})
    return file


def test_calibrate_writes_weights_that_say_so(
    run: Run, weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "new" / "calibrated.safetensors"

    def printing() -> Console:
        assert out.is_file()  # whatever becomes of what is printed
        return table_console()

    monkeypatch.setattr(calibrate, "table_console", printing)
    small = ("--rooms", 2, "--views", 2, "--size", 48, 64)
    command = ("calibrate", "--weights", weights, "--out", out, *small)
    result = run(*command, "--overwrite")  # of nothing
    assert result.code == 0, result.err
    assert "before" in result.out and "after" in result.out and "most certain half" in result.out
    metadata = read_metadata(out)
    assert metadata["step"] == "5" and metadata["licence"] == "Apache-2.0"
    assert metadata["calibration"] == "procedural rooms 500..502, 2, 3, 5, 8 views, 48x64"
    assert not torch.equal(load_model(out).calibration.values, SpreadCalibration().values)
    assert_one_line(run(*command), "the file exists", "--overwrite")


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (("--rooms", 1), "--rooms"),
        (("--views", 1), "--views"),
        (("--size", 8, 8), "--size"),
        (("--depth-range", 3, 1), "--depth-range"),
        (("--weights", "none"), "no such weights"),
        (("--out", "x.pth"), "x.pth"),
    ],
)
def test_calibrate_refuses_in_one_line(
    run: Run, tmp_path: Path, wrong: tuple[object, ...], said: str
) -> None:
    assert_one_line(run("calibrate", "--out", tmp_path / "x.safetensors", *wrong), said)
    assert not list(tmp_path.iterdir())


def test_evaluate_reports_uncertainty_of_captures_and_rooms(
    run: Run, make_capture: MakeCapture, weights: Path, tmp_path: Path
) -> None:
    file = tmp_path / "scores.json"
    rooms = ("--rooms", 2, "--views", 2, "--work-size", 48, 64)
    for which in ((make_capture(),), (*rooms, "--conditions", "ideal"), rooms):
        result = run("evaluate", *which, "--weights", weights, "--json", file)
        assert result.code == 0, result.err
        assert "most certain half" in result.out and "90-100 %" in result.out
        found = json.loads(file.read_text())
        said = found["calibration"]
        assert len(said["deciles"]) == 10
        # Two ways to the same number.
        dense = found["metrics"]["dense"]["abs_rel"]
        assert said["abs_rel_of_all"] == pytest.approx(dense, rel=1e-5)
        ratio = said["abs_rel_of_certain_half"] / said["abs_rel_of_all"]
        assert said["half_over_all"] == pytest.approx(ratio)


def test_a_captures_deviations_are_those_of_its_maps(
    make_capture: MakeCapture, weights: Path
) -> None:
    capture = open_capture(make_capture())
    sets, model = choose_view_sets(capture, 2), load_model(weights)
    found = evaluate_network(DeltasPredictor(model), capture, sets, PredictConfig()).calibration
    assert found is not None and found.pixels == len(sets) * 48 * 64  # the truth has no holes
    encode, expected = EncodedFrames(model), []
    for views in sets:
        prediction = predict_frame(encode, frames_of(capture, views), PredictConfig()).prediction
        expected.append((prediction.std / prediction.depth).mean().item())
    mean = np.mean([decile.std for decile in found.deciles])
    assert mean == pytest.approx(np.mean(expected), rel=1e-3)


def test_evaluate_needs_one_thing_to_score(
    run: Run, make_capture: MakeCapture, tmp_path: Path
) -> None:
    assert_one_line(run("evaluate"), "capture", "--rooms")
    assert_one_line(run("evaluate", make_capture(), "--rooms", 2), "capture", "--rooms")
    assert_one_line(run("evaluate", "--rooms", 0), "--rooms")
    assert_one_line(run("evaluate", "--rooms", 2, "--views", 1), "--views")
    assert_one_line(run("evaluate", "--rooms", 2, "--predictions", tmp_path), "--predictions")
