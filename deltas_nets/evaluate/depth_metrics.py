"""The paper's depth metrics."""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike


class DepthMetrics(NamedTuple):
    """Errors of one depth map; lower is better for the first five, higher for the others.

    Attributes:
        abs_rel: mean of |p - g| / g.
        abs_diff: mean of |p - g|, metres.
        sq_rel: mean of (p - g)^2 / g, metres.
        rmse: root mean square of p - g, metres.
        rmse_log: root mean square of log p - log g.
        delta1: share with max(p / g, g / p) < 1.25.
        delta2: the same for 1.25^2.
        delta3: the same for 1.25^3.
        coverage: share of the true depth that has a prediction.
    """

    abs_rel: float
    abs_diff: float
    sq_rel: float
    rmse: float
    rmse_log: float
    delta1: float
    delta2: float
    delta3: float
    coverage: float


def depth_metrics(
    predicted: ArrayLike, truth: ArrayLike, *, depth_range: tuple[float, float] = (0.5, 10.0)
) -> DepthMetrics | None:
    """Metrics of one depth map where the true depth is known and in range.

    Args:
        predicted: any shape, metres; 0, negative or not finite is no prediction.
        truth: the same shape, metres; 0 is unknown.
        depth_range: (near, far) of the true depth, metres.

    Returns:
        None where no true depth is in range. Without any prediction all errors are NaN and
        the coverage is 0.

    Source: the paper, section 4.1 (Eigen et al., 2014).

    Example:
        >>> depth_metrics([2.0, 2.2], [2.0, 2.0]).abs_rel
        0.05...
    """
    p, g = np.asarray(predicted, dtype=np.float64), np.asarray(truth, dtype=np.float64)
    if p.shape != g.shape:
        raise ValueError(f"predicted has shape {p.shape} but truth {g.shape}")
    known = np.isfinite(g) & (g >= depth_range[0]) & (g <= depth_range[1])
    if not known.any():
        return None
    used = known & np.isfinite(p) & (p > 0)
    coverage = float(used.sum() / known.sum())
    if not used.any():
        nothing = dict.fromkeys(DepthMetrics._fields, float("nan"))
        return DepthMetrics(**nothing | {"coverage": 0.0})
    p, g = p[used], g[used]
    error, ratio = p - g, np.maximum(p / g, g / p)
    return DepthMetrics(
        abs_rel=float(np.mean(np.abs(error) / g)),
        abs_diff=float(np.mean(np.abs(error))),
        sq_rel=float(np.mean(error**2 / g)),
        rmse=float(np.sqrt(np.mean(error**2))),
        rmse_log=float(np.sqrt(np.mean(np.log(p / g) ** 2))),
        delta1=float(np.mean(ratio < 1.25)),
        delta2=float(np.mean(ratio < 1.25**2)),
        delta3=float(np.mean(ratio < 1.25**3)),
        coverage=coverage,
    )


def mean_metrics(metrics: list[DepthMetrics]) -> DepthMetrics:
    """Mean over depth maps, as the paper and the field report it.

    Raises:
        ValueError: the list is empty.
    """
    if not metrics:
        raise ValueError("no depth map has true depth in range")
    return DepthMetrics(*(float(value) for value in np.nanmean(np.array(metrics), axis=0)))
