"""The protocol of table 1, as numbers."""

from dataclasses import dataclass, field

from deltas_nets.config.checks import check_positive
from deltas_nets.evaluate.detectors.features import DetectionConfig
from deltas_nets.evaluate.detectors.pose.consensus import ConsensusConfig
from deltas_nets.evaluate.repeatability import TOLERANCE

__all__ = ["WORK_PIXELS", "TableConfig"]

WORK_PIXELS = 240 * 320
"""Of the images that detectors see, unless a size is given: the paper's."""


@dataclass(frozen=True)
class TableConfig:
    """What decides the numbers besides data and weights."""

    detection: DetectionConfig = field(default_factory=DetectionConfig)
    tolerance: float = TOLERANCE
    """Farthest that a partner or a correct match may be from the true place, pixels."""
    pnp: ConsensusConfig = field(default_factory=ConsensusConfig)
    """Poses from points with depth: pixels between projection and match."""
    essential: ConsensusConfig = field(default_factory=lambda: ConsensusConfig(threshold=1.0))
    """Poses of pairs without depth: pixels of Sampson's distance."""
    work_size: tuple[int, int] | None = None
    """(height, width) of the images; of the image's shape with about 240 x 320 pixels if not
    given."""

    def __post_init__(self) -> None:
        check_positive(self, "tolerance")
