"""Memory that does not suffice, told in a line: it is an option that asks for so much."""

import re

__all__ = ["lacking_memory"]

SAID = ("can't allocate memory", "out of memory")
"""What torch says where its error is of no kind of its own."""


def lacking_memory(error: BaseException) -> str | None:
    """What to say where an error is one of memory; None where it is another.

    Torch is not imported for it: its errors are told by their names and words.

    Example:
        >>> lacking_memory(MemoryError("Unable to allocate 3.5 GiB for an array"))
        'there is not enough memory for 3.5 GiB at once'
        >>> lacking_memory(ValueError("something else"))
    """
    text = str(error)
    of_torch = type(error).__name__ == "OutOfMemoryError"
    if not (isinstance(error, MemoryError) or of_torch or any(said in text for said in SAID)):
        return None
    asked = re.search(r"allocate (?P<number>[\d.]*\d) (?P<unit>bytes|\w?i?B)", text)
    if asked is None:
        return "there is not enough memory"
    number, unit = float(asked["number"]), asked["unit"]
    if unit == "bytes":
        number, unit = number / 1e9, "GB"
    return f"there is not enough memory for {number:.3g} {unit} at once"
