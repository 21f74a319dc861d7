"""What networks and baselines have in common that take views and nothing else, and have no stages
of a network of deltas."""

from collections.abc import Sequence
from pathlib import Path

from deltas_nets.captures.frame import Frame
from deltas_nets.errors import UserError
from deltas_nets.network.deltas import Deltas
from deltas_nets.network.known_depth import KnownDepth
from deltas_nets.predict.depth_map import PredictConfig, Wanted
from deltas_nets.predict.described import AtSize

__all__ = ["ViewsAlone"]


class ViewsAlone:
    """A part of :class:`deltas_nets.predict.predictor.Predictor`: what these refuse."""

    @property
    def called(self) -> str:
        """As refusals call it."""
        raise NotImplementedError

    def check_measured(self) -> None:
        """It takes none."""
        what = f"{self.called} takes no measured depth, and looks at two views or more"
        raise UserError(what, "--sensor-depth", "leave it out")

    def refuse_measured(self, wanted: Wanted) -> None:
        """Refuse what only a network of deltas can use.

        Raises:
            UserError: there is measured depth, or no source.
        """
        if wanted.measured is not None or len(wanted.frames) == 1:
            self.check_measured()

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.called})"

    def refuse_confidence(self, config: PredictConfig) -> None:
        """Refuse what only a network that states a confidence can use.

        Raises:
            UserError: pixels of less confidence are to be left out.
        """
        if config.min_confidence > 0:
            what = f"{self.called} states no confidence"
            raise UserError(what, "--min-confidence", "leave it out")

    def redrawn(self, anchor: Frame, agreed: KnownDepth) -> KnownDepth:
        """It stays: there is no stage that redraws."""
        return agreed

    def compared(self, anchor: AtSize, drawn: KnownDepth, around: Sequence[AtSize]) -> KnownDepth:
        """It stays: there are no descriptors."""
        return drawn

    def deltas(self, refusal: str, where: str | Path, remedy: str) -> Deltas:
        """It is none."""
        raise UserError(refusal, where, remedy)
