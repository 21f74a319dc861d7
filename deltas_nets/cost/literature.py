"""Multiply-accumulates that publications report. Nothing here is measured by us."""

from typing import Literal, NamedTuple


class Published(NamedTuple):
    """A reported figure.

    Attributes:
        name: of the method, or of its part.
        gmacs: 1e9 multiply-accumulates.
        relation: "<" if the figure is a bound.
    """

    name: str
    gmacs: float
    relation: Literal["=", "<"] = "="

    def __str__(self) -> str:
        bound = "< " if self.relation == "<" else ""
        return f"{bound}{self.gmacs:g}"


PAPER_SETTING = (2, (240, 320), 512)
"""Views, image size and keypoints of the paper's count."""

PAPER_PARTS = (
    Published("detector and descriptor", 16.57),
    Published("matching and triangulation", 0.002, "<"),
    Published("sparse to dense", 67.90),
)
"""Of the paper's ResNet-50 network on two images; the encoder is in the first part.

Source: the paper, section 4.3. Its figures agree with a count of convolutions and of batch norm
(one multiply-accumulate per element for scale and one for shift), and of no correlation.
"""

PAPER_TOTAL = Published("DELTAS, ResNet-50", 84.48)
"""Source: as `PAPER_PARTS`."""

OTHER_TOTALS = (
    Published("DELTAS, VGG-9", 16.9),
    Published("MVDepthNet", 134.8),
    Published("DPSNet", 295.63),
)
"""Of two images, as the paper reports them: section 4.3, and the supplement for VGG-9."""
