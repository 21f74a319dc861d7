"""The command `deltas page`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from deltas_nets.commands.command import Command
from deltas_nets.commands.flags import Flag, opened
from deltas_nets.outputs.alone import Written
from deltas_nets.terminal import progress


@dataclass(frozen=True)
class Page(Command):
    """Write a page that shows the depth maps of a capture: index.html beside them.

    `deltas depth` does it at its end; this does it for an existing folder, or again with the
    mesh and the cloud of `deltas fuse`. The page needs no network and no other file. Beside
    it: contact_sheet.jpg, and preview/ID.jpg, each map in colours above a scale.

    Example: deltas page my_capture my_capture-depth --fused my_capture-fused
    """

    capture: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="CAPTURE")] = field(
        kw_only=True
    )
    """Folder or file of the capture that the maps are of."""
    depths: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="DEPTHS")] = field(
        kw_only=True
    )
    """Folder that deltas depth filled."""
    depth_range: Annotated[tuple[float, float], tyro.conf.arg(metavar="NEAR FAR")] = (0.5, 10.0)
    """Of sensor depth that counts for errors, metres."""
    fused: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Folder of mesh.ply or cloud.ply, as deltas fuse wrote it; DEPTHS if not given."""
    intrinsics: Annotated[str | None, tyro.conf.arg(metavar="NUMBERS")] = None
    """As they were given to deltas depth, if they were."""
    debug: Flag = False
    """Show the traceback of an error."""

    @property
    def written(self) -> Written:
        """What no other run may write meanwhile."""
        return Written(self.depths, "page")

    def run(self) -> None:
        """Run the command."""
        from deltas_nets.page.maps import open_maps
        from deltas_nets.page.write import write_page

        maps = open_maps(opened(self.capture, self.intrinsics), self.depths, self.fused)
        with progress("page", len(maps.ids)) as report:
            page = write_page(maps, depth_range=self.depth_range, report=report)
        print(page.line)
