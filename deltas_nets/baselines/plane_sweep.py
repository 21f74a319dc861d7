"""Plane sweep and semi-global matching as a predictor: what depth costs without learning."""

from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from deltas_geom import PosedViews
from deltas_nets.baselines.named import Named
from deltas_nets.baselines.sweep.semi_global import Penalties, aggregate
from deltas_nets.baselines.sweep.similarity import similarity_volume
from deltas_nets.baselines.sweep.smoothing import Smoothing, filled
from deltas_nets.baselines.sweep.winner import winner
from deltas_nets.captures.work_size import load_views
from deltas_nets.predict.depth_map import (
    DepthMap,
    KeypointDepths,
    Wanted,
    point_cloud,
    resized,
)

WORK_WIDTH = 320
"""Pixels of the longer side of what it looks at, unless a size is given."""
_PENALTIES = Penalties(step=0.2, jump=4.0, contrast=0.1)
_SMOOTHING = Smoothing(strength=100.0, contrast=0.03)


@dataclass(frozen=True)
class SweepConfig:
    """Numbers chosen on procedural rooms with the seeds from 5000 on, which nothing else uses."""

    planes: int = 96
    """Inverse depths."""
    window: int = 7
    """Side of the windows that are compared, pixels."""
    noise: float = 0.02
    """Grey values, 0 to 1, vary as much by noise alone."""
    penalties: Penalties = _PENALTIES
    """Of changes of depth, beside costs within 0 to 1."""
    least_similarity: float = 0.8
    """A pixel counts as a point where anchor and sources are so alike at the plane that won."""
    smoothing: Smoothing = _SMOOTHING
    """How far pixels of more weight reach into those of less."""


class SweepDepth(NamedTuple):
    """What the sweep says of an anchor.

    Attributes:
        depth: ``(H, W)`` everywhere, metres.
        believed: ``(H, W)`` bool: where anchor and sources are alike at this depth.
    """

    depth: Tensor
    believed: Tensor


class PlaneSweep(Named):
    """Plane sweep, semi-global matching, a filter and a fill; no learning.

    Args:
        device: where to compute.
        config: its numbers.
    """

    name = "plane-sweep"

    def __init__(
        self, device: str | torch.device = "cpu", config: SweepConfig | None = None
    ) -> None:
        self.device = device
        self.config = config or SweepConfig()

    @torch.inference_mode()
    def depth_map(self, wanted: Wanted) -> DepthMap:
        """Depth of the first frame from all of them; the points are the pixels it believes."""
        self.refuse_measured(wanted)
        work_size = wanted.config.work_size or size_of_sweep(wanted.anchor.image_size)
        images, views = load_views(wanted.frames, work_size=work_size)
        found = plane_sweep(
            images.to(self.device), views.to(self.device), wanted.config.depth_range, self.config
        )
        # Linear in inverse depth, as planes are.
        depth = np.reciprocal(resized(1 / found.depth[None], wanted.size))
        points, colors = point_cloud(wanted.anchor, depth, wanted.size, work_size)
        keypoints = KeypointDepths.of((found.depth * found.believed)[None])
        return DepthMap(depth, None, points, colors, keypoints)

    def network_record(self) -> dict[str, Any]:
        """Its name and numbers."""
        return {"name": self.name} | asdict(self.config)


def plane_sweep(
    images: Tensor, views: PosedViews, depth_range: tuple[float, float], config: SweepConfig
) -> SweepDepth:
    """Depth of view 0 of posed images.

    Args:
        images: ``(V, 3, H, W)`` RGB in [0, 1].
        views: ``(V,)``.
        depth_range: (near, far) of the planes, metres.
        config: numbers.
    """
    near, far = depth_range
    inv_depths = torch.linspace(1 / far, 1 / near, config.planes, device=images.device)
    # Rec. 601 luma.
    shares = torch.tensor([0.299, 0.587, 0.114], device=images.device)[:, None, None]
    grey = (images * shares).sum(dim=1, keepdim=True)
    similar = similarity_volume(grey, views, inv_depths, window=config.window, noise=config.noise)
    guide = grey[0, 0]
    best = winner(aggregate((1 - similar) / 2, guide, config.penalties) / 8)
    inverse = inv_depths[0] + best.place * (inv_depths[1] - inv_depths[0])
    # Where another plane is as good, neighbours know better.
    dense = filled(inverse, best.margin.clamp_min(0), guide, config.smoothing)
    depth = 1 / dense.clamp(inv_depths[0], inv_depths[-1])
    nearest = best.place.round().long().clamp(0, config.planes - 1)
    alike = similar.gather(0, nearest[None])[0]
    return SweepDepth(depth, alike > config.least_similarity)


def size_of_sweep(image_size: tuple[int, int]) -> tuple[int, int]:
    """The image with its longer side at `WORK_WIDTH`, never enlarged.

    Example:
        >>> size_of_sweep((360, 540))
        (213, 320)
    """
    scale = min(1.0, WORK_WIDTH / max(image_size))
    height, width = (max(1, round(side * scale)) for side in image_size)
    return height, width
