"""The paper's depth metrics, and two stricter shares: of one map, of many, of all their pixels."""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["DepthMetrics", "DepthSums", "depth_metrics", "depth_sums", "mean_metrics"]


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
        delta105: the same as ``delta1`` for 1.05.
        delta103: the same for 1.03: the inliers of the Robust MVD benchmark, its tau.
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
    delta105: float
    delta103: float


class DepthSums(NamedTuple):
    """What metrics are made of: sums over pixels, which those of other maps can be added to.

    Attributes:
        known: pixels with true depth in range.
        used: those of them with a prediction; the others are sums over these, of the terms of
            :class:`DepthMetrics` before any root.
    """

    known: float
    used: float
    relative: float
    absolute: float
    square_relative: float
    square: float
    square_log: float
    within1: float
    within2: float
    within3: float
    within105: float
    within103: float

    def plus(self, other: "DepthSums") -> "DepthSums":
        """The sums over the pixels of both."""
        return DepthSums(*(mine + theirs for mine, theirs in zip(self, other, strict=True)))

    def metrics(self) -> DepthMetrics:
        """Means over the pixels; all but the coverage are NaN where nothing is predicted."""
        if self.used == 0:
            nothing = dict.fromkeys(DepthMetrics._fields, float("nan"))
            return DepthMetrics(**nothing | {"coverage": 0.0})
        n = self.used
        return DepthMetrics(
            abs_rel=self.relative / n,
            abs_diff=self.absolute / n,
            sq_rel=self.square_relative / n,
            rmse=float(np.sqrt(self.square / n)),
            rmse_log=float(np.sqrt(self.square_log / n)),
            delta1=self.within1 / n,
            delta2=self.within2 / n,
            delta3=self.within3 / n,
            coverage=n / self.known,
            delta105=self.within105 / n,
            delta103=self.within103 / n,
        )


def depth_sums(
    predicted: ArrayLike, truth: ArrayLike, *, depth_range: tuple[float, float] = (0.5, 10.0)
) -> DepthSums | None:
    """Sums over the pixels whose true depth is known and in range; None where there is none.

    Args:
        predicted: any shape, metres; 0, negative or not finite is no prediction.
        truth: the same shape, metres; 0 is unknown.
        depth_range: (near, far) of the true depth, metres.

    Raises:
        ValueError: the shapes differ.
    """
    p, g = np.asarray(predicted, dtype=np.float64), np.asarray(truth, dtype=np.float64)
    if p.shape != g.shape:
        raise ValueError(f"predicted has shape {p.shape} but truth {g.shape}")
    known = np.isfinite(g) & (g >= depth_range[0]) & (g <= depth_range[1])
    if not known.any():
        return None
    used = known & np.isfinite(p) & (p > 0)
    p, g = p[used], g[used]
    error, ratio = p - g, np.maximum(p / g, g / p)
    return DepthSums(
        known=float(known.sum()),
        used=float(used.sum()),
        relative=float((np.abs(error) / g).sum()),
        absolute=float(np.abs(error).sum()),
        square_relative=float((error**2 / g).sum()),
        square=float((error**2).sum()),
        square_log=float((np.log(p / g) ** 2).sum()),
        within1=float((ratio < 1.25).sum()),
        within2=float((ratio < 1.25**2).sum()),
        within3=float((ratio < 1.25**3).sum()),
        within105=float((ratio < 1.05).sum()),
        within103=float((ratio < 1.03).sum()),
    )


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

    Raises:
        ValueError: the shapes differ.

    Source: the paper, section 4.1 (Eigen et al., 2014); for 1.03 Schroeppel et al., A benchmark
    and a baseline for robust multi-view depth estimation (2022).

    Example:
        >>> depth_metrics([2.0, 2.2], [2.0, 2.0]).abs_rel
        0.05...
    """
    sums = depth_sums(predicted, truth, depth_range=depth_range)
    return None if sums is None else sums.metrics()


def mean_metrics(metrics: list[DepthMetrics]) -> DepthMetrics:
    """Mean over depth maps, as the paper and the field report it.

    Maps without a prediction count in the coverage alone; where no map has one, the other means
    are NaN.

    Raises:
        ValueError: the list is empty.
    """
    if not metrics:
        raise ValueError("no depth map has true depth in range")
    return DepthMetrics(*(_mean_of_known(values) for values in np.array(metrics).T))


def _mean_of_known(values: NDArray[np.float64]) -> float:
    known = values[~np.isnan(values)]
    return float(known.mean()) if len(known) else float("nan")
