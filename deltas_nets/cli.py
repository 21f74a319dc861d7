"""The `deltas` command. Each subcommand is a dataclass: its fields are the flags.

Nothing heavy is imported before a command runs, so that --help is instant.
"""

import contextlib
import io
import re
import sys
from pathlib import Path
from textwrap import shorten
from typing import Annotated, NoReturn, get_args

import tyro

from deltas_nets import __version__
from deltas_nets.commands.calibrate import Calibrate
from deltas_nets.commands.cost import Cost
from deltas_nets.commands.demo import Demo
from deltas_nets.commands.depth import Depth
from deltas_nets.commands.distill import Distill
from deltas_nets.commands.evaluate import Evaluate
from deltas_nets.commands.export import Export
from deltas_nets.commands.recipe import Recipe
from deltas_nets.commands.train import Train, preset_of
from deltas_nets.config import TRAIN_CONFIGS
from deltas_nets.errors import UserError
from deltas_nets.terminal import stopped_like_ctrl_c


def main() -> None:
    """Entry point of the `deltas` command."""
    if sys.argv[1:] == ["--version"]:
        print(f"deltas-depth {__version__}")
        return
    command = _parse(sys.argv[1:] or ["--help"])
    try:
        with stopped_like_ctrl_c():
            command.run()
    except UserError as error:
        if command.debug:
            raise
        _fail(error)
    except KeyboardInterrupt:
        print(f"deltas: stopped; {_how_to_go_on(command)}", file=sys.stderr)
        sys.exit(130)


Command = Demo | Depth | Evaluate | Train | Recipe | Distill | Calibrate | Export | Cost


def _parse(arguments: list[str]) -> Command:
    """The command that the arguments name; one line of error where they make no sense."""
    said = io.StringIO()
    preset = preset_of(arguments)
    default = Train(out=Path("runs") / preset, preset=preset, config=TRAIN_CONFIGS[preset])
    train = Annotated[Train, tyro.conf.subcommand(name="train", default=default)]
    try:
        with contextlib.redirect_stderr(said):
            command: Command = tyro.cli(
                Demo | Depth | Evaluate | train | Recipe | Distill | Calibrate | Export | Cost,
                prog="deltas",
                description="Metric depth from posed images.",
                args=arguments,
            )
    except ValueError as error:
        _fail(UserError(str(error), "command line", _help_of(arguments)))
    except SystemExit as stopped:
        if not stopped.code:
            raise
        what = shorten(_in_words(said.getvalue()), 200, placeholder=" ...")
        _fail(UserError(what, "command line", _help_of(arguments)))
    return command


def _in_words(box: str) -> str:
    """What tyro draws a box for, as a line.

    Without the title, which the text below repeats, and the last part, which points to --help.
    """
    inside = [line for line in box.splitlines() if not line.startswith(("╭", "╰"))]
    plain = re.sub(r"\[/?bold\]|│", " ", " ".join(inside))
    parts = [" ".join(part.split()) for part in re.split("─{3,}", plain)]
    said = "; ".join(part for part in parts if part and not part.startswith("For full helptext"))
    # What a config, or one inside it, refused comes with tyro's or Python's name for where it is.
    return re.sub(r"^Error parsing (__tyro\S+|[A-Z]\w+:) ", "", said)


def _how_to_go_on(command: Command) -> str:
    match command:
        case Depth() | Recipe():
            return "the same command goes on"
        case Train():
            return "the same command with --resume goes on"
        case _:
            return "start it again"


def _help_of(arguments: list[str]) -> str:
    names = {command.__name__.lower() for command in get_args(Command)}
    known = [word for word in arguments[:1] if word in names]
    return " ".join(["see deltas", *known, "--help"])


def _fail(error: UserError) -> NoReturn:
    print(f"deltas: {error}", file=sys.stderr)
    sys.exit(2)


if __name__ == "__main__":
    main()
