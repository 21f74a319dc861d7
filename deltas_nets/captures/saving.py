"""From a capture to a folder in another format, whole or not at all."""

import contextlib
import os
import secrets
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path

from deltas_geom.checks import check_kind
from deltas_nets.captures.capture import Capture
from deltas_nets.captures.ids import ids_in_words
from deltas_nets.captures.new_folder import check_new
from deltas_nets.captures.writers import colmap, own, scannet, transforms
from deltas_nets.captures.writers.files import Placing, Putting
from deltas_nets.errors import UserError
from deltas_nets.terminal import counted

__all__ = ["WRITERS", "Writer", "doubts_of_images", "save_capture"]

Writer = Callable[[Capture, Path, Putting], list[str]]

WRITERS: Mapping[str, Writer] = {
    "own": own.write,
    "scannet": scannet.write,
    "colmap": colmap.write_text,
    "colmap-bin": colmap.write_binary,
    "transforms": transforms.write,
}
"""By the name of the format; see `deltas_nets.captures.writers` for what they do."""


def doubts_of_images(capture: Capture, *, depth: bool = True) -> list[str]:
    """Warnings of images that are copied as they are though nobody can use them.

    Args:
        capture: whose images were copied.
        depth: whether those of its sensor were, too.
    """
    images: dict[str, UserError] = {}
    depths: dict[str, UserError] = {}
    for id, frame in capture.frames.items():
        checks = [(images, frame.check_image)]
        if depth and frame.depth_path is not None:
            checks.append((depths, frame.check_depth))
        for broken, check in checks:
            try:
                check()
            except UserError as error:
                broken[id] = error
    doubts = []
    for broken, noun in ((images, "image"), (depths, "depth image")):
        if broken:
            first = next(iter(broken.values()))
            count = counted(len(broken), noun)
            doubts.append(f"{count} cannot be used ({ids_in_words(broken)}): {first}")
    return doubts


def _refused(error: OSError, out: Path) -> UserError:
    """What to tell where the system refuses to read a file or to write the folder.

    Where one could not become the other both are named, and it is the new one that is to blame.
    """
    why, source = error.strerror or error, error.filename
    if source is not None and error.filename2 is None and Path(source).is_file():
        return UserError(f"the file cannot be read ({why})", Path(source), "make it readable")
    what = f"the capture cannot be written ({why})"
    return UserError(what, out, "name a place that can be written and has space")


def save_capture(
    capture: Capture,
    out: str | Path,
    to: str = "own",
    *,
    placing: Placing = "copy",
    report: Callable[[str], None] = lambda _: None,
) -> list[str]:
    """Write a capture in another format.

    It is written beside the folder under a temporary name, which the folder takes when it is whole.

    Args:
        capture: whose frames are written; those that are lost are not.
        out: a folder that does not exist, or is empty.
        to: one of `WRITERS`.
        placing: whether images and depth are copied, or are links to where they are.
        report: called with the id of every frame that is written.

    Returns:
        What the format had no place for, in words.

    Raises:
        UserError: the format cannot hold the capture, a file is missing, or the folder cannot be
            written; nothing is left behind.
    """
    check_kind("capture", capture, Capture, "open_capture(PATH)")
    out = Path(out)
    if to not in WRITERS:
        raise UserError(f"there is no format {to!r}", "--to", f"use {', '.join(WRITERS)}")
    check_new(out)
    if not capture.frames:
        raise UserError("no frame can be used", capture.path, "see why with deltas depth")
    beside = Path(os.path.abspath(out))
    made = [folder for folder in beside.parents if not folder.exists()]
    temporary = beside.with_name(f".{beside.name[:40]}.{secrets.token_hex(4)}.deltas-tmp")
    try:
        temporary.mkdir(parents=True)
        said = WRITERS[to](capture, temporary, Putting(placing, report))
        if out.exists():
            out.rmdir()  # an empty one: not every system renames to what is there
        os.replace(temporary, beside)
    except BaseException as error:
        shutil.rmtree(temporary, ignore_errors=True)
        for folder in made:
            with contextlib.suppress(OSError):
                folder.rmdir()
        if isinstance(error, OSError):
            check_new(out)  # another run may have been first
            raise _refused(error, out) from error
        raise
    return said
