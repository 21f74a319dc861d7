"""The command `deltas export`: the whole network as one file for other programs."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

import tyro

from deltas_nets.commands.command import Command
from deltas_nets.commands.flags import Flag
from deltas_nets.commands.values import at_least, at_least_one
from deltas_nets.errors import UserError


@dataclass(frozen=True)
class Export(Command):
    """Write the whole network as one file: .onnx for onnxruntime, .pt2 for torch.export.load.

    Inputs are images (1, V, 3, H, W) in [0, 1], K (1, V, 3, 3) and cam_from_world (1, V, 4, 4);
    outputs depth and std (1, 1, H, W), keypoints (1, N, 2) and points (1, N, 3). The number of
    views and points, the size and the depth range are fixed. The file is written once it has given
    the same depth as the network, to 1e-3 at every pixel of a procedural room.

    Example: deltas export --out deltas.onnx --views 3 --size 240 320
    """

    out: Annotated[Path, tyro.conf.arg(metavar="FILE")]
    """File to write; its suffix, .onnx or .pt2, is the format."""
    weights: str = "deltas-small"
    """A shipped network, or a weights file of `deltas train`."""
    views: int = 3
    """Views, the anchor included."""
    points: int = 512
    """Points to triangulate."""
    size: Annotated[tuple[int, int], tyro.conf.arg(metavar="HEIGHT WIDTH")] = (240, 320)
    """Of the images."""
    depth_range: Annotated[tuple[float, float], tyro.conf.arg(metavar="NEAR FAR")] = (0.5, 10.0)
    """Nearest and farthest depth searched, metres."""
    refinement: int = 8
    """Samples in each bin of inverse depth. The network takes 8 at most; fewer are faster, and
    coarser where views are far apart."""
    overwrite: Flag = False
    """Replace --out if it exists."""
    debug: Flag = False
    """Show the traceback of an error."""

    checks: ClassVar = {"points": at_least(8), "refinement": at_least_one}

    def run(self) -> None:
        """Run the command."""
        from deltas_nets.export import ExportConfig, export_onnx, export_program
        from deltas_nets.outputs.atomic_files import check_file
        from deltas_nets.predict.predictor import load_predictor
        from deltas_nets.weights_file import weights_record

        writers = {".onnx": export_onnx, ".pt2": export_program}
        if self.out.suffix not in writers:
            raise UserError("the suffix is the format", f"--out {self.out}", "use .onnx or .pt2")
        if self.out.exists() and not self.overwrite:
            raise UserError("the file exists", self.out, "add --overwrite or name another")
        if self.points > math.prod(self.size):
            what = "there are fewer pixels than points"
            raise UserError(what, f"--points {self.points}", "use fewer, or a larger --size")
        config = ExportConfig(
            num_views=self.views,
            num_points=self.points,
            image_size=self.size,
            depth_range=self.depth_range,
            refinement=self.refinement,
        )
        check_file(self.out)
        # Of ours alone: a baseline is no network, and the reference is the authors' to export.
        what = "this is no network of deltas train, and is not exported"
        remedy = "name deltas-small, or its weights.safetensors"
        model = load_predictor(self.weights).deltas(what, self.weights, remedy)
        # Only the name: where files are is the machine's, and private.
        record = {**weights_record(self.weights), "name": Path(self.weights).name}
        agreement = writers[self.out.suffix](model, self.out, config, weights=record)
        megabytes = self.out.stat().st_size / 1e6
        print(
            f"{self.out} ({megabytes:.1f} MB) gives the network's depth "
            f"to {agreement.relative:.1g} of it"
        )
