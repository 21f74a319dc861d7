"""What is wrong with a text that is nearly JSON, in words of those who write it by hand."""

import re
from json import JSONDecodeError

__all__ = ["slip_in_json"]

_BY_SIGHT = (
    (r"", r"(?://|/\*|#)", "a comment, which JSON does not know", "delete the comment"),
    (r"", r"\s*\Z", "the file ends too early", "copy it again: the end is lost, or a bracket"),
    (r",\s*", r"[\]}]", "a comma before a closing bracket", "delete the comma"),
    (r"", r",\s*[\]}]", "a comma before a closing bracket", "delete the comma"),
    (r"[,\[{]\s*", r",", "a comma with nothing before it", "delete the comma"),
    (r"", r"['\u2018-\u201f]", "quotes of another kind", 'write straight double quotes: "'),
    (r"", r"(?:True|False|None)\b", "a word of Python", "write true, false, or null"),
    (r"", r"[-+]?(?i:nan|inf)", "something that is no number", "write null, or leave the name out"),
    (r":\s*-?\d+,\s*", r"\d", "a decimal comma", "write 0.5, not 0,5"),
    (r"", r"[-+]?\.\d|\+\d", "a number that JSON does not know", "write 0.5, not .5 or +0.5"),
    (r"\d", r"\.", "a number that ends with its point", "write 1.0 or 1, not 1."),
    (r"\b0", r"\d", "a number that begins with 0", "write 1, not 01; an id with 0 goes in quotes"),
    (r"", r"\\", "a single backslash", r"write / or \\ in paths"),
    (r"[{,]\s*", r"\w+\s*:", "a name without quotes", "write names in double quotes"),
)
"""What stands before the place, what stands there, what that is, and what to do."""
_BY_MESSAGE = (
    ("Extra data", "something behind the end", "keep one list or one object in the file"),
    ("Unterminated string", "a text whose closing quote is missing", "close the quote"),
    (
        "Invalid control",
        "a line break or a tab inside quotes",
        r"write \n or \t, or close the quote",
    ),
    ("Expecting ',' delimiter", "a comma or a closing bracket is missing", "put one there"),
    ("Expecting ':' delimiter", "a colon is missing", "put one there"),
)


def slip_in_json(error: JSONDecodeError) -> tuple[str, str | None]:
    """Where a text is no JSON and the likely cause, and what to do; None where nobody knows.

    Example:
        >>> import json
        >>> try:
        ...     json.loads('{"depth": None}')
        ... except json.JSONDecodeError as error:
        ...     slip_in_json(error)
        ('line 1, column 11: a word of Python', 'write true, false, or null')
    """
    text, at = error.doc, error.pos
    place = f"line {error.lineno}, column {error.colno}"
    for before, here, cause, cure in _BY_SIGHT:
        # A search through all that stands before would take as long as the file is large.
        near = text[max(at - 40, 0) : at]
        if re.search(rf"(?:{before})\Z", near) and re.compile(here).match(text, at):
            return f"{place}: {cause}", cure
    for message, cause, cure in _BY_MESSAGE:
        if error.msg.startswith(message):
            return f"{place}: {cause}", cure
    return f"{place}: {error.msg}", None
