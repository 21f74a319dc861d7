"""A cost-volume network makes a depth map of posed frames: no points, but a deviation."""

from collections.abc import Sequence
from typing import Any

import torch

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.view_sets import ViewSet
from deltas_nets.captures.work_size import load_views
from deltas_nets.config import to_dict
from deltas_nets.config.varied import NetworkSettings
from deltas_nets.network.cost_volume.network import CostVolume
from deltas_nets.network.known_depth import KnownDepth
from deltas_nets.predict.depth_map import (
    DepthMap,
    PredictConfig,
    Wanted,
    finished_map,
    keypoint_depths,
)
from deltas_nets.predict.ours import work_size_of
from deltas_nets.predict.views_alone import ViewsAlone
from deltas_nets.weights_file import weights_record


class DensePredictor(ViewsAlone):
    """A cost-volume network; see :class:`deltas_nets.predict.predictor.Predictor`.

    Args:
        model: trained, on any device.
    """

    states_confidence = True
    takes_larger = False

    def __init__(self, model: CostVolume) -> None:
        self.model = model

    @property
    def called(self) -> str:
        """By the name of its config."""
        return self.model.config.name

    def check_asked(
        self, config: PredictConfig, capture: Capture, view_sets: Sequence[ViewSet]
    ) -> None:
        """It can do all of it."""

    def varied(self, settings: NetworkSettings) -> "DensePredictor":
        """It has no points that settings could be of."""
        settings.check_known(self.model.config.name)
        return self

    @torch.inference_mode()
    def depth_map(self, wanted: Wanted) -> DepthMap:
        """Depth of the first frame from all of them; it takes no measured depth."""
        self.refuse_measured(wanted)
        config, work_size = wanted.config, work_size_of(wanted.anchor, wanted.config)
        device = next(self.model.parameters()).device
        images, views = load_views(wanted.frames, work_size=work_size)
        found = self.model(images.to(device), views.to(device), config.depth_range)
        work = KnownDepth(found.depth, found.std / found.depth)
        return finished_map(wanted.anchor, work, keypoint_depths(found), config)

    def network_record(self) -> dict[str, Any]:
        """Its config."""
        return to_dict(self.model.config)

    def weights_record(self, name_or_file: str) -> dict[str, str]:
        """What the weights file says of itself."""
        return weights_record(name_or_file)
