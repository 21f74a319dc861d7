"""Flags that several commands share."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import tyro

from deltas_nets.commands.command import Command
from deltas_nets.errors import UserError

if TYPE_CHECKING:
    from deltas_nets.predict.depth_map import PredictConfig
    from deltas_nets.predict.predictor import Predictor


T = TypeVar("T")

Flag = tyro.conf.FlagCreatePairsOff[bool]
Network = Literal["deltas-small", "deltas-resnet50", "deltas-vgg9"]
NETWORKS: tuple[Network, ...] = ("deltas-small", "deltas-resnet50", "deltas-vgg9")


@dataclass(frozen=True)
class Prediction(Command):
    """A command that predicts: flags that all of them have."""

    weights: str = "deltas-small"
    """A shipped network, a weights file of `deltas train`, or the checkpoint that the paper's
    authors published (for depth and evaluate; it states no confidence)."""
    device: str = "auto"
    """Where to compute: auto, cpu, cuda, cuda:1, mps."""
    precision: Literal["float32", "bfloat16"] = "float32"
    """bfloat16 is as accurate, and faster where the processor multiplies it (AMX, NVIDIA); others
    emulate it. Geometry stays in float32."""
    depth_range: tuple[float, float] = (0.5, 10.0)
    """Nearest and farthest depth searched, metres."""
    work_size: Annotated[tuple[int, int] | None, tyro.conf.arg(metavar="HEIGHT WIDTH")] = None
    """What the network sees; chosen to suit it if not given."""
    debug: Flag = False
    """Show the traceback of an error."""

    def predictor(self) -> "Predictor":
        """The network, where it is to run."""
        from deltas_nets.predict.predictor import load_predictor

        device = usable_device(self.device)
        return load_predictor(self.weights, device, precision=self.precision)

    def config(self, **more: Any) -> "PredictConfig":
        """The flags as a config, with nonsense refused."""
        from deltas_nets.predict.depth_map import PredictConfig

        fields = {"depth_range": self.depth_range, "work_size": self.work_size, **more}
        return sensible(PredictConfig, **fields)


def sensible(config: Callable[..., T], **fields: Any) -> T:
    """A config of some flags, with nonsense refused in the config's own words.

    Raises:
        UserError: the config raises ValueError.
    """
    try:
        return config(**fields)
    except ValueError as error:
        raise UserError(str(error), "command line", "see --help of this command") from None


def usable_device(name: str) -> str:
    """The device of ``--device``; "auto" is a CUDA device where there is one.

    Raises:
        UserError: nothing can be computed there.
    """
    import torch

    if name == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    try:
        torch.empty(0, device=name)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise UserError(f"cannot compute there ({reason})", f"--device {name}", "use cpu") from None
    return name
