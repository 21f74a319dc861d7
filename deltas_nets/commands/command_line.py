"""From the words of a command line to a command that runs, and an error in one line."""

import contextlib
import errno
import io
import os
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from textwrap import shorten
from typing import Any, NoReturn, Union

import tyro

from deltas_nets import __version__
from deltas_nets.commands.command import Command
from deltas_nets.commands.grouped_help import grouped_help
from deltas_nets.commands.memory import lacking_memory
from deltas_nets.commands.values import check_values
from deltas_nets.commands.words import first_page, sentence
from deltas_nets.errors import UserError
from deltas_nets.outputs.alone import alone
from deltas_nets.terminal import (
    silent_without_reader,
    stopped_like_ctrl_c,
    without_warnings_of_pillow,
)

__all__ = ["parse", "run"]

Commands = Sequence[type[Command]]


def run(arguments: Sequence[str], commands: Commands) -> None:
    """Run the command that the arguments name; without arguments, show what there is."""
    with silent_without_reader():
        if list(arguments) == ["--version"]:
            print(f"deltas-depth {__version__}")
            return
        if not arguments or list(arguments) in (["--help"], ["-h"]):
            print(first_page(commands, __version__))
            return
        command = parse(list(arguments), commands)
        try:
            check_values(command)
            with stopped_like_ctrl_c(), without_warnings_of_pillow(), alone(command.written):
                command.run()
        except UserError as error:
            if command.debug:
                raise
            _fail(error)
        except KeyboardInterrupt:
            print(f"deltas: stopped; {command.going_on}", file=sys.stderr)
            sys.exit(130)
        except Exception as error:
            refused, what = _no_way_to(error), lacking_memory(error)
            if (refused is None and what is None) or command.debug:
                raise
            where = f"deltas {type(command).__name__.lower()}"
            _fail(refused or UserError(what or "", where, command.smaller))


def parse(arguments: Sequence[str], commands: Commands) -> Command:
    """The command that the arguments name; one line of error where they make no sense.

    Raises:
        TypeError: a command's fields are no flags, as it was not made a dataclass.
    """
    arguments = [_from_home(word) for word in arguments]
    for command in commands:
        if "__dataclass_fields__" not in vars(command):
            what = f"{command.__name__} in COMMANDS is no dataclass"
            raise TypeError(f"{what}: put @dataclass(frozen=True) above it")
    said = io.StringIO()
    names = {command.__name__.lower(): command for command in commands}
    groups = names[arguments[0]].groups if arguments[0] in names else {}
    try:
        kinds: Any = Union[tuple(command.parsed_as(arguments) for command in commands)]  # noqa: UP007
    except UserError as error:
        _fail(error)
    try:
        with contextlib.redirect_stderr(said), _shown_by(groups):
            asked: Command = tyro.cli(
                kinds,
                prog="deltas",
                description="Metric depth from posed images.",
                args=arguments,
            )
    except ValueError as error:
        _fail(UserError(str(error), "command line", _help_of(arguments, commands)))
    except SystemExit as stopped:
        if not stopped.code:
            sys.stdout.flush()  # the help, which a reader may have had enough of
            raise
        what = sentence(_in_words(said.getvalue()), names, arguments)
        what = shorten(what, 200, placeholder=" ...")
        _fail(UserError(what, "command line", _help_of(arguments, commands)))
    return asked


def _from_home(word: str) -> str:
    """A path that begins with ~, which a shell leaves as it is in quotes and after ``--out=``.

    A folder that is really called so stays.
    """
    parts = re.fullmatch(r"((?:[\w.-]+=)*)(~(?:[/\\].*)?)", word, re.DOTALL)
    if parts is None or os.path.lexists("~"):
        return word
    return parts[1] + os.path.expanduser(parts[2])


@contextlib.contextmanager
def _shown_by(groups: Mapping[str, Sequence[str]]) -> Iterator[None]:
    """Help that is printed meanwhile is shown by groups."""
    shown = io.StringIO()
    try:
        with contextlib.redirect_stdout(shown):
            yield
    finally:
        if shown.getvalue():
            print(grouped_help(shown.getvalue(), groups))


def _in_words(box: str) -> str:
    """What tyro draws a box for, as a line.

    The line leaves out the title, which the text below repeats, and the last part, which points to
    --help. Where standard output knows no box, rules of hyphens stand between the parts.
    """
    lines = [re.sub(r"\[/?bold\]|│", " ", line) for line in box.splitlines()]
    if box.lstrip().startswith("╭"):
        lines = [line for line in lines if not line.startswith(("╭", "╰"))]
    else:
        lines = lines[1:]
    parts = [" ".join(part.split()) for part in re.split("[─-]{3,}", " ".join(lines))]
    said = "; ".join(part for part in parts if part and not part.startswith("For full helptext"))
    # An option that may be left out: tyro tells what went wrong with each of its types.
    said = re.sub(
        r"no type matching \{None\}\|\{?(.+?)\}? could be instantiated from (\[.*?\])\."
        r" Got errors: [^;]*",
        r"\1 expected, got \2",
        said,
    )
    # What a config, or one inside it, refused comes with tyro's or Python's name for where it is.
    return re.sub(r"^Error parsing (__tyro\S+|[A-Z]\w+:) ", "", said)


def _no_way_to(error: Exception) -> UserError | None:
    """What to say of a path at which the system does not even look; None of other errors."""
    if not isinstance(error, OSError) or error.errno not in (errno.ENAMETOOLONG, errno.EACCES):
        return None
    what = f"the system refuses this path ({error.strerror})"
    named = isinstance(error.filename, str | Path)
    where = error.filename if named else "command line"
    return UserError(what, where, "check it, and the permissions of the folders on the way")


def _help_of(arguments: Sequence[str], commands: Commands) -> str:
    names = {command.__name__.lower() for command in commands}
    known = [word for word in arguments[:1] if word in names]
    return " ".join(["see deltas", *known, "--help"])


def _fail(error: UserError) -> NoReturn:
    print(f"deltas: {error}", file=sys.stderr)
    sys.exit(2)
