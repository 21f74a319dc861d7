"""The command `deltas fuse`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from deltas_nets.commands.command import Command
from deltas_nets.commands.depth_telling import show_fused
from deltas_nets.commands.flags import Flag, folder_for, opened, sensible
from deltas_nets.commands.unused import refuse_unused
from deltas_nets.errors import UserError
from deltas_nets.extras import usable_device
from deltas_nets.outputs.alone import Written
from deltas_nets.terminal import counted, progress, warn

if TYPE_CHECKING:
    from deltas_nets.captures.capture import Capture
    from deltas_nets.fuse.fusing import Fused
    from deltas_nets.fuse.products import FusedName


@dataclass(frozen=True)
class Fuse(Command):
    """Fuse the depth maps of a capture into a cloud and a mesh.

    Each map is compared with those of frames that see the same: depth stays where they agree, as
    far as the maps' own deviation lets expect. Writes DIR/cloud.ply (points with colours and
    normals), DIR/mesh.ply (coloured vertices) and DIR/fuse.json, in the capture's world and unit.
    Where DEPTHS has a page, index.html, it shows them then.

    Example: deltas fuse my_capture my_capture-depth

    The depth of a sensor: deltas fuse my_capture sensor --voxel 0.01
    """

    capture: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="CAPTURE")] = field(
        kw_only=True
    )
    """Folder with images, poses and intrinsics, or a file that names them."""
    depths: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="DEPTHS")] = field(
        kw_only=True
    )
    """Folder that deltas depth wrote, or the word sensor for the capture's own depth."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Folder to write to, CAPTURE-fused here if not given; the same command continues a run that
    was stopped."""
    cloud: Flag = False
    """Write cloud.ply; that and mesh.ply are written if nothing is asked for."""
    mesh: Flag = False
    """Write mesh.ply."""
    glb: Flag = False
    """Write mesh.glb, for browsers and Blender (extra mesh)."""
    voxel: Annotated[float | None, tyro.conf.arg(metavar="LENGTH")] = None
    """Side of a voxel in the capture's unit; from the deviation of the maps if not given."""
    min_confidence: Annotated[float | None, tyro.conf.arg(metavar="P")] = None
    """Leave out pixels of less confidence, 0 to 1; 0.4 if not given."""
    consistency: Flag = True
    """Do not compare maps with each other: all depth counts."""
    neighbours: int = 8
    """Maps that each is compared with."""
    least: int = 1
    """Of these so many have to agree with a pixel's depth, more than see through it."""
    memory: Annotated[float, tyro.conf.arg(metavar="GB")] = 4.0
    """Gigabytes that the mesh's voxels may take."""
    intrinsics: Annotated[str | None, tyro.conf.arg(metavar="NUMBERS")] = None
    """As deltas depth was told, if it was."""
    scale: Annotated[float | None, tyro.conf.arg(metavar="METRES")] = None
    """Metres in a unit of the capture, for sensor depth; maps know theirs."""
    device: str = "auto"
    """Where to compute: auto, cpu, cuda, cuda:1."""
    overwrite: Flag = False
    """Replace what other settings made."""
    debug: Flag = False
    """Show the traceback of an error."""

    going_on = "the same command goes on"

    @property
    def written(self) -> Written:
        """What no other run may write meanwhile."""
        return Written(self._out, "fuse")

    def run(self) -> None:
        """Run the command."""
        from deltas_nets.captures.scaled import in_metres

        out = self._out
        if out.resolve() == self.capture.resolve():
            what = "the output folder is the capture itself"
            raise UserError(what, out, "name another folder with --out")
        sensor = "maps, as sensor depth states no confidence" if self._of_sensor else None
        alone = None if self.consistency else "maps that are compared, without --no-consistency"
        unused = {"min_confidence": sensor, "neighbours": alone, "least": alone}
        refuse_unused(self, unused)
        capture = opened(self.capture, self.intrinsics)
        # Maps know theirs, to the last digit, as their cameras are known.
        if self.scale is not None and self._of_sensor:
            capture = in_metres(capture, self.scale)
        self.fuse(capture, out)
        show_fused(capture, self.depths, out)

    @property
    def _out(self) -> Path:
        return self.out or folder_for(self.capture, "fused")

    @property
    def _of_sensor(self) -> bool:
        return str(self.depths) == "sensor"

    def fuse(self, capture: "Capture", out: Path) -> None:
        """Fuse maps of a capture that is open."""
        from deltas_nets.fuse.config import FuseConfig
        from deltas_nets.fuse.fusing import fuse_capture
        from deltas_nets.fuse.sources import depth_source

        config = sensible(
            FuseConfig,
            voxel=self.voxel,
            neighbours=self.neighbours if self.consistency else 0,
            least=self.least,
        )
        source = depth_source(capture, self.depths, min_confidence=self.min_confidence)
        if source.doubt is not None:
            warn(source.doubt)
        if len(source.ids) == 1 and config.neighbours:
            warn("there is one map, and none to compare it with")
            config = sensible(FuseConfig, voxel=self.voxel, neighbours=0)
        elif config.neighbours and config.least >= len(source.ids):
            what = f"each of {len(source.ids)} maps has {len(source.ids) - 1} to agree with"
            raise UserError(what, f"--least {self.least}", "lower it")
        device = usable_device(self.device)
        with progress("fuse", len(source.ids)) as report:
            fused = fuse_capture(
                source,
                out,
                config,
                self.products(),
                gigabytes=self.memory,
                # Sums need float64 poses, which CUDA has and others lack.
                device=device if device.startswith("cuda") else "cpu",
                overwrite=self.overwrite,
                report=report,
            )
        self._tell(fused, source.least_confidence)

    def products(self) -> "list[FusedName]":
        """What is asked for."""
        asked: dict[FusedName, bool] = {"cloud": self.cloud, "mesh": self.mesh, "glb": self.glb}
        return [name for name, wanted in asked.items() if wanted] or ["cloud", "mesh"]

    def _tell(self, fused: "Fused", least_confidence: float) -> None:
        names = " and ".join(str(file) for file in fused.files)
        counts = ", ".join(f"{count} {what}" for what, count in fused.counts.items())
        print(f"{names}: {counts or 'kept from an earlier run'}")
        print(f"{counted(fused.frames, 'map')}, voxels of {fused.voxel:g}")
        if fused.left_out is not None:
            doubtful, unconfirmed = fused.left_out
            print(
                f"of their depth {fused.left_out.used:.0%} is used; {doubtful:.0%} is less sure "
                f"than --min-confidence {least_confidence:.2g}, {unconfirmed:.0%} is not confirmed "
                "by other maps"
            )
        if fused.doubt is not None:
            # What is asked for by other options is another mesh, in place of this one.
            there = any(file.parent != self.depths for file in fused.files)
            warn(fused.doubt + there * f"; with --overwrite in {fused.files[0].parent}")


def fuse_maps(
    capture: "Capture", folder: Path, *, cloud: bool, mesh: bool, device: str, overwrite: bool
) -> None:
    """What `deltas depth` does at its end: fuse the maps of its folder, if all are there.

    Where other shards are still at work the last of them does it. Maps are worth more: what
    hinders it is only a warning.
    """
    from deltas_nets.outputs.summary import SUMMARY, read_summary

    summary = read_summary(folder / SUMMARY)
    if summary is not None and summary["status"] == "complete":
        fuse = Fuse(
            capture=capture.path,
            depths=folder,
            cloud=cloud,
            mesh=mesh,
            device=device,
            overwrite=overwrite,
        )
        try:
            fuse.fuse(capture, folder)
        except UserError as error:
            warn(f"nothing was fused: {error}; the maps are whole")
