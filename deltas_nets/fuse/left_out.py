"""How much of the maps' depth is used, and what to do where little comes of it."""

from collections.abc import Iterable, Mapping
from typing import NamedTuple

from deltas_nets.fuse.config import FuseConfig
from deltas_nets.fuse.depth_view import DepthView
from deltas_nets.fuse.sizes import Sizes

__all__ = ["LeftOut", "cure", "doubt", "left_out_of", "mean_left_out"]

COARSE = 0.05
"""Of the depth: larger voxels show little of a scene."""
FINE = 0.01
"""Of the depth: voxels that are advised then."""
FEW = 500
"""Points or faces that are hardly a scene."""
LITTLE = 0.2
"""Share of the depth that is hardly all there was."""


class LeftOut(NamedTuple):
    """Shares of a map's depth that are not used.

    Attributes:
        doubtful: that is less sure than was asked for.
        unconfirmed: the rest of what other maps do not confirm.
    """

    doubtful: float
    unconfirmed: float

    @property
    def used(self) -> float:
        """What is left."""
        return round(max(0.0, 1 - self.doubtful - self.unconfirmed), 9)


def left_out_of(doubtful: float, sure: DepthView, confirmed: DepthView) -> LeftOut | None:
    """What a map lost on its way; None if it had nothing.

    Args:
        doubtful: share of its depth that is not in ``sure``.
        sure: what was read.
        confirmed: what other maps left of that.
    """
    before, after = (int((view.depth > 0).sum()) for view in (sure, confirmed))
    if before == 0:
        return LeftOut(doubtful, 0.0) if doubtful else None
    return LeftOut(doubtful, (1 - doubtful) * (1 - after / before))


def mean_left_out(maps: Iterable[LeftOut | None]) -> LeftOut:
    """Of some maps, those without any depth aside."""
    known = [shares for shares in maps if shares is not None]
    count = max(1, len(known))
    return LeftOut(
        sum(shares.doubtful for shares in known) / count,
        sum(shares.unconfirmed for shares in known) / count,
    )


def cure(left_out: LeftOut, sizes: Sizes, config: FuseConfig) -> str:
    """What makes more of the maps: it never names what was asked for already.

    Voxels come first, as nothing else helps where they are coarse.
    """
    if _coarse(sizes) and left_out.used > 0:
        return f"deltas fuse --voxel {FINE * sizes.depth:.1g} shows more"
    if left_out.unconfirmed > left_out.doubtful:
        if config.least > 1:
            return "deltas fuse --least 1 asks for one map that agrees"
        return "deltas fuse --no-consistency uses what no other map confirms"
    if left_out.doubtful > 0:
        return "deltas fuse --min-confidence 0 uses all depth, sure or not"
    return "look at the maps, they hold hardly more"


def doubt(
    counts: Mapping[str, int], left_out: LeftOut, sizes: Sizes, config: FuseConfig
) -> str | None:
    """A line on what was made, where it is little or coarse."""
    few = [f"{counts[what]} {what}" for what in ("points", "faces") if counts.get(what, FEW) < FEW]
    if few:
        what = f"little was made ({', '.join(few)})"
    elif _coarse(sizes):
        what = f"voxels of {sizes.voxel:g} are coarse for a scene that is {sizes.depth:.2g} away"
    elif left_out.used < LITTLE:
        what = f"{left_out.used:.0%} of the depth is used"
    else:
        return None
    return f"{what}: {cure(left_out, sizes, config)}"


def _coarse(sizes: Sizes) -> bool:
    return sizes.voxel > COARSE * sizes.depth
