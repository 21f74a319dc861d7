"""Names of images in files, and the ids of frames that come from them."""

import os
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from deltas_nets.captures.images import RAW_SUFFIXES
from deltas_nets.errors import UserError

__all__ = [
    "DEPTH_SUFFIXES",
    "IMAGE_SUFFIXES",
    "check_ids",
    "frame_ids",
    "name_parts",
    "where_to_put",
    "without_common_folder",
]

IMAGE_SUFFIXES = (
    ".png", ".jpg", ".jpeg", ".jpe", ".webp", ".tif", ".tiff", ".bmp", ".ppm", ".pgm", ".heic",
    ".heif", ".jfif", ".avif", ".jp2", ".gif",
    *RAW_SUFFIXES,
)  # fmt: skip
"""Of colour images, in the order in which a missing one is tried."""
DEPTH_SUFFIXES = (".png", ".tif", ".tiff", ".exr", ".npy", ".npz", ".pfm", ".pgm")
"""Of depth, in the same order."""
NAME_LIMIT = 240
"""Bytes of each part of an id: files of results are called so, with a suffix."""


def name_parts(name: str) -> tuple[str, ...]:
    r"""The parts of a file's name below the drive, the root, and steps up.

    Example:
        >>> name_parts(r"C:\scans\images\a b.jpg"), name_parts("../images/1.png")
        (('scans', 'images', 'a b.jpg'), ('images', '1.png'))
    """
    name = name.replace("\\", "/")
    if name[1:2] == ":":
        name = name[2:]
    return tuple(part for part in name.split("/") if part not in ("", ".", ".."))


def where_to_put(name: str) -> str:
    """What to do about a file of that name which is not found, in words.

    Example:
        >>> where_to_put("images/1.png")
        'put it where the file says'
    """
    name = name.replace("\\", "/")
    if name.startswith("/") or name[1:2] == ":" or ".." in name.split("/"):
        return "copy or link it into the capture's folder: paths that lead out are not followed"
    return "put it where the file says"


def without_common_folder(names: Sequence[str]) -> list[str]:
    """Names below the folders that all have in common, without drives and steps up.

    Example:
        >>> without_common_folder(["./images/left/1.png", "./images/right/1.png"])
        ['left/1.png', 'right/1.png']
    """
    parts = [name_parts(name) for name in names]
    folders = [part[:-1] for part in parts]
    # What the first and the last of all have in common, those between have, too.
    first, last = min(folders, default=()), max(folders, default=())
    same = [a == b for a, b in zip(first, last, strict=False)]
    common = same.index(False) if False in same else len(same)
    return ["/".join(part[common:]) for part in parts]


def frame_ids(names: Sequence[str], path: Path) -> list[str]:
    """Ids of frames from the names of their images: without suffix, folders kept.

    Where two names differ in nothing but the suffix, both keep it.

    Args:
        names: of the images, relative to a folder of images; "/" or a backslash between folders.
        path: the file that names them, for errors.

    Raises:
        UserError: a name is empty, is absolute, steps up, holds control characters or is too long
            for the files that will be called so, or is there twice.

    Example:
        >>> frame_ids(["cam0/IMG_1.JPG", "b.png", "b.jpg"], Path("images.txt"))
        ['cam0/IMG_1', 'b.png', 'b.jpg']
    """
    whole = [name.replace("\\", "/") for name in names]
    for name in whole:
        _check_name(name, path)
    if len(set(whole)) < len(whole):
        twice = next(name for name, count in Counter(whole).items() if count > 1)
        what = f"two frames are of the image {_shown(twice)}"
        raise UserError(what, path, "keep one of them")
    ids = [_without_suffix(name) for name in whole]
    while len(set(ids)) < len(ids):
        often = Counter(ids)
        ids = [name if often[id] > 1 else id for id, name in zip(ids, whole, strict=True)]
    return ids


def check_ids(ids: Sequence[str], path: Path) -> None:
    """Refuse ids that a file states and that files of results cannot be called by.

    Raises:
        UserError: as `frame_ids`.
    """
    for id in ids:
        _check_name(id, path)
    if len(set(ids)) < len(ids):
        twice = next(id for id, count in Counter(ids).items() if count > 1)
        raise UserError(f"two frames have the id {_shown(twice)}", path, "give each its own")


def _check_name(name: str, path: Path) -> None:
    # A million names are checked so, and few need more than a look.
    framed = f"/{name}/"
    bad = "//" in framed or "/./" in framed or "/../" in framed or name[1:2] == ":"
    what = f"an image cannot be called {_shown(name)}"
    if bad or not name.isprintable():
        raise UserError(what, path, "name images by their path below the folder of images")
    if 4 * len(name) > NAME_LIMIT and _has_long_part(name):
        what += f", which has more than {NAME_LIMIT} bytes"
        raise UserError(what, path, "shorten it: files of results are called so, with a suffix")


def _has_long_part(name: str) -> bool:
    return any(len(os.fsencode(part)) > NAME_LIMIT for part in name.split("/"))


def _without_suffix(name: str) -> str:
    head, dot, suffix = name.rpartition(".")
    known = head and not head.endswith("/") and f".{suffix.lower()}" in IMAGE_SUFFIXES
    return head if dot and known else name


def _shown(name: str) -> str:
    return repr(name if len(name) <= 60 else name[:57] + "...")
