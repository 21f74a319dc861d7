"""A file of view sets, by its path or by its name in the capture."""

from pathlib import Path

__all__ = ["sets_file"]


def sets_file(file: Path, capture: Path) -> Path:
    """The file: as it is named or, if it is not there, of that name in the capture.

    Args:
        file: as it is named.
        capture: folder, or the file in a folder, that the capture was opened from.
    """
    inside = (capture.parent if capture.is_file() else capture) / file
    return inside if inside.is_file() and not file.is_file() else file
