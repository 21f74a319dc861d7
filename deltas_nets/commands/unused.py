"""Flags of which nothing would come: what they ask for is not what a command does."""

from collections.abc import Mapping
from dataclasses import MISSING, fields

from deltas_nets.commands.command import Command
from deltas_nets.errors import UserError

__all__ = ["refuse_unused"]


def refuse_unused(command: Command, wanted: Mapping[str, str | None]) -> None:
    """Refuse flags that are given and do nothing.

    Args:
        command: with its flags.
        wanted: by the name of a field what its flag goes with, where that is missing; None where
            the flag is of use.

    Raises:
        UserError: such a flag has another value than the usual one.
    """
    for field in fields(command):  # type: ignore[arg-type]
        missing = wanted.get(field.name)
        usual = field.default if field.default is not MISSING else None
        if missing is not None and getattr(command, field.name) != usual:
            flag = f"--{field.name.replace('_', '-')}"
            raise UserError("the flag is of no use here", flag, f"it goes with {missing}")
