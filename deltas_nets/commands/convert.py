"""The command `deltas convert`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from deltas_nets.commands.command import Command
from deltas_nets.commands.flags import Flag


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
    """Length of the capture's unit, if you know it: what is written is in metres then."""
    intrinsics: Annotated[str | None, tyro.conf.arg(metavar="NUMBERS")] = None
    """Of all images, in quotes: fx fy cx cy and, of a lens, k1 k2 p1 p2 k3; or freiburg1."""
    debug: Flag = False
    """Show the traceback of an error."""

    def run(self) -> None:
        """Run the command."""
        from deltas_nets.captures.camera_words import Intrinsics
        from deltas_nets.captures.ids import ids_in_words
        from deltas_nets.captures.in_metres import in_metres
        from deltas_nets.captures.opening import open_capture
        from deltas_nets.captures.saving import save_capture
        from deltas_nets.terminal import warn

        stated = None if self.intrinsics is None else Intrinsics.parse(self.intrinsics)
        capture = open_capture(self.capture, intrinsics=stated)
        if self.scale is not None:
            capture = in_metres(capture, self.scale)
        left_out = save_capture(capture, self.out, self.to, placing=self.images)
        for doubt in (*capture.doubts, *left_out):
            warn(doubt)
        if capture.lost:
            warn(f"frames that cannot be used are left out: {ids_in_words(capture.lost)}")
        print(f"{len(capture.frames)} frames of {capture.layout or 'the capture'} in {self.out}")
