"""What the paper's supplement reports, on ScanNet, of three views 20 frames apart."""

from typing import NamedTuple

__all__ = ["PAPER", "SPARSE_RATIO", "PaperRow"]


class PaperRow(NamedTuple):
    """A row of a table, of dense depth unless its name says otherwise.

    Attributes:
        step: the name of the setting, as in `deltas_nets.ablations.tables`.
        abs_rel, abs_diff, sq_rel, delta1, delta2, delta3: as in
            :class:`~deltas_nets.evaluate.depth_metrics.DepthMetrics`.
        gmacs: where the table has them.
    """

    step: str
    abs_rel: float
    abs_diff: float
    sq_rel: float
    delta1: float
    delta2: float
    delta3: float
    gmacs: float | None = None


PAPER: dict[str, tuple[PaperRow, ...]] = {
    "points": (
        PaperRow("0", 0.2203, 0.3049, 0.1375, 0.7198, 0.9022, 0.9650),
        PaperRow("32", 0.1105, 0.1793, 0.0582, 0.9002, 0.9722, 0.9886),
        PaperRow("128", 0.0960, 0.1591, 0.0514, 0.9232, 0.9760, 0.9895),
        PaperRow("256", 0.0934, 0.1550, 0.0505, 0.9276, 0.9766, 0.9895),
        PaperRow("384", 0.0931, 0.1541, 0.0505, 0.9285, 0.9767, 0.9894),
        PaperRow("512", 0.0932, 0.1540, 0.0506, 0.9287, 0.9767, 0.9893),
        PaperRow("640", 0.0936, 0.1543, 0.0509, 0.9285, 0.9766, 0.9892),
        PaperRow("768", 0.0942, 0.1549, 0.0512, 0.9282, 0.9766, 0.9891),
        PaperRow("512 (GT)", 0.0680, 0.1111, 0.0406, 0.9562, 0.9800, 0.9903),
    ),
    "ratio": (
        PaperRow("0", 0.0935, 0.1544, 0.0508, 0.9283, 0.9766, 0.9893),
        PaperRow("0.25", 0.0933, 0.1540, 0.0507, 0.9286, 0.9766, 0.9893),
        PaperRow("0.5", 0.0932, 0.1540, 0.0506, 0.9287, 0.9767, 0.9893),
        PaperRow("0.75", 0.0933, 0.1540, 0.0507, 0.9286, 0.9766, 0.9893),
        PaperRow("1", 0.0933, 0.1540, 0.0507, 0.9286, 0.9766, 0.9893),
    ),
    "nms": (
        PaperRow("3", 0.0942, 0.1554, 0.0512, 0.9278, 0.9765, 0.9892),
        PaperRow("5", 0.0937, 0.1545, 0.0508, 0.9283, 0.9766, 0.9892),
        PaperRow("7", 0.0937, 0.1545, 0.0510, 0.9284, 0.9766, 0.9892),
        PaperRow("9", 0.0932, 0.1540, 0.0506, 0.9287, 0.9767, 0.9893),
        PaperRow("11", 0.0938, 0.1546, 0.0511, 0.9285, 0.9766, 0.9891),
    ),
    "threshold": (
        PaperRow("0.0001", 0.0932, 0.1539, 0.0506, 0.9287, 0.9767, 0.9893),
        PaperRow("0.0005", 0.0932, 0.1540, 0.0506, 0.9287, 0.9767, 0.9893),
        PaperRow("0.001", 0.0933, 0.1540, 0.0507, 0.9286, 0.9767, 0.9893),
        PaperRow("0.005", 0.0934, 0.1544, 0.0507, 0.9283, 0.9766, 0.9893),
    ),
    "samples": (
        PaperRow("25", 0.0934, 0.1542, 0.0508, 0.9287, 0.9767, 0.9893),
        PaperRow("50", 0.0933, 0.1540, 0.0507, 0.9287, 0.9767, 0.9893),
        PaperRow("100", 0.0932, 0.1540, 0.0506, 0.9287, 0.9767, 0.9893),
        PaperRow("150", 0.0932, 0.1540, 0.0506, 0.9286, 0.9767, 0.9893),
    ),
    "offsets": (
        PaperRow("1", 0.0932, 0.1540, 0.0506, 0.9287, 0.9767, 0.9893),
        PaperRow("2", 0.0933, 0.1541, 0.0507, 0.9285, 0.9766, 0.9893),
    ),
    "architecture": (
        PaperRow("MVDepth", 0.1054, 0.1911, 0.0970, 0.8952, 0.9707, 0.9895, 134.8),
        PaperRow("DPS", 0.1025, 0.1675, 0.0574, 0.9102, 0.9708, 0.9872, 295.6),
        PaperRow("VGG-9", 0.1073, 0.1815, 0.0581, 0.9023, 0.9719, 0.9890, 16.9),
        PaperRow("ResNet-50", 0.0932, 0.1540, 0.0506, 0.9287, 0.9767, 0.9893, 84.4),
    ),
    "sparse": (
        PaperRow("COLMAP, sparse points", 0.2629, 0.4618, 0.3882, 0.5713, 0.7498, 0.8322),
        PaperRow("COLMAP, dense", 0.1371, 0.2643, 0.1379, 0.8344, 0.9080, 0.9383),
        PaperRow("COLMAP + densifier", 0.1242, 0.1990, 0.0658, 0.8756, 0.9649, 0.9878),
    ),
}
"""Dense depth, by table."""

SPARSE_RATIO: tuple[PaperRow, ...] = (
    PaperRow("0", 0.0993, 0.1899, 0.0503, 0.8856, 0.9701, 0.9906),
    PaperRow("0.25", 0.0986, 0.1891, 0.0502, 0.8869, 0.9703, 0.9906),
    PaperRow("0.5", 0.0988, 0.1893, 0.0503, 0.8866, 0.9702, 0.9905),
    PaperRow("0.75", 0.0988, 0.1893, 0.0503, 0.8866, 0.9702, 0.9905),
    PaperRow("1", 0.0988, 0.1893, 0.0503, 0.8866, 0.9702, 0.9905),
)
"""Of the triangulated points, beside table "ratio"."""
