"""What a table names rather than imports, because configs are read before torch is."""

from difflib import get_close_matches
from importlib import import_module
from typing import Any


def look_up(package: str, place: str) -> Any:
    """The function or class at "module:name" in a package.

    Raises:
        ValueError: the row is not of this form.
        ModuleNotFoundError: there is no such file; what a file misses itself is raised as it is.
        AttributeError: the file has no such name.

    Example:
        >>> look_up("deltas_nets", "errors:UserError").__name__
        'UserError'
    """
    module, colon, name = place.partition(":")
    if not (module and colon and name):
        raise ValueError(f'a row of a table names "module:name" in {package}, got {place!r}')
    whole = f"{package}.{module}"
    try:
        found = import_module(whole)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{whole}.".startswith(f"{error.name}."):
            raise
        what = f"there is no {package}.{module}, which a table's row {place!r} names"
        raise ModuleNotFoundError(f"{what}: write the file, or mend the row", name=whole) from None
    if not hasattr(found, name):
        near = get_close_matches(name, vars(found), n=1)
        cure = f"did you mean {near[0]}?" if near else "define it, or mend the row"
        raise AttributeError(f"{whole} has no {name}, which a table's row {place!r} names: {cure}")
    return getattr(found, name)
