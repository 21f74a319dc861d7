"""Ready-made targets, and the names by which the command knows them."""

from collections.abc import Callable

from deltas_geom.testing.others import (
    KORNIA_SOLVERS,
    KorniaSolver,
    kornia,
    opencv,
    plain_torch,
)
from deltas_geom.testing.ours import deltas
from deltas_geom.testing.target import Target

__all__ = [
    "KORNIA_SOLVERS",
    "TARGETS",
    "KorniaSolver",
    "Target",
    "deltas",
    "kornia",
    "opencv",
    "plain_torch",
]

TARGETS: dict[str, Callable[[], list[Target]]] = {
    "deltas": lambda: [deltas()],
    "torch": lambda: [plain_torch()],
    "kornia": lambda: [kornia(solver) for solver in KORNIA_SOLVERS],
    "opencv": lambda: [opencv()],
}
"""Columns of the table that ``python -m deltas_geom.testing --target NAME`` prints."""
