"""The command `deltas view`."""

import contextlib
import io
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from deltas_nets.commands.command import Command
from deltas_nets.commands.flags import Flag, opened
from deltas_nets.errors import UserError


@dataclass(frozen=True)
class View(Command):
    """Show a capture in the browser: cameras, points and, of DEPTHS, what was found.

    It shows cameras with their images, the points of the depth maps above a confidence that
    can be moved, the mesh and the cloud of `deltas fuse`, and the points that the capture's own
    program triangulated. It needs the extra "view". Ctrl-C ends it.

    Example: deltas view my_capture my_capture-depth
    """

    capture: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="CAPTURE")] = field(
        kw_only=True
    )
    """Folder or file of a capture."""
    depths: Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="[DEPTHS]")] = field(
        default=None, kw_only=True
    )
    """Folder that deltas depth filled."""
    port: int = 8080
    """Where to serve it; the next one that is free if another program has it."""
    host: str = "127.0.0.1"
    """Who may look: this machine alone, or 0.0.0.0 for all that reach it."""
    fused: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Folder of mesh.ply or cloud.ply, as deltas fuse wrote it; DEPTHS if not given."""
    intrinsics: Annotated[str | None, tyro.conf.arg(metavar="NUMBERS")] = None
    """As they were given to deltas depth, if they were."""
    debug: Flag = False
    """Show the traceback of an error."""

    def run(self) -> None:
        """Run the command."""
        from deltas_nets.page.maps import open_maps
        from deltas_nets.view.viewer import check_address, check_viewer, open_viewer

        check_viewer()
        if not 0 < self.port < 65536:
            raise UserError("no port", f"--port {self.port}", "give 1 to 65535")
        check_address(self.host)
        capture = opened(self.capture, self.intrinsics)
        if self.fused is not None and self.depths is None:
            raise UserError("no depth maps", "--fused", "name DEPTHS, too")
        maps = None if self.depths is None else open_maps(capture, self.depths, self.fused)
        server = open_viewer(capture, maps, host=self.host, port=self.port)
        print(f"look at http://{self.host}:{server.get_port()}; Ctrl-C ends it", flush=True)
        with contextlib.suppress(KeyboardInterrupt):
            server.sleep_forever()
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()
