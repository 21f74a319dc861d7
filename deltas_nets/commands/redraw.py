"""The command `deltas redraw`: a stage that draws agreed maps anew."""

from dataclasses import dataclass

from deltas_nets.commands.command import Command
from deltas_nets.commands.flags import Flag
from deltas_nets.config.redraw import RedrawConfig
from deltas_nets.extras import usable_device
from deltas_nets.outputs.alone import Written
from deltas_nets.terminal import progress


@dataclass(frozen=True)
class Redraw(RedrawConfig, Command):
    """Train the stage that draws a map anew after several frames agreed on it.

    Nothing else of the network changes, nor do maps of one pass. It learns from procedural rooms:
    from the network's own maps of them, after these have heard each other. --init goes on from
    weights that have the stage; a network that learns on (`deltas train --init`) loses it.

    Example: deltas redraw --out mine.safetensors --log mine.jsonl
    """

    device: str = "auto"
    """Where to compute: auto, cpu, cuda, cuda:1, mps."""
    overwrite: Flag = False
    """Replace --out and --log if they exist."""
    debug: Flag = False
    """Show the traceback of an error."""

    @property
    def written(self) -> Written:
        """What no other run may write meanwhile."""
        return Written(self.out.parent, "weights", self.out.name)

    def run(self) -> None:
        """Run the command."""
        from deltas_nets.train.redraw import train_redraw

        device = usable_device(self.device)
        with progress("redraw", self.num_rooms + self.steps) as report:
            train_redraw(self, device=device, overwrite=self.overwrite, report=report)
        print(f"weights in {self.out}")
