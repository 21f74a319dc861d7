"""The help of commands with many options: by what they are about, none twice and none left out."""

import re

import pytest
from run_command import Run

from deltas_nets.cli import COMMANDS
from deltas_nets.commands.command import Command
from deltas_nets.commands.grouped_help import grouped_help

GROUPED = [command for command in COMMANDS if command.groups]

BOXES = """usage: deltas it [-h] IN

Do it.

╭─ positional arguments ─────────────────────╮
│ IN              What it is. (required)     │
╰────────────────────────────────────────────╯
╭─ options ──────────────────────────────────╮
│ -h, --help      show this help message     │
│ --out DIR       Where to, or IN-out        │
│                 if not given. (default:    │
│                 None)                      │
│ --a-long-one A|B                           │
│                 Of two. (default: A)       │
│ --page, --no-page                          │
│                 A page. (default: True)    │
╰────────────────────────────────────────────╯
"""
RULES = "\n".join(
    re.sub(r"^│|│$", " ", line).replace("╭─ ", " ").rstrip("─╮")
    for line in BOXES.splitlines()
    if not line.startswith("╰")
)
SHOWN = """usage: deltas it [-h] IN

Do it.

what comes out:
  --out DIR             Where to, or IN-out if not given.
  --a-long-one A|B      Of two. (default: A)

what goes in:
  IN                    What it is.

more:
  -h, --help            show this help message
  --page, --no-page     A page."""


@pytest.mark.parametrize("text", [BOXES, RULES], ids=["boxes", "rules"])
def test_options_are_shown_in_the_order_of_their_groups(text: str) -> None:
    groups = {"what comes out": ("--out", "--a-long-one"), "what goes in": ("IN",)}
    assert grouped_help(text, groups) == SHOWN


def test_help_in_which_no_option_is_seen_stays_as_it_is() -> None:
    assert grouped_help("something else", {"a": ("--out",)}) == "something else"


@pytest.mark.parametrize("command", GROUPED, ids=lambda command: command.__name__)
def test_the_groups_hold_every_option_once(command: type[Command], run: Run) -> None:
    shown = run(command.__name__.lower(), "--help").out
    names = [name for group in command.groups.values() for name in group]
    listed = re.findall(r"^  (--[a-z-]+|[A-Z]+)\b", shown, flags=re.MULTILINE)
    assert listed == [*names, "--debug"]
    assert "default: None" not in shown and max(map(len, shown.splitlines())) <= 100
