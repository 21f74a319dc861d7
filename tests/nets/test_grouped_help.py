"""The help of commands with many options: by what they are about, none twice and none left out."""

import re

import pytest
from run_command import Run

from deltas_nets.cli import COMMANDS
from deltas_nets.commands import command_line
from deltas_nets.commands.command import Command
from deltas_nets.commands.grouped_help import grouped_help

GROUPED = [command for command in COMMANDS if command.groups]
PLAIN = [command for command in COMMANDS if not command.groups]

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


def test_without_groups_options_stand_in_their_own_order() -> None:
    shown = grouped_help(BOXES, {})
    assert shown.index("options:") < shown.index("  IN  ") < shown.index("  --out DIR")
    assert "default: None" not in shown and "required" not in shown


def test_without_groups_several_boxes_of_options_stay() -> None:
    text = BOXES + BOXES[BOXES.index("╭─ options") :].replace("options ─", "data options ─")
    assert grouped_help(text, {}) == text


@pytest.mark.parametrize("command", PLAIN, ids=lambda command: command.__name__)
def test_no_option_is_lost(
    command: type[Command], run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = command.__name__.lower()
    shown = run(name, "--help").out
    monkeypatch.setattr(command_line, "grouped_help", lambda text, groups: text)
    by_tyro = run(name, "--help").out
    option = re.compile(r"--[a-z][a-z.-]*")
    assert set(option.findall(shown)) == set(option.findall(by_tyro)) != set()
