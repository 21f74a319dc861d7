"""The command `deltas check`."""

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from deltas_nets.commands.command import Command
from deltas_nets.commands.flags import Flag, opened
from deltas_nets.errors import UserError
from deltas_nets.extras import usable_device
from deltas_nets.terminal import progress, warn

MOST_THREADS = 4

if TYPE_CHECKING:
    from deltas_nets.captures.capture import Capture
    from deltas_nets.check.finding import Finding


@dataclass(frozen=True)
class Check(Command):
    """Tell what is wrong with a capture, how that is known, and what mends it.

    Looks at files, cameras, images and sensor depth, and matches frames spread over the capture:
    poses that are inverted, have other axes or belong to other frames, intrinsics of other images,
    frames that disagree with all others, and more. Nothing is written unless asked for. The exit
    status is 0 where nothing is found, 1 where something is, which may be that a capture cannot be
    read, and 2 where the path leads nowhere.

    Example: deltas check my_capture --mend mended_capture
    """

    capture: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="CAPTURE")] = field(
        kw_only=True
    )
    """A folder or file that deltas depth would take."""
    intrinsics: Annotated[str | None, tyro.conf.arg(metavar='"FX FY CX CY ..."')] = None
    """Of all images, whatever the capture says; as deltas depth takes them."""
    mend: Annotated[Path | None, tyro.conf.arg(metavar="OUT")] = None
    """Write the capture with everything mended that can be, to a new folder in our own format whose
    images are links."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Also write everything to this file."""
    device: str = "auto"
    """Where to compute: auto, cpu, cuda, cuda:1, mps."""
    debug: Flag = False
    """Show the traceback of an error."""

    def run(self) -> None:
        """Run the command."""
        from deltas_nets.captures.new_folder import check_new

        if self.mend is not None:
            check_new(self.mend)

        import torch

        from deltas_nets.captures.saving import save_capture
        from deltas_nets.check.matched import GROUPS
        from deltas_nets.check.refused import refused
        from deltas_nets.check.verdict import Checked, check_capture
        from deltas_nets.check.words import mended_in_words, report_lines
        from deltas_nets.outputs.atomic_files import check_file, write_json
        from deltas_nets.weights_file import load_model

        if self.json is not None:
            check_file(self.json)
        device = usable_device(self.device)
        # Frames are small: threads that share one wait for each other, those with their own do not.
        threads = min(MOST_THREADS, torch.get_num_threads())
        torch.set_num_threads(1)
        found: list[Finding] = []
        capture: Capture | None = None
        try:
            capture = opened(self.capture, self.intrinsics)
        except UserError as error:
            finding, capture = refused(self.capture, error)
            found = [finding]
        if capture is None:
            checked = Checked.of_refused(found)
        else:
            for doubt in capture.doubts:
                warn(doubt)
            network = load_model("deltas-small", device=device)
            with progress("matching", GROUPS) as report:
                checked = check_capture(
                    capture, network, known=found, threads=threads, report=report
                )
        try:  # before the reader of what is printed may have had enough
            if self.json is not None:
                write_json(self.json, checked.in_json())
            if self.mend is not None and capture is not None and checked.mendable:
                save_capture(checked.mended(capture), self.mend, placing="link")
        finally:
            for line in report_lines(checked, self.capture, self.intrinsics):
                print(line)
        if self.mend is not None:
            print(mended_in_words(checked, self.mend))
        if checked.findings:
            sys.stdout.flush()
            sys.exit(1)
