"""The supplement's tables, as changes of a trained network.

Source: the paper's supplement, "Ablation Studies": parameters are changed at inference alone.
"""

from deltas_nets.ablations.steps import Series, Step, instead, varied
from deltas_nets.config.varied import NetworkSettings

__all__ = ["TABLES"]

_POINTS = (0, 32, 128, 256, 384, 512, 640, 768)
_SHARES = (0.0, 0.25, 0.5, 0.75, 1.0)
_RADII = (3, 5, 7, 9, 11)
_THRESHOLDS = (0.0001, 0.0005, 0.001, 0.005)
_LENGTHS = (25, 50, 100, 150)
_OFFSETS = (1.0, 2.0)

_ALL = (
    Series(
        "points",
        "number of sparse points",
        "points",
        (
            *(varied(str(n), n, NetworkSettings(num_points=n)) for n in _POINTS),
            instead("512 (GT)", "true-points"),
        ),
        source="supplement, number of sparse points",
    ),
    Series(
        "ratio",
        "share of detected points, the others are spread",
        "largest share of detected points",
        tuple(varied(f"{s:g}", s, NetworkSettings(detected_share=s)) for s in _SHARES),
        source="supplement, ratios of interest points and random points, dense and sparse",
    ),
    Series(
        "nms",
        "radius of suppression",
        "radius, pixels",
        tuple(varied(str(r), r, NetworkSettings(nms_radius=r)) for r in _RADII),
        source="supplement, radius for non-maximum suppression",
    ),
    Series(
        "threshold",
        "threshold of the detector",
        "probability",
        tuple(varied(f"{t:g}", t, NetworkSettings(threshold=t)) for t in _THRESHOLDS),
        logarithmic=True,
        source="supplement, thresholds for the detector",
    ),
    Series(
        "samples",
        "samples along the segment (deltas-small: bins of inverse depth)",
        "samples",
        tuple(varied(str(n), n, NetworkSettings(num_samples=n)) for n in _LENGTHS),
        source="supplement, lengths of the sampled descriptors",
    ),
    Series(
        "offsets",
        "lines beside the epipolar line",
        "offset, pixels",
        tuple(varied(f"{o:g}", o, NetworkSettings(offset=o)) for o in _OFFSETS),
        source="supplement, sampling offsets",
    ),
    Series(
        "architecture",
        "networks, each as it is",
        "GMACs of 2 views at 240 x 320 with 512 points",
        (Step("as it is"),),
        source="supplement, architectures",
    ),
    Series(
        "sparse",
        "sparse points of COLMAP, spread between them, and through the densifier; ours",
        "",
        (
            Step("as it is"),
            instead("COLMAP, interpolated", "colmap-sparse"),
            instead("COLMAP + densifier", "colmap-densified"),
        ),
        source="supplement, sparse depth analysis",
    ),
)
TABLES = {table.name: table for table in _ALL}
"""By the name that the command takes."""
