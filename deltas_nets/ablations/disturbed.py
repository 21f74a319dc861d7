"""A network that is given wrong frames, or a world in another unit, and is scored by the right one.

The truth is that of the capture as it is: only what the network sees is changed.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from deltas_nets.ablations.changes import FrameChange
from deltas_nets.captures.capture import Capture
from deltas_nets.captures.frame import Frame
from deltas_nets.captures.scaled import moved_frame
from deltas_nets.captures.view_sets import ViewSet
from deltas_nets.config.varied import NetworkSettings
from deltas_nets.network.deltas import Deltas
from deltas_nets.network.known_depth import KnownDepth
from deltas_nets.predict.depth_map import DepthMap, PredictConfig, Wanted
from deltas_nets.predict.described import AtSize
from deltas_nets.predict.look import look
from deltas_nets.predict.predictor import Predictor
from deltas_nets.predict.reach import Reach

__all__ = ["Disturbed", "InUnit"]


class Disturbed:
    """See :class:`deltas_nets.predict.predictor.Predictor`.

    Args:
        inner: the network.
        change: of every frame before the network sees it.
    """

    def __init__(self, inner: Predictor, change: FrameChange) -> None:
        self.inner = inner
        self.change = change

    @property
    def states_confidence(self) -> bool:
        """As the network."""
        return self.inner.states_confidence

    @property
    def takes_larger(self) -> bool:
        """As the network."""
        return self.inner.takes_larger

    def varied(self, settings: NetworkSettings) -> "Disturbed":
        """The network of other settings, disturbed as this one."""
        return Disturbed(self.inner.varied(settings), self.change)

    def check_asked(
        self, config: PredictConfig, capture: Capture, view_sets: Sequence[ViewSet]
    ) -> None:
        """As the network."""
        self.inner.check_asked(config, capture, view_sets)

    def check_measured(self) -> None:
        """As the network."""
        self.inner.check_measured()

    def depth_map(self, wanted: Wanted) -> DepthMap:
        """Depth of the first frame from what was made of all."""
        changed = [self.change(frame) for frame in wanted.frames]
        return self.inner.depth_map(wanted._replace(frames=changed))

    def redrawn(self, anchor: Frame, agreed: KnownDepth) -> KnownDepth:
        """As the network, which sees the changed image."""
        return self.inner.redrawn(self.change(anchor), agreed)

    def compared(self, anchor: AtSize, drawn: KnownDepth, around: Sequence[AtSize]) -> KnownDepth:
        """As the network, which sees the changed images."""
        mine, *others = (seen._replace(frame=self.change(seen.frame)) for seen in (anchor, *around))
        return self.inner.compared(mine, drawn, others)

    def deltas(self, refusal: str, where: str | Path, remedy: str) -> Deltas:
        """As the network."""
        return self.inner.deltas(refusal, where, remedy)

    def network_record(self) -> dict[str, Any]:
        """As the network."""
        return self.inner.network_record()

    def weights_record(self, name_or_file: str) -> dict[str, str]:
        """As the network."""
        return self.inner.weights_record(name_or_file)


class InUnit(Disturbed):
    """The world in units of ``1 / factor`` metres.

    Args:
        inner: the network.
        factor: units in a metre.
        told: whether the network is told, and sees metres all the same; else it takes units for
            metres and searches so many more or fewer.
    """

    def __init__(self, inner: Predictor, factor: float, *, told: bool) -> None:
        super().__init__(inner, lambda frame: moved_frame(frame, factor))
        self.factor = factor
        self.told = told

    def varied(self, settings: NetworkSettings) -> "InUnit":
        """The network of other settings, in the same unit."""
        return InUnit(self.inner.varied(settings), self.factor, told=self.told)

    def depth_map(self, wanted: Wanted) -> DepthMap:
        """Depth of the first frame in metres again."""
        near, far = (self.factor * depth for depth in wanted.config.depth_range)
        unit = 1 / self.factor if self.told else 1.0
        scaled = [self.change(frame) for frame in wanted.frames]
        in_units = replace(wanted.config, depth_range=(near, far))
        found = look(self.inner, scaled, in_units, Reach(near, far, unit), wanted.measured)
        keypoints = found.keypoints._replace(depth=found.keypoints.depth / self.factor)
        depth = (found.depth / self.factor).astype(np.float32)
        return found._replace(depth=depth, keypoints=keypoints)
