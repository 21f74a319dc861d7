"""Files of a folder that are named by numbers."""

from collections.abc import Sequence
from pathlib import Path

__all__ = ["numbered_files"]


def numbered_files(folder: Path, suffixes: Sequence[str], prefix: str = "") -> dict[int, Path]:
    """Files by number, in order; none where there is no folder.

    Args:
        folder: to list.
        suffixes: in lower case, such as ``.color.png``, best first. Of several files of a number
            and a suffix (``7.jpg``, ``007.jpg``), the first by name is taken.
        prefix: before the number.
    """
    if not folder.is_dir():
        return {}
    found: dict[int, tuple[int, Path]] = {}
    for path in folder.iterdir():
        name = path.name.lower()
        suffix = next((suffix for suffix in suffixes if name.endswith(suffix)), None)
        if suffix is None or not name.startswith(prefix) or not path.is_file():
            continue
        digits = name[len(prefix) : len(name) - len(suffix)]
        # Nanoseconds since 1970 have 19 digits.
        if digits.isascii() and digits.isdigit() and int(digits) < 2**63:
            number, candidate = int(digits), (suffixes.index(suffix), path)
            found[number] = min(found.get(number, candidate), candidate)
    return {number: found[number][1] for number in sorted(found)}
