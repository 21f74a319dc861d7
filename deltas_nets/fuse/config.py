"""What a fusion depends on besides its maps."""

import math
from dataclasses import dataclass

__all__ = ["FuseConfig"]


@dataclass(frozen=True)
class FuseConfig:
    """How maps are fused; see `deltas fuse --help`."""

    voxel: float | None = None
    """Side of a voxel in the capture's unit; from the maps' deviation if not given."""
    neighbours: int = 8
    """Maps that each is compared with; 0 for none: all depth counts."""
    least: int = 1
    """Of these so many have to agree with a pixel's depth, and fewer than that see through it."""
    deviations: float = 0.5
    """How far depths may differ and agree, in standard deviations of the difference."""

    def __post_init__(self) -> None:
        if self.voxel is not None and not (0 < self.voxel < math.inf):
            raise ValueError(f"--voxel must be positive, got {self.voxel:g}")
        if self.neighbours < 0:
            raise ValueError(f"--neighbours must be 0 or more, got {self.neighbours}")
        if self.least < 1:
            raise ValueError(f"--least must be 1 or more, got {self.least}")
        if 0 < self.neighbours < self.least:
            what = f"--least {self.least} of {self.neighbours} maps can never agree"
            raise ValueError(f"{what}: lower it, or raise --neighbours")
        if not self.deviations > 0:
            raise ValueError(f"--deviations must be positive, got {self.deviations:g}")
