"""What all commands have in common."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

from deltas_nets.outputs.alone import Written

__all__ = ["Command"]


class Command:
    """A command: a dataclass whose fields are its flags, whose docstring is its help."""

    debug: bool
    """Whether an error shows its traceback."""
    checks: ClassVar[Mapping[str, Callable[[Any, str], object]]] = {}
    """Of values of its own flags, by name: see `deltas_nets.commands.values`."""

    groups: ClassVar[Mapping[str, Sequence[str]]] = {}
    """Options by title, as the help shows them; all in one where there are none."""

    smaller: ClassVar[str] = "ask for less, or use a machine with more"
    """What to do where memory does not suffice."""

    @property
    def going_on(self) -> str:
        """What to do after the command was stopped."""
        return "start it again"

    @property
    def written(self) -> Written | None:
        """What no other run may write meanwhile."""
        return None

    @classmethod
    def parsed_as(cls, arguments: Sequence[str]) -> Any:
        """The type that tyro parses; the defaults of flags may depend on other arguments."""
        return cls

    def run(self) -> None:
        """Run the command; what is heavy is imported here."""
        raise NotImplementedError
