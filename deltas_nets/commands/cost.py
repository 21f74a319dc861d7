"""The command `deltas cost`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from deltas_nets.commands.command import Command
from deltas_nets.commands.flags import NETWORKS, Flag, Network
from deltas_nets.config import CONFIGS
from deltas_nets.extras import usable_device

Measured = Literal[Network, "cost-volume", "reference"]


@dataclass(frozen=True)
class Cost(Command):
    """Parameters, multiply-accumulates and time of a network by stage, beside the paper's.

    Example: deltas cost deltas-small --views 3
    """

    networks: tyro.conf.Positional[tuple[Measured, ...]] = (*NETWORKS, "reference")
    """Which ones, with random weights; reference is the network that the paper's authors
    published."""
    views: int = 2
    """Views, the anchor included."""
    size: Annotated[tuple[int, int], tyro.conf.arg(metavar="HEIGHT WIDTH")] = (240, 320)
    """Of the images."""
    num_keypoints: int = 512
    """Points to triangulate."""
    repeats: int = 5
    """Runs that are timed."""
    device: str = "auto"
    """Where to compute: auto, cpu, cuda, cuda:1, mps."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Also write everything to this file."""
    debug: Flag = False
    """Show the traceback of an error."""

    def run(self) -> None:
        """Run the command."""
        from deltas_nets.cost.command import run_cost
        from deltas_nets.network.networks import build_network
        from deltas_nets.outputs.atomic_files import check_file
        from deltas_nets.reference import ReferenceNetwork

        if self.json is not None:
            check_file(self.json)
        device = usable_device(self.device)
        networks = {
            name: ReferenceNetwork() if name == "reference" else build_network(CONFIGS[name])
            for name in self.networks
        }
        run_cost(
            {name: network.to(device).eval() for name, network in networks.items()},
            num_views=self.views,
            image_size=self.size,
            num_keypoints=self.num_keypoints,
            repeats=self.repeats,
            json=self.json,
        )
