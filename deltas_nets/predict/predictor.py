"""What every network that predicts can be asked, and which one a weights file holds."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, Protocol, get_args

import torch

from deltas_nets import reference
from deltas_nets.captures.capture import Capture, Frame
from deltas_nets.captures.view_sets import ViewSet
from deltas_nets.config.baselines import BASELINES
from deltas_nets.config.lookup import look_up
from deltas_nets.config.varied import NetworkSettings
from deltas_nets.errors import UserError
from deltas_nets.extras import usable_device
from deltas_nets.network.deltas import Deltas
from deltas_nets.network.known_depth import KnownDepth
from deltas_nets.predict.dense import DensePredictor
from deltas_nets.predict.depth_map import DepthMap, PredictConfig, Wanted
from deltas_nets.predict.described import AtSize
from deltas_nets.predict.ours import DeltasPredictor
from deltas_nets.predict.reference import ReferencePredictor
from deltas_nets.weights_file import load_network, weights_file

Precision = Literal["float32", "bfloat16"]


class Predictor(Protocol):
    """A network of deltas, the reference network or a baseline, as commands see it."""

    @property
    def states_confidence(self) -> bool:
        """Whether maps come with a confidence."""

    @property
    def takes_larger(self) -> bool:
        """Whether its confidence tells how large it should see a capture's images."""

    def check_asked(
        self, config: PredictConfig, capture: Capture, view_sets: Sequence[ViewSet]
    ) -> None:
        """Whether the network can do what it is asked for.

        Args:
            config: sizes, range, confidence.
            capture: the frames.
            view_sets: anchors and sources.

        Raises:
            UserError: names what it cannot.
        """

    def check_measured(self) -> None:
        """Whether the network takes measured depth.

        Raises:
            UserError: it takes none.
        """

    def depth_map(self, wanted: Wanted) -> DepthMap:
        """Depth of the first frame from all of them; frames seen before need not be encoded again.

        Args:
            wanted: frames, and a config that asks for what it can do (:meth:`check_asked`), as
                measured depth does (:meth:`check_measured`).

        Raises:
            UserError: an image cannot be read; the network does not take measured depth, or there
                is neither a source nor such depth.
        """

    def redrawn(self, anchor: Frame, agreed: KnownDepth) -> KnownDepth:
        """A map that several frames agreed on, with the edges that its image shows.

        Args:
            anchor: its frame, straight.
            agreed: ``(1, h, w)``, of the size that the network works at.

        Returns:
            As good a map as the network can make of it; the same if it has no stage for that.

        Raises:
            UserError: the image cannot be read.
        """

    def compared(self, anchor: AtSize, drawn: KnownDepth, around: Sequence[AtSize]) -> KnownDepth:
        """A map moved to where other frames show the same.

        Args:
            anchor: its frame.
            drawn: ``(1, h, w)``, in the unit of the frames' poses.
            around: those that see the same places.

        Returns:
            The same if the network has nothing to compare images by.

        Raises:
            UserError: an image cannot be read.
        """

    def varied(self, settings: NetworkSettings) -> "Predictor":
        """The same weights under other numbers of the supplement.

        Raises:
            UserError: the network has no such setting (:meth:`NetworkSettings.check_known`).
        """

    def deltas(self, refusal: str, where: str | Path, remedy: str) -> Deltas:
        """The network itself, for what needs all stages of one of deltas.

        Raises:
            UserError: of the arguments, if it is another network.
        """

    def network_record(self) -> dict[str, Any]:
        """What the network is, for the record of a run."""

    def weights_record(self, name_or_file: str) -> dict[str, str]:
        """What identifies the file that it was loaded from, and where that comes from."""


def load_predictor(
    name_or_file: str | Path,
    device: str | torch.device = "cpu",
    *,
    precision: Precision = "float32",
) -> Predictor:
    """The network of a shipped name, of a file of `deltas train`, or of the published checkpoint;
    or the baseline of a name.

    Args:
        name_or_file: what the file holds is read from it, not from its name.
        device: where to put it; "auto" is a CUDA device where there is one.
        precision: of the weights; geometry stays in float32.

    Raises:
        UserError: no such file or device, or the file holds none of these, or not all of its
            weights, or the network does not run in this precision.
        ValueError: no such precision.

    Example:
        >>> load_predictor("deltas-small").network_record()["name"]
        'deltas-small'
    """
    if precision not in get_args(Precision):
        raise ValueError(f"precision must be one of {get_args(Precision)}, got {precision!r}")
    device = usable_device(device)
    if name_or_file in BASELINES:
        _check_float32(precision, str(name_or_file))
        baseline: Predictor = look_up("deltas_nets.baselines", BASELINES[str(name_or_file)])(device)
        return baseline
    file = weights_file(name_or_file, beside=BASELINES)
    if reference.is_published(file):
        _check_float32(precision, "the reference network")
        return ReferencePredictor(reference.load(file, device=device))
    if not _is_safetensors(file):
        raise UserError(
            "neither weights of deltas train nor the published checkpoint",
            file,
            "name a weights.safetensors, or the file that the authors of the paper published",
        )
    model = load_network(name_or_file, device)
    model = model.bfloat16() if precision == "bfloat16" else model
    return DeltasPredictor(model) if isinstance(model, Deltas) else DensePredictor(model)


def _check_float32(precision: Precision, name: str) -> None:
    """Refuse any other."""
    if precision != "float32":
        what = f"{name} runs in float32 alone"
        raise UserError(what, f"--precision {precision}", "leave it out")


def _is_safetensors(file: Path) -> bool:
    """Its header is JSON after eight bytes of its length; torch's files are archives or pickles."""
    with file.open("rb") as opened:
        return opened.read(9)[8:] == b"{"
