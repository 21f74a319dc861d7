"""What is true of every right implementation, as functions that take one.

Each invariant raises ``AssertionError`` with the failing numbers. They take a
:class:`~deltas_geom.testing.target.Target` and a scene without batch dims, whose pixels may be
noisy; further arguments have defaults, so that a test can draw them. ``INVARIANTS`` lists them
all with what they need, in the order of the table; a file has those of one operation.
"""

# isort: off
# The order in which they register is that of the table.
from deltas_geom.testing.invariants import projection, unprojection, fundamental
from deltas_geom.testing.invariants import segments, sampling, reading, matching
from deltas_geom.testing.invariants import (
    triangulation,
    status,
    refinement,
    residual,
    robust,
    points,
    rasterize,
)

# isort: on
from deltas_geom.testing.agreement import PIXEL_TOLERANCE, POINT_TOLERANCE
from deltas_geom.testing.changes import ELSEWHERE, World
from deltas_geom.testing.registry import INVARIANTS, Invariant, first_views

__all__ = [
    "ELSEWHERE",
    "INVARIANTS",
    "PIXEL_TOLERANCE",
    "POINT_TOLERANCE",
    "Invariant",
    "World",
    "first_views",
    "fundamental",
    "matching",
    "points",
    "projection",
    "rasterize",
    "reading",
    "refinement",
    "residual",
    "robust",
    "sampling",
    "segments",
    "status",
    "triangulation",
    "unprojection",
]
