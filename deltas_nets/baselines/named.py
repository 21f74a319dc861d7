"""What baselines have in common: no weights of their own, and a refusal where ours are needed."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Self

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.frame import Frame
from deltas_nets.captures.measured import MeasuredDepth
from deltas_nets.captures.view_sets import ViewSet
from deltas_nets.config.varied import NetworkSettings
from deltas_nets.errors import UserError
from deltas_nets.network.deltas import Deltas
from deltas_nets.predict.depth_map import DepthMap, PredictConfig


class Named:
    """The part of :class:`deltas_nets.predict.predictor.Predictor` that all of them share.

    Attributes:
        name: as `--weights` takes it.
        states_confidence: none of them does.
    """

    name: str
    states_confidence = False

    def check_asked(
        self, config: PredictConfig, capture: Capture, view_sets: Sequence[ViewSet]
    ) -> None:
        """It states no confidence."""
        if config.min_confidence > 0:
            what = f"{self.name} states no confidence"
            raise UserError(what, "--min-confidence", "leave it out")

    def varied(self, settings: NetworkSettings) -> Self:
        """It has no settings of a network."""
        settings.check_known(self.name)
        return self

    def refuse_measured(self, frames: Sequence[Frame], measured: MeasuredDepth | None) -> None:
        """Refuse what only a network of deltas can use.

        Raises:
            UserError: there is measured depth, or no source.
        """
        if measured is not None or len(frames) == 1:
            what = f"{self.name} takes no measured depth, and looks at two views or more"
            raise UserError(what, "--sensor-depth", "leave it out")

    def depth_map(
        self,
        frames: Sequence[Frame],
        config: PredictConfig,
        measured: MeasuredDepth | None = None,
    ) -> DepthMap:
        """Depth of the first frame from all of them."""
        raise NotImplementedError

    def deltas(self, refusal: str, where: str | Path, remedy: str) -> Deltas:
        """It is none."""
        raise UserError(refusal, where, remedy)

    def network_record(self) -> dict[str, Any]:
        """Its name in records."""
        return {"name": self.name}

    def weights_record(self, name_or_file: str) -> dict[str, str]:
        """It has no weights."""
        return {"name": name_or_file, "origin": "a baseline without weights of its own"}
