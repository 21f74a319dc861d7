"""The command `deltas convert`."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from deltas_nets.commands.command import Command
from deltas_nets.commands.flags import Flag, opened
from deltas_nets.errors import UserError
from deltas_nets.terminal import counted, progress, warn

if TYPE_CHECKING:
    from deltas_nets.captures.capture import Capture


POINTS = 100_000


@dataclass(frozen=True)
class Convert(Command):
    """Write a capture in another format: ours, ScanNet's export, COLMAP, transforms.json.

    Reads every format that deltas depth reads, finds images that have moved, and writes them beside
    cameras, poses, depth and sparse points, as far as the format has a place for them; what it has
    none for is said. Nothing is written where a lens or a pose would be lost.

    Example: deltas convert my_colmap_folder my_capture --to own
    """

    capture: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="IN")] = field(
        kw_only=True
    )
    """Folder or file of a capture."""
    out: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="OUT")] = field(kw_only=True)
    """Folder to write: a new one, or an empty one."""
    to: Literal["own", "scannet", "colmap", "colmap-bin", "transforms"] = "own"
    """own: frames.json, which keeps everything; colmap: text; colmap-bin: binary."""
    images: Literal["copy", "link"] = "copy"
    """Copy images and depth, or link to where they are."""
    scale: Annotated[float | None, tyro.conf.arg(metavar="METRES")] = None
    """Length of the capture's unit, if you know it, and of its depth files': what is written is in
    metres then."""
    scale_from: Annotated[Path | None, tyro.conf.arg(metavar="sensor|FILE")] = None
    """Find that length by its sensor depth, which is in metres, or by a file of measured depths:
    lines ID X Y METRES."""
    depths: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Maps that deltas depth made of this capture: they go along as its depth, where the format has
    a place, and confident points of them, with tracks, become its sparse points: what splatting
    starts from."""
    points: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """With --depths: how many points, about; 100 000 if not given."""
    intrinsics: Annotated[str | None, tyro.conf.arg(metavar="NUMBERS")] = None
    """Of all images, in quotes: fx fy cx cy and, of a lens, k1 k2 p1 p2 k3; or freiburg1."""
    debug: Flag = False
    """Show the traceback of an error."""

    def run(self) -> None:
        """Run the command."""
        from deltas_nets.captures.new_folder import check_new

        check_new(self.out)
        if self.points is not None and self.points < 1:
            raise UserError("too few points", f"--points {self.points}", "give 1 or more")
        if self.points is not None and self.depths is None:
            raise UserError("points of which maps?", "--points", "add --depths DIR")
        if self.scale is not None and self.scale_from is not None:
            raise UserError("two scales", "--scale-from", "leave out one of it and --scale")
        if str(self.depths) == "sensor":
            what, remedy = "sensor depth is a part of the capture", "leave it out: it is written"
            raise UserError(what, "--depths sensor", remedy)

        from deltas_nets.captures.ids import ids_in_words
        from deltas_nets.captures.saving import doubts_of_images, save_capture
        from deltas_nets.captures.scaled import in_metres, scaled

        capture = opened(self.capture, self.intrinsics)
        unit = self._unit(capture)
        told = [] if self.scale_from is None else [f"a unit of the capture is {unit:.4g} m"]
        holds_depth = self.to not in ("colmap", "colmap-bin")
        if self.depths is not None:
            from deltas_nets.fuse.seeds import seeds, with_maps
            from deltas_nets.fuse.sources import depth_source

            source = depth_source(capture, self.depths)
            source.check()
            if source.doubt is not None:
                warn(source.doubt)
            capture = with_maps(source.capture, self.depths)
            with progress("points", len(source.ids)) as report:
                found = seeds(source, self.points or POINTS, report=report)
            capture = replace(capture, points=found)
            told.append(f"{len(found.xyz)} points that two maps or more agree on")
        if unit is not None:
            # Maps may be in metres already; and what a sensor tells the unit by is.
            change = unit / capture.scaled_by
            by_sensor = self.depths is None and str(self.scale_from) == "sensor"
            capture = scaled(capture, change) if by_sensor else in_metres(capture, change)
        with progress("writing", len(capture.frames)) as report:
            left_out = save_capture(capture, self.out, self.to, placing=self.images, report=report)
        broken = doubts_of_images(capture, depth=holds_depth)
        for doubt in (*capture.doubts, *left_out, *broken):
            warn(doubt)
        if capture.lost:
            warn(f"frames that cannot be used are left out: {ids_in_words(capture.lost)}")
        frames = counted(len(capture.frames), "frame")
        read_as = f", read as {capture.layout}," if capture.layout else ""
        # Only now: the reader of what is printed may have had enough.
        print(*told, f"{frames}{read_as} written to {self.out} as {self.to}", sep="\n")

    def _unit(self, capture: "Capture") -> float | None:
        """Metres in a unit of the capture, if a flag says how to know."""
        if self.scale_from is None:
            return self.scale
        from deltas_nets.predict.depth_map import PredictConfig
        from deltas_nets.predict.first_look import scale_by_measurements, scale_by_sensor
        from deltas_nets.predict.predictor import load_predictor

        predictor, config = load_predictor("deltas-small"), PredictConfig()
        if str(self.scale_from) == "sensor":
            return scale_by_sensor(predictor, capture, config)
        return scale_by_measurements(predictor, capture, config, self.scale_from)
