"""What lies beside the maps of a folder and shows them: the page, its pictures, what was fused.

Where a run starts again, these go with the maps that they are of: a page would show what is not
there any more, and a mesh of other maps would pass for one of these. Each says itself who wrote it;
what no command of ours wrote stays.
"""

import contextlib
import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

__all__ = [
    "FUSE_STATE",
    "FUSE_SUMMARY",
    "PAGE",
    "PREVIEWS",
    "SHEET",
    "fused_files",
    "mark_of_page",
    "preview_file",
    "range_of_page",
    "read_fuse_summary",
    "remove_beside",
]

PAGE, SHEET, PREVIEWS = "index.html", "contact_sheet.jpg", "preview"
FUSE_SUMMARY, FUSE_STATE = "fuse.json", "fuse.state.safetensors"
FUSE_WRITER = "deltas fuse"
_HEAD = 1000
"""Bytes of a page in which its mark is."""
_MARK = re.compile(
    r'<meta name="generator" content="deltas">\n<meta name="depth-range" content="(\S+) (\S+)">'
)


def mark_of_page(depth_range: tuple[float, float]) -> str:
    """Lines of HTML by which a page is known as ours, and what depth its errors are of.

    Args:
        depth_range: (near, far) of the true depth that counts, metres.
    """
    near, far = depth_range
    content = f'<meta name="depth-range" content="{near!r} {far!r}">'
    return f'<meta name="generator" content="deltas">\n{content}'


def range_of_page(folder: Path) -> tuple[float, float] | None:
    """The range of depth that the page of a folder was written for; None if there is none of ours.

    Args:
        folder: of depth maps.
    """
    try:
        with (folder / PAGE).open("rb") as file:
            head = file.read(_HEAD).decode("utf-8", "replace")
        found = _MARK.search(head)
        return None if found is None else (float(found[1]), float(found[2]))
    except (OSError, ValueError):
        return None


def preview_file(folder: Path, id: str) -> Path:
    """Where the map of a frame lies in colours."""
    return folder / PREVIEWS / f"{id}.jpg"


def read_fuse_summary(folder: Path) -> dict[str, Any] | None:
    """What `deltas fuse` says of a folder that it writes to; None where it does not."""
    try:
        content = json.loads((folder / FUSE_SUMMARY).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    ours = isinstance(content, dict) and content.get("writer") == FUSE_WRITER
    whole = ours and isinstance(content.get("settings"), dict) and "status" in content
    return content if whole else None


def remove_beside(folder: Path, ids: Iterable[str], settings: Mapping[str, Any] | None) -> None:
    """Remove what shows maps that are removed.

    Args:
        folder: of the maps.
        ids: of their frames.
        settings: that they were made with; None where nothing says it.

    Raises:
        OSError: the system refuses.
    """
    if range_of_page(folder) is not None:
        (folder / SHEET).unlink(missing_ok=True)
        (folder / PAGE).unlink()
    if settings is not None:
        for id in ids:
            preview_file(folder, id).unlink(missing_ok=True)
        with contextlib.suppress(OSError):  # somebody else's files are there, too
            (folder / PREVIEWS).rmdir()
        _remove_fused(folder, settings)


def fused_files(summary: Mapping[str, Any]) -> frozenset[str]:
    """Names of the files that a summary of `deltas fuse` says are its own."""
    names = summary.get("files")
    return frozenset(
        name
        for name in (names if isinstance(names, list) else ())
        if isinstance(name, str) and Path(name).name == name
    )


def _remove_fused(folder: Path, settings: Mapping[str, Any]) -> None:
    """Remove what was fused of maps of these settings, its summary last."""
    fused = read_fuse_summary(folder)
    if fused is not None and fused["settings"].get("depth") == settings:
        for name in (*fused_files(fused), FUSE_STATE):
            (folder / name).unlink(missing_ok=True)
        (folder / FUSE_SUMMARY).unlink()
