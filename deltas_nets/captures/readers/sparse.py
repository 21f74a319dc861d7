"""Observations of sparse points from rows that readers collect."""

from collections.abc import Sequence

import numpy as np

from deltas_nets.captures.points import Observations

__all__ = ["observed"]


def observed(rows: Sequence[tuple[int, int, float, float]]) -> Observations:
    """Observations from (point, frame, x, y); those that are not finite are left out."""
    table = np.array(rows, dtype=np.float64).reshape(-1, 4)
    table = table[np.isfinite(table).all(axis=1)]
    return Observations(
        table[:, 0].astype(np.int64), table[:, 1].astype(np.int64), table[:, 2:].copy()
    )
