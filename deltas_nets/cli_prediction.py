"""What `deltas demo`, `depth` and `evaluate` have in common: the flags of a prediction."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from deltas_nets.cli_training import Flag
from deltas_nets.errors import UserError

if TYPE_CHECKING:
    from deltas_nets.any_network import AnyNetwork
    from deltas_nets.predict import PredictConfig


@dataclass(frozen=True)
class Prediction:
    """Flags of every command that predicts."""

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

    def network(self) -> "AnyNetwork":
        """The network, where it is to run."""
        from deltas_nets.any_network import load_network
        from deltas_nets.checked_inputs import usable_device
        from deltas_nets.network.deltas import Deltas

        network = load_network(self.weights, usable_device(self.device))
        if self.precision == "float32":
            return network
        if not isinstance(network, Deltas):
            what = "the published network runs in float32 alone"
            raise UserError(what, f"--precision {self.precision}", "leave it out")
        return network.bfloat16()

    def config(self, **more: Any) -> "PredictConfig":
        """The flags as a config, with nonsense refused."""
        from deltas_nets.predict import PredictConfig

        try:
            return PredictConfig(depth_range=self.depth_range, work_size=self.work_size, **more)
        except ValueError as error:
            raise UserError(str(error), "command line", "see --help of this command") from None
