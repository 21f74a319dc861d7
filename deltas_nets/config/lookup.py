"""What a table names rather than imports, because configs are read before torch is."""

from importlib import import_module
from typing import Any


def look_up(package: str, place: str) -> Any:
    """The function or class at "module:name" in a package.

    Example:
        >>> look_up("deltas_nets", "errors:UserError").__name__
        'UserError'
    """
    module, name = place.split(":")
    return getattr(import_module(f"{package}.{module}"), name)
