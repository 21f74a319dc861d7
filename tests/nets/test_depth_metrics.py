"""Depth metrics against hand-computed numbers, an independent formula and their invariants."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from deltas_nets.evaluate.depth_metrics import depth_metrics, mean_metrics

depths = arrays(np.float64, (5, 7), elements=st.floats(0.5, 10.0))


def test_a_hand_computed_map() -> None:
    metrics = depth_metrics([1.0, 2.0, 5.0, 0.0], [1.0, 4.0, 4.0, 2.0])
    assert metrics is not None
    assert metrics.abs_rel == pytest.approx((0 + 0.5 + 0.25) / 3)
    assert metrics.abs_diff == pytest.approx(1.0)
    assert metrics.sq_rel == pytest.approx((0 + 1 + 0.25) / 3)
    assert metrics.rmse == pytest.approx((5 / 3) ** 0.5)
    assert metrics.rmse_log == pytest.approx(((np.log(2) ** 2 + np.log(1.25) ** 2) / 3) ** 0.5)
    assert metrics.delta1 == pytest.approx(1 / 3)  # a ratio of exactly 1.25 is outside
    assert metrics.delta2 == pytest.approx(2 / 3)
    assert metrics.coverage == pytest.approx(3 / 4)


@given(truth=depths)
def test_the_truth_has_no_error(truth: np.ndarray) -> None:
    metrics = depth_metrics(truth, truth)
    assert metrics is not None
    assert metrics == (0, 0, 0, 0, 0, 1, 1, 1, 1, 1, 1)


@given(truth=depths, scale=st.floats(0.5, 2.0))
def test_abs_rel_of_a_scaled_map_is_the_scale_error(truth: np.ndarray, scale: float) -> None:
    metrics = depth_metrics(scale * truth, truth)
    assert metrics is not None
    assert metrics.abs_rel == pytest.approx(abs(scale - 1))
    assert metrics.rmse_log == pytest.approx(abs(np.log(scale)))


@given(truth=depths, predicted=depths)
def test_what_has_no_truth_counts_nowhere(truth: np.ndarray, predicted: np.ndarray) -> None:
    holes = np.zeros((5, 7))
    more_truth, more = np.stack([truth, holes]), np.stack([predicted, predicted])
    assert depth_metrics(more, more_truth) == pytest.approx(depth_metrics(predicted, truth))


def test_both_ends_of_the_range_count() -> None:
    for depth, counts in ((0.5, True), (10.0, True), (0.5 - 1e-9, False), (10 + 1e-9, False)):
        assert (depth_metrics([depth], [depth]) is not None) is counts


def test_no_truth_gives_none_and_no_prediction_no_coverage() -> None:
    assert depth_metrics([1.0], [0.0]) is None
    metrics = depth_metrics([0.0, float("nan")], [1.0, 2.0])
    assert metrics is not None
    assert metrics.coverage == 0
    assert np.isnan(metrics.abs_rel)


def test_shapes_must_agree_and_a_mean_needs_a_map() -> None:
    with pytest.raises(ValueError, match="shape"):
        depth_metrics([1.0], [[1.0]])
    with pytest.raises(ValueError, match="no depth map"):
        mean_metrics([])


@pytest.mark.filterwarnings("error")
def test_a_mean_of_maps_without_predictions_is_nan_without_a_word() -> None:
    nothing, one = depth_metrics([0.0], [1.0]), depth_metrics([1.5], [1.0])
    assert nothing is not None and one is not None
    assert np.isnan(mean_metrics([nothing, nothing]).abs_rel)
    mean = mean_metrics([nothing, one])
    assert (mean.abs_rel, mean.coverage) == (0.5, 0.5)
