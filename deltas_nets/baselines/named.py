"""What baselines have in common: no weights of their own, and refusals where ours are needed."""

from collections.abc import Sequence
from typing import Any, Self

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.view_sets import ViewSet
from deltas_nets.config.varied import NetworkSettings
from deltas_nets.predict.depth_map import DepthMap, PredictConfig, Wanted
from deltas_nets.predict.views_alone import ViewsAlone


class Named(ViewsAlone):
    """The part of :class:`deltas_nets.predict.predictor.Predictor` that all of them share.

    Attributes:
        name: as `--weights` takes it.
        states_confidence: none of them does.
    """

    name: str
    states_confidence = False
    takes_larger = False

    @property
    def called(self) -> str:
        """By its name."""
        return self.name

    def check_asked(
        self, config: PredictConfig, capture: Capture, view_sets: Sequence[ViewSet]
    ) -> None:
        """It states no confidence."""
        self.refuse_confidence(config)

    def varied(self, settings: NetworkSettings) -> Self:
        """It has no settings of a network."""
        settings.check_known(self.name)
        return self

    def depth_map(self, wanted: Wanted) -> DepthMap:
        """Depth of the first frame from all of them."""
        raise NotImplementedError

    def network_record(self) -> dict[str, Any]:
        """Its name in records."""
        return {"name": self.name}

    def weights_record(self, name_or_file: str) -> dict[str, str]:
        """It has no weights."""
        return {"name": name_or_file, "origin": "a baseline without weights of its own"}
