"""What people see in a folder."""

from collections.abc import Iterator
from pathlib import Path

__all__ = ["listed"]


def listed(folder: Path, *suffixes: str) -> Iterator[Path]:
    """Files and folders in a folder, in no order, but for hidden ones.

    macOS writes ``._IMG_1.jpg`` beside each file on disks and in archives of other systems: named
    like a photo or a camera, and neither.

    Args:
        folder: to list.
        suffixes: how names end, in lower case; any if none is given.
    """
    for path in folder.iterdir():
        name = path.name
        if not name.startswith(".") and (not suffixes or name.lower().endswith(suffixes)):
            yield path
