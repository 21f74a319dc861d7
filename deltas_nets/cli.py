"""The `deltas` command. Each subcommand is a dataclass: its fields are the flags.

Nothing heavy is imported before a command runs, so that --help is instant.
"""

import sys

from deltas_nets.commands.ablate import Ablate
from deltas_nets.commands.calibrate import Calibrate
from deltas_nets.commands.check import Check
from deltas_nets.commands.command_line import run
from deltas_nets.commands.convert import Convert
from deltas_nets.commands.cost import Cost
from deltas_nets.commands.demo import Demo
from deltas_nets.commands.depth import Depth
from deltas_nets.commands.detectors import Detectors
from deltas_nets.commands.distill import Distill
from deltas_nets.commands.evaluate import Evaluate
from deltas_nets.commands.export import Export
from deltas_nets.commands.fuse import Fuse
from deltas_nets.commands.page import Page
from deltas_nets.commands.recipe import Recipe
from deltas_nets.commands.redraw import Redraw
from deltas_nets.commands.robustness import Robustness
from deltas_nets.commands.train import Train
from deltas_nets.commands.view import View

COMMANDS = (
    Demo,
    Depth,
    Fuse,
    Page,
    View,
    Check,
    Convert,
    Evaluate,
    Detectors,
    Ablate,
    Robustness,
    Train,
    Recipe,
    Distill,
    Redraw,
    Calibrate,
    Export,
    Cost,
)


def main() -> None:
    """Entry point of the `deltas` command."""
    run(sys.argv[1:], COMMANDS)


if __name__ == "__main__":
    main()
