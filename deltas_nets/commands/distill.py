"""The command `deltas distill`: interest points that another detector finds, or finds again."""

from dataclasses import dataclass

from deltas_nets.commands.command import Command
from deltas_nets.commands.flags import Flag
from deltas_nets.config.distill import DistillConfig
from deltas_nets.extras import usable_device
from deltas_nets.outputs.alone import Written
from deltas_nets.terminal import progress


@dataclass(frozen=True)
class Distill(DistillConfig, Command):
    """Teach the detector of weights to find another detector's points, or its own more steadily.

    Nothing else of the network changes. The teacher looks at every picture of a pool from several
    sides and keeps what it finds from most; the student learns to find that in other light. The
    weights say whose points they know, with the licence of the teacher's own. They have lost their
    calibration: other points have other errors.

    Example: deltas distill --teacher aliked --teacher-weights aliked-n16.pth --out mine.safetensors
    """

    device: str = "auto"
    """Where to compute: auto, cpu, cuda, cuda:1, mps."""
    overwrite: Flag = False
    """Replace --out if it exists."""
    debug: Flag = False
    """Show the traceback of an error."""

    @property
    def written(self) -> Written:
        """What no other run may write meanwhile."""
        return Written(self.out.parent, "weights", self.out.name)

    def run(self) -> None:
        """Run the command."""
        from deltas_nets.distill.training import distill
        from deltas_nets.weights_file import read_metadata

        device = usable_device(self.device)
        with progress("distill", self.num_images + self.steps) as report:
            distill(self, device=device, overwrite=self.overwrite, report=report)
        loss = read_metadata(self.out)["detector_loss"]
        print(f"weights in {self.out}, loss {loss} at the end")
        print(f"not calibrated: deltas calibrate --weights {self.out} --out FILE")
