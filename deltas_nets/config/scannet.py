"""Which frames of ScanNet a training looks at, and which of them together."""

from dataclasses import dataclass
from math import inf
from typing import Annotated, Literal

import tyro

PAPER_GAPS = {2: 20, 3: 20, 4: 15, 5: 12, 6: 11, 7: 10}
"""Frames from one view to the next, by the number of views (section 4.3; 6 is between its
neighbours). So every tuple spans about the same volume."""


@dataclass(frozen=True)
class ScanNetConfig:
    """Frames of scene folders in ScanNet's export layout."""

    root: Annotated[str | None, tyro.conf.arg(name="root", prefix_name=False, metavar="DIR")] = None
    """scannet: folder that holds scenes, or scans/ and scans_test/ with scenes in them."""
    split: Annotated[str, tyro.conf.arg(metavar="NAME-OR-FILE")] = "train"
    """scannet: a file with the name of a scene on each line, as ScanNet's own
    scannetv2_train.txt; or train (scene0000 to scene0706, the paper's), test (scene0707 to
    scene0806), all (whatever is there)."""
    validation: Annotated[str | None, tyro.conf.arg(metavar="NAME-OR-FILE")] = None
    """scannet: scenes to evaluate on during training, like split; procedural rooms if not given."""
    validation_tuples: int = 60
    """scannet: of so many tuples, spread evenly over them."""
    skip: Annotated[str | None, tyro.conf.arg(metavar="FILE")] = None
    """scannet: file of frames to leave out; a line is SCENE FRAME, SCENE FIRST-LAST or SCENE *.
    Frames without a finite, rigid pose or without depth are left out anyway."""
    tuples: Literal["gap", "baseline"] = "gap"
    """scannet: views are so many frames apart, before and after the anchor; or so many metres."""
    gap: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """scannet: frames from one view to the next; if not given, the paper's: 20 for 2 and 3
    views, 15 for 4, 12 for 5, 10 for 7."""
    baseline: Annotated[tuple[float, float], tyro.conf.arg(metavar="LOW HIGH")] = (0.05, 0.25)
    """scannet, tuples by baseline: metres from the anchor to each source."""
    max_rotation: float = 20.0
    """scannet, tuples by baseline: largest angle between the anchor and a source, degrees."""

    def __post_init__(self) -> None:
        if self.gap is not None and self.gap < 1:
            raise ValueError(f"gap must be at least 1, got {self.gap}")
        if not 0 < self.baseline[0] < self.baseline[1] < inf:
            raise ValueError(f"baseline must be 0 < low < high metres, got {self.baseline}")
        if not 0 < self.max_rotation <= 180:
            raise ValueError(f"max_rotation must be within (0, 180], got {self.max_rotation}")
        if self.validation_tuples < 1:
            raise ValueError(f"validation_tuples must be at least 1, got {self.validation_tuples}")

    def gap_of(self, num_views: int) -> int:
        """Frames from one view to the next; beyond the paper's 7 views, within as many frames.

        Example:
            >>> ScanNetConfig().gap_of(3), ScanNetConfig(gap=4).gap_of(3)
            (20, 4)
        """
        if self.gap is not None:
            return self.gap
        return PAPER_GAPS.get(num_views) or max(1, 60 // (num_views - 1))
