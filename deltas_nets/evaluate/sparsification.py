"""Does the stated deviation order the pixels of a map as their errors would?"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["STEPS", "ause", "sparsification_curve"]

STEPS = 100
"""Shares of the pixels that are taken away: 0, 1 %, ..., 99 %."""
Curve = NDArray[np.float64]


def ause(
    depth: ArrayLike,
    deviation: ArrayLike,
    truth: ArrayLike,
    *,
    depth_range: tuple[float, float] = (0.5, 10.0),
) -> float:
    """Area under the sparsification error of a map, by Abs Rel: 0 if the order is perfect.

    Pixels are taken away from the least sure on, a hundredth at a time, and the mean relative error
    of those that are left is divided by that of all. The same is done in the order of the errors
    themselves, which no order beats. The area is the mean of the difference of the two curves.

    Args:
        depth: any shape, metres; 0, negative or not finite is no prediction.
        deviation: the same shape: the relative standard deviation, or anything that grows with it.
        truth: the same shape, metres; 0 is unknown.
        depth_range: (near, far) of the true depth that counts, metres.

    Returns:
        NaN where no pixel counts, or none is wrong.

    Source: after Ilg et al., Uncertainty estimates and multi-hypotheses networks for optical flow
    (2018), with the relative error as Schroeppel et al. (2022) take it. Steps, what ends the curves
    and what they are divided by are ours by definition (docs/evaluation.md).

    Example:
        >>> truth = np.full(200, 2.0)
        >>> depth = truth + np.linspace(0.01, 1, 200)
        >>> ause(depth, depth - truth, truth), round(ause(depth, truth - depth, truth), 2)
        (0.0, 0.98)
    """
    p, s, g = (np.asarray(a, dtype=np.float64).ravel() for a in (depth, deviation, truth))
    used = np.isfinite(p) & (p > 0) & np.isfinite(s)
    used &= np.isfinite(g) & (g >= depth_range[0]) & (g <= depth_range[1])
    if not used.any():
        return float("nan")
    error = np.abs(p[used] - g[used]) / g[used]
    if not error.any():
        return float("nan")
    stated = sparsification_curve(error, s[used])
    best = sparsification_curve(error, error)
    return float((stated - best).mean())


def sparsification_curve(error: Curve, order: Curve) -> Curve:
    """Mean error of what is left after each step, as a share of the mean of all: ``(STEPS,)``.

    Args:
        error: ``(N,)`` not negative, not all 0.
        order: ``(N,)``; the largest are taken away first, of equal ones the last.
    """
    kept = error[np.argsort(order, kind="stable")]
    left = np.maximum(np.ceil(len(kept) * (1 - np.arange(STEPS) / STEPS) - 1e-9), 1).astype(int)
    means: Curve = np.cumsum(kept)[left - 1] / left / kept.mean()
    return means
