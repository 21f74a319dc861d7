"""What tyro says of a wrong command line, as a sentence of ours; and the first page of help."""

import re
from collections.abc import Callable, Mapping, Sequence
from difflib import get_close_matches
from inspect import getdoc
from itertools import takewhile
from typing import Any

from deltas_nets.commands.command import Command

__all__ = ["first_page", "sentence"]

METAVAR = r"((?:[A-Z|\[\]{}]{2,}(?: (?=[A-Z|]{2}))?)+)"
"""Words such as HEIGHT WIDTH, before a sentence, whose second letter is small."""
KINDS = {"INT": "a whole number", "FLOAT": "a number", "PATH": "a path", "STR": "a word"}


def first_page(commands: Sequence[type[Command]], version: str) -> str:
    """What `deltas` and `deltas --help` show: a line for each command."""
    rows = [(command.__name__.lower(), _first_line(command)) for command in commands]
    wide = max(len(name) for name, _ in rows)
    lines = [
        f"deltas {version}: depth from posed images",
        "",
        "usage: deltas COMMAND [OPTIONS]",
        "",
    ]
    lines += [f"  {name:{wide}}  {line}" for name, line in rows]
    lines += [
        "",
        "deltas COMMAND --help                        its options",
        "deltas --version                             the version",
        "deltas --tyro-print-completion bash|zsh      completion for the shell, to be sourced",
        "",
        "Start with: deltas demo, then deltas depth CAPTURE",
    ]
    return "\n".join(lines)


def _first_line(command: type[Command]) -> str:
    return (getdoc(command) or "").partition("\n\n")[0].replace("\n", " ")


def sentence(
    said: str, commands: Mapping[str, type[Command]], arguments: Sequence[str] = ()
) -> str:
    """What tyro said in a line, in our words where they are better.

    Args:
        said: one line.
        commands: by name.
        arguments: that it is about.
    """
    if said.startswith("Unrecognized") and (unquoted := _unquoted(arguments)):
        return unquoted
    for pattern, words in _SAYINGS:
        match = re.search(pattern, said)
        if match:
            return words(match, commands)
    return said


def _unquoted(arguments: Sequence[str]) -> str:
    """What to say of numbers that the shell took apart; nothing if there are none."""
    option = "--intrinsics"
    after = arguments[list(arguments).index(option) + 1 :] if option in arguments else ()
    numbers = list(takewhile(lambda word: re.fullmatch(r"-?[\d.]+(e-?\d+)?,?", word), after))
    if len(numbers) < 2:
        return ""
    return f'{option} takes its numbers in quotes: {option} "{" ".join(numbers)}"'


def _expected(match: re.Match[str], _: Any) -> str:
    option, got = match["option"], " ".join(re.findall(r"'([^']*)'", match["got"]))
    # Tyro knows the types, and the help how the numbers are called.
    named = re.search(rf"helptext: {re.escape(option)} {METAVAR}", match.string)
    wanted = named[1] if named else match["kinds"]
    wanted = KINDS.get(wanted, wanted)
    return f"{option} takes {wanted}, got {got or 'nothing'}"


def _no_number(match: re.Match[str], _: Any) -> str:
    kind = "a whole number" if match["kind"] == "int" else "a number"
    return f"{match['option']} takes {kind}, got {match['got']}"


def _no_row(match: re.Match[str], _: Any) -> str:
    got = " ".join(re.findall(r"'([^']*)'", match["got"]))
    kinds = match["kinds"].replace("INT", "N").replace("FLOAT", "X")
    return f"{match['option']} takes {kinds}, got {got or 'nothing'}"


def _too_few(match: re.Match[str], _: Any) -> str:
    return f"{match['option']} takes {match['count']}, got fewer"


def _no_choice(match: re.Match[str], _: Any) -> str:
    *known, last = re.findall(r"'([^']*)'", match["known"])
    return f"{match['option']} takes {', '.join(known)} or {last}, got {match['got']}"


def _unknown(match: re.Match[str], commands: Mapping[str, type[Command]]) -> str:
    first = re.split(r", | \(applied to", match["options"])[0]
    if "Available subcommands" in match.string or "(applied to deltas)" in match["options"]:
        near = get_close_matches(first, commands, n=1, cutoff=0.4)
        known = f"did you mean {near[0]}?" if near else f"there are {', '.join(commands)}"
        return f"no command {first}: {known}"
    what = f"no option {first}" if first.startswith("-") else f"{first} is one word too many"
    suggested = match.string.partition("Perhaps you meant: ")[2]
    others = [command for name, command in _suggested(suggested) if name == first]
    if others:
        return f"{what} here: deltas {others[0]} has it"
    meant = _meant(first, suggested)
    return what + (f": did you mean {meant}?" if meant else "")


def _suggested(words: str) -> list[tuple[str, str]]:
    """The options that tyro suggests, and their commands."""
    return re.findall(r"(--[\w.-]+) (?:(?! --help).)*? in deltas (\w+) --help", words)


def _meant(option: str, suggested: str) -> str | None:
    """Of the options that tyro suggests, of several commands, the nearest of the first one."""
    known = _suggested(suggested)
    names = [name for name, command in known if command == known[0][1]]
    return next(iter([*get_close_matches(option, names, n=1), *names]), None)


def _missing(match: re.Match[str], _: Any) -> str:
    names = re.findall(r"(?:^|\(required\) )(--[\w.-]+|[A-Z]+)\b", match["names"])
    return f"{match['command']} needs {' and '.join(names or [match['names']])}"


_SAYINGS: tuple[tuple[str, Callable[[re.Match[str], Any], str]], ...] = (
    (
        r"Error parsing (?P<option>--[\w.-]+): (?:no type matching )?(?P<kinds>[A-Z][A-Z |]*?)"
        r" expected, got (?P<got>\[.*?\])",
        _expected,
    ),
    (
        r"Missing value for argument '(?P<option>--[\w.-]+)'\. Expected (?P<count>\d+ values)",
        _too_few,
    ),
    (
        r"Error parsing (?P<option>--[\w.-]+): invalid literal for (?P<kind>int)\(\) with base 10: "
        r"'(?P<got>.*?)'",
        _no_number,
    ),
    (
        r"Error parsing (?P<option>--[\w.-]+): could not convert string to (?P<kind>float): "
        r"'(?P<got>.*?)'",
        _no_number,
    ),
    (
        r"Error parsing (?P<option>--[\w.-]+): Could not find valid parse for arguments: "
        r"(?P<got>\[.*?\]); Argument helptext: (?P=option) "
        r"\[(?P<kinds>[A-Z ]+\[[A-Z ]+\.\.\.\])\]",
        _no_row,
    ),
    (
        r"invalid choice '(?P<got>.*?)' for argument '(?P<option>.*?)'\. Expected one of "
        r"\((?P<known>.*?)\)",
        _no_choice,
    ),
    (r"Unrecognized (?:or misplaced )?options: (?P<options>[^;]*)", _unknown),
    (r"Missing from (?P<command>[\w ]+): (?P<names>.*)", _missing),
)
