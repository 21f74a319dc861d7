"""Alignment, sparsification, the pixels that count, and pooling: what one map's scores rest on."""

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from small_capture import write_capture

from deltas_nets.captures.opening import open_capture
from deltas_nets.evaluate.alignment import Alignment, align
from deltas_nets.evaluate.calibration import CalibrationMeter
from deltas_nets.evaluate.depth_metrics import depth_metrics, depth_sums, mean_metrics
from deltas_nets.evaluate.scores import score_map
from deltas_nets.evaluate.sparsification import ause, sparsification_curve
from deltas_nets.evaluate.truth import Truth

RANGE = (0.5, 10.0)
Map = np.ndarray
depths = arrays(np.float32, (6, 8), elements=st.floats(1.0, 8.0, width=32))
factors = st.floats(0.5, 2.0)


@given(truth=depths, scale=factors, shift=st.floats(0.0, 1.0))
def test_a_moved_truth_is_moved_back(truth: Map, scale: float, shift: float) -> None:
    moved = (scale * truth).astype(np.float32)
    assert align(moved, truth, "median", depth_range=RANGE).depth == pytest.approx(truth, rel=1e-5)
    assume(truth.std() > 0.05)
    moved = (scale * truth + shift).astype(np.float32)
    found = align(moved, truth, "scale-and-shift", depth_range=RANGE)
    assert found.depth == pytest.approx(truth, abs=1e-3)
    assert found.scale == pytest.approx(1 / scale, rel=1e-2)


@given(truth=depths, predicted=depths)
def test_scale_and_shift_are_those_of_least_squares(truth: Map, predicted: Map) -> None:
    assume(predicted.std() > 0.05)
    rows = np.stack([predicted.ravel(), np.ones(predicted.size)], axis=1).astype(np.float64)
    expected = np.linalg.lstsq(rows, truth.ravel().astype(np.float64), rcond=None)[0]
    found = align(predicted, truth, "scale-and-shift", depth_range=RANGE)
    assert [found.scale, found.shift] == pytest.approx(expected, rel=1e-4, abs=1e-4)
    assert (found.depth > 0).all()  # a prediction stays one


@given(truth=depths, predicted=depths, scale=factors)
def test_what_is_aligned_does_not_depend_on_the_scale_before(
    truth: Map, predicted: Map, scale: float
) -> None:
    assume(predicted.std() > 0.05)
    for kind in ("median", "scale-and-shift"):
        one, other = (
            align(p, truth, kind, depth_range=RANGE).depth  # type: ignore[arg-type]
            for p in (predicted, (predicted * np.float32(scale)))
        )
        assert one == pytest.approx(other, rel=1e-3, abs=1e-3)


def test_alignments_by_hand() -> None:
    ones = np.ones((1, 6), np.float32)
    truth = np.array([[1.0, 2.0, 6.0, 0.0, 11.0, 12.0]], np.float32)  # the last beyond the range
    found = align(ones, truth, "median", depth_range=RANGE)
    assert found.depth.tolist() == [[2] * 6]
    # The line falls; where it is below 0 the map keeps a depth, the nearest that counts.
    falling = np.array([[3.0, 2.0, 0.0]], np.float32)
    depth = np.array([[1.0, 2.0, 9.0]], np.float32)
    found = align(depth, falling, "scale-and-shift", depth_range=RANGE)
    assert found.depth == pytest.approx(np.array([[3, 2, 0.5]]), abs=1e-6)


@pytest.mark.parametrize("kind", ["median", "scale-and-shift"])
def test_predictions_near_the_least_float_are_aligned_and_stay_predictions(
    kind: Alignment,
) -> None:
    truth = np.array([[1.0, 2.0, 3.0, 2.0]], np.float32)
    tiny = np.array([[1e-40, 2e-40, 3e-40, 8.0]], np.float32)
    found = align(tiny, truth * (tiny < 1), kind, depth_range=RANGE).depth
    assert np.isfinite(found).all() and (found > 0).all()
    assert found[0, :3] == pytest.approx(truth[0, :3], rel=1e-4)


def test_a_flat_map_is_shifted_alone_and_holes_stay_holes() -> None:
    truth = np.array([[2.0, 4.0, 3.0]], np.float32)
    flat = np.array([[1.0, 1.0, 0.0]], np.float32)
    found = align(flat, truth, "scale-and-shift", depth_range=RANGE)
    assert (found.scale, found.shift) == (1, 2)
    assert found.depth.tolist() == [[3, 3, 0]]
    assert align(flat, truth, "none", depth_range=RANGE).depth is flat


@given(error=arrays(np.float64, 60, elements=st.floats(0.001, 0.9)))
def test_the_order_of_the_errors_is_the_best_there_is(error: np.ndarray) -> None:
    truth = np.full(60, 2.0)
    depth = truth * (1 + error)
    assert ause(depth, error, truth) == pytest.approx(0, abs=1e-12)
    worst = ause(depth, -error, truth)
    shuffled = ause(depth, np.roll(error, 7), truth)
    assert -1e-12 <= shuffled <= worst + 1e-12


@given(error=arrays(np.float64, 50, elements=st.floats(0.001, 0.9)), data=st.data())
def test_only_the_order_of_the_deviations_counts(error: np.ndarray, data: st.DataObject) -> None:
    truth, std = np.full(50, 2.0), np.array(data.draw(st.permutations(range(1, 51)))) / 50
    depth = truth * (1 + error)
    assert ause(depth, std, truth) == pytest.approx(ause(depth, std**3, truth), abs=1e-12)


def test_sparsification_by_hand() -> None:
    """Errors 0.1, 0.3 in the wrong order; with two pixels, half of the steps leave one."""
    found = ause([2.2, 2.6], [2.0, 1.0], [2.0, 2.0])
    # Of the wrong order 0.3 / 0.2 is left, of the right one 0.1 / 0.2, from 50 % taken away on.
    assert found == pytest.approx(50 * (0.3 - 0.1) / 0.2 / 100)
    assert np.isnan(ause([2.0], [1.0], [2.0]))  # nothing is wrong
    assert np.isnan(ause([0.0], [1.0], [2.0]))  # nothing is predicted
    without_end = {"depth_range": (0.5, np.inf)}
    far = ause([2.2, 2.6, 2.0], [2.0, 1.0, 3.0], [2.0, 2.0, np.inf], **without_end)
    assert far == pytest.approx(found)  # a truth that is not finite is none
    meter, flat = CalibrationMeter(), np.float32([[2.2, 2.6, 2.0]])
    truth = np.float32([[2.0, 2.0, np.inf]])
    meter.add(flat, np.full_like(flat, 0.1), truth, **without_end)
    assert meter.result().pixels == 2
    assert np.isfinite(align(flat, truth, "scale-and-shift", **without_end).scale)


@pytest.mark.parametrize("pixels", [100, 200, 700])
def test_each_step_takes_a_hundredth_away(pixels: int) -> None:
    error = np.arange(1.0, pixels + 1)
    left = pixels - pixels // 100 * np.arange(100)
    assert sparsification_curve(error, error) == pytest.approx((left + 1) / (pixels + 1))


@given(first=depths, second=depths, truth=depths)
def test_pooled_metrics_are_those_of_all_pixels_at_once(
    first: Map, second: Map, truth: Map
) -> None:
    second = second.copy()
    second[:, :3] = 0
    maps = [depth_sums(p, truth) for p in (first, second)]
    assert maps[0] is not None
    assert maps[1] is not None
    together = depth_metrics(np.stack([first, second]), np.stack([truth, truth]))
    assert maps[0].plus(maps[1]).metrics() == pytest.approx(together)
    assert together is not None
    assert together.coverage == pytest.approx((48 + 30) / 96)
    # A mean over frames counts the smaller map as much.
    mean = mean_metrics([each.metrics() for each in maps if each is not None])
    assert mean.coverage == pytest.approx((1 + 30 / 48) / 2)


@given(ratio=st.sampled_from([1.02, 1.04, 1.2, 1.4]), below=st.booleans())
def test_strict_shares_have_their_thresholds(ratio: float, below: bool) -> None:
    found = depth_metrics([2 / ratio if below else 2 * ratio], [2.0])
    assert found is not None
    assert (found.delta103, found.delta105, found.delta1) == (
        ratio < 1.03,
        ratio < 1.05,
        ratio < 1.25,
    )


def test_a_map_without_deviation_has_no_ause() -> None:
    truth = np.linspace(1, 4, 12, dtype=np.float32).reshape(3, 4)
    plain = score_map(1.1 * truth, truth, RANGE, None)
    assert plain is not None
    assert plain.ause is None
    assert plain.scaled.abs_rel == pytest.approx(0, abs=1e-6)
    stated = score_map(truth + truth**2, truth, RANGE, None, truth)
    assert stated is not None
    assert stated.ause == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("depth_size", [(24, 32), (48, 64), (96, 128)])
@pytest.mark.parametrize("map_size", [(24, 32), (48, 64), (96, 128)])
def test_the_same_plane_is_right_at_any_size(
    depth_size: tuple[int, int], map_size: tuple[int, int], tmp_path: Path
) -> None:
    frame = open_capture(write_capture(tmp_path / "a", depth_size=depth_size)).frame(1)
    found = np.full(map_size, 2.5, np.float32)
    for size, expected in (("map", map_size), ("own", depth_size)):
        truth, at_truth = Truth.of(frame, size).beside(found)  # type: ignore[arg-type]
        assert truth.shape == at_truth.shape == expected
        assert np.array_equal(truth, at_truth)


def test_truth_at_its_own_size_reads_the_pixel_it_lies_in(tmp_path: Path) -> None:
    frame = open_capture(write_capture(tmp_path / "a", depth_size=(24, 32))).frame(0)
    image = torch.arange(48 * 64, dtype=torch.float32).view(48, 64)
    _, read = Truth.of(frame, "own").beside(image.numpy())
    # The centre of a pixel twice as large lies on the corner of four, of which it is in the last.
    assert np.array_equal(read, image[1::2, 1::2].numpy())
    _, twice = Truth.of(frame, "own").beside(image[::4, ::4].numpy())
    assert np.array_equal(twice, image[::4, ::4].repeat_interleave(2, 0).repeat_interleave(2, 1))


def test_a_depth_camera_that_sees_more_finds_no_map_there(tmp_path: Path) -> None:
    folder = write_capture(tmp_path / "a", depth_size=(48, 64))
    K = np.array([[32.0, 0, 31.5], [0, 32, 23.5], [0, 0, 1]])  # half the focal length
    np.savetxt(folder / "intrinsic" / "intrinsic_depth.txt", K)
    frame = open_capture(folder).frame(0)
    _, read = Truth.of(frame, "own").beside(np.ones((48, 64), np.float32))
    assert read[12:36, 16:48].all()
    assert read.sum() == 24 * 32
