"""From a folder to a capture, whatever its layout."""

import gc
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from difflib import get_close_matches
from itertools import islice
from pathlib import Path
from shlex import quote
from typing import Protocol, runtime_checkable

from deltas_nets.captures.camera_words import Intrinsics
from deltas_nets.captures.capture import Capture
from deltas_nets.captures.frames import Frames
from deltas_nets.captures.ids import ids_in_words
from deltas_nets.captures.images import image_size_of
from deltas_nets.captures.inside import captures_inside, several_captures
from deltas_nets.captures.readers import (
    arkitscenes,
    colmap,
    demon,
    kapture,
    llff,
    mvsnet,
    openmvg,
    opensfm,
    own,
    polycam,
    record3d,
    robustmvd,
    scanner_app,
    scannet,
    sens,
    sevenscenes,
    strecha,
    transforms,
    tum,
)
from deltas_nets.captures.readers.colmap_folder import PLACES
from deltas_nets.captures.readers.listed import listed
from deltas_nets.captures.readers.names import IMAGE_SUFFIXES
from deltas_nets.captures.readers.refused import refusal
from deltas_nets.errors import UserError

__all__ = ["READERS", "Reader", "ReaderOfPoses", "looks_like_capture", "open_capture"]


class Reader(Protocol):
    """What a file in readers/ defines."""

    def recognises(self, path: Path) -> bool:
        """Whether a folder or file looks like this format; it may be broken, as `read` explains."""

    def read(self, path: Path) -> Capture:
        """Read poses and intrinsics; no pixels are decoded.

        Frames that cannot be used are in ``lost``: training counts them, `open_capture` accepts
        those without a pose or an image and raises the others.

        Raises:
            UserError: something that all frames need is missing or malformed; the text names it.
            OSError: the system refuses to read a file.
        """


@runtime_checkable
class ReaderOfPoses(Protocol):
    """What a reader defines besides that asks no file for a camera which the user states."""

    def read_with(self, path: Path, intrinsics: Intrinsics | None) -> Capture:
        """Read poses and images of a camera that the user states, as `Reader.read` does."""


READERS: tuple[Reader, ...] = (
    own,
    colmap,
    transforms,
    scannet,
    tum,
    record3d,
    polycam,
    scanner_app,
    sevenscenes,
    robustmvd,
    opensfm,
    openmvg,
    kapture,
    mvsnet,
    sens,
    demon,
    strecha,
    arkitscenes,
    llff,
)
"""The first that recognises a folder reads it."""

_LOOKING_INSIDE: tuple[Reader, ...] = (colmap, scannet, opensfm, openmvg, strecha)
"""Those that recognise folders by what is in folders of theirs, which may be several captures."""


_NAMES_LIMIT = 1000
"""Names that a misspelt one is compared with."""
_LAYOUTS = (
    "a capture is a COLMAP model, a transforms.json, a frames.json, ScanNet's export or one of "
    f"{len(READERS) - 4} other formats, each with its images: see docs/captures.md"
)


def looks_like_capture(path: Path) -> bool:
    """Whether a reader would read it; it may be broken, as `open_capture` explains."""
    return any(reader.recognises(path) for reader in READERS)


def open_capture(path: str | Path, *, intrinsics: Intrinsics | None = None) -> Capture:
    """Read poses, intrinsics and sizes of a capture; no pixels are decoded.

    Args:
        path: a folder in one of the layouts of `READERS`, or the file of one that is a file.
        intrinsics: of all images, whatever the capture says; None for what it says.

    Returns:
        A capture with at least one frame.

    Raises:
        UserError: the folder or a file in it is missing or malformed; the text names it.
    """
    path = Path(path)
    if not path.exists():
        raise UserError("the capture does not exist", path, _meant(path))
    if not path.is_dir() and not path.is_file():
        raise UserError("the capture is not a folder", path, _LAYOUTS)
    try:
        reader = next((reader for reader in READERS if reader.recognises(path)), None)
        if path.is_dir() and (reader is None or _found_inside(reader, path)):
            inside = captures_inside(path, READERS, reader)
            if len(inside) > 1:
                raise several_captures(path, inside)
            if inside:  # as archives unpack: a folder in a folder of the same name
                return open_capture(inside[0], intrinsics=intrinsics)
        if reader is None:
            what = "there is no capture in the folder" if path.is_dir() else "this is no capture"
            raise _part_of(path) or refusal(path) or UserError(what, path, _LAYOUTS)
        with _uncollected():
            capture = _read(reader, path, intrinsics)
        return _usable(capture)
    except OSError as error:
        what = f"the capture cannot be read ({error.strerror or error})"
        raise UserError(what, Path(error.filename or path), "check its permissions") from error


def _meant(path: Path) -> str:
    """What a path that is not there may have been meant to be."""
    try:
        with os.scandir(path.parent) as entries:
            names = [entry.name for entry in islice(entries, _NAMES_LIMIT)]
    except OSError:
        names = []
    near = get_close_matches(path.name, names, n=1)
    return f"did you mean {path.with_name(near[0])}?" if near else "check the path"


def _found_inside(reader: Reader, path: Path) -> bool:
    """Whether a reader may have recognised a folder by a folder in it alone."""
    return reader in _LOOKING_INSIDE and not _holds_model(path)


def _holds_model(path: Path) -> bool:
    """Whether a folder, not one in it, is that of a scene of ScanNet's or a model of COLMAP's."""
    return scannet.is_scene(path) or any((path / place).is_dir() for place in PLACES)


def _part_of(path: Path) -> UserError | None:
    """What to say of a capture's folder of photos, or of a file of it: what people look for."""
    around = Path(os.path.abspath(path)).parent
    for folder in (around, around.parent):
        quick = (reader for reader in READERS if reader not in _LOOKING_INSIDE)
        if (
            _holds_model(folder)
            or any(reader.recognises(folder) for reader in quick)
            or ((folder == around or path.is_file()) and _has_images_of(folder, path))
        ):
            what = "this is a part of a capture, which is a folder around it"
            return UserError(what, path, f"name {quote(str(folder))}")
    return None


def _has_images_of(folder: Path, path: Path) -> bool:
    """Whether a folder with a model somewhere in it is a capture of these photos."""
    try:
        reader = next((each for each in _LOOKING_INSIDE if each.recognises(folder)), None)
        frames = {} if reader is None else reader.read(folder).frames
    except (UserError, OSError):
        return False
    whole = Path(os.path.abspath(path))
    return any(frame.image_path.is_relative_to(whole) for frame in frames.values())


def _read(reader: Reader, path: Path, intrinsics: Intrinsics | None) -> Capture:
    if isinstance(reader, ReaderOfPoses):
        return reader.read_with(path, intrinsics)
    capture = reader.read(path)
    if intrinsics is None:
        return capture
    frames = (
        replace(frame, K=intrinsics.K, lens=intrinsics.lens) for frame in capture.frames.values()
    )
    return replace(
        capture,
        frames=Frames.of(frames, capture.frames.folder),
        form=capture.form._replace(centre=0.0),  # the user's words, no file's
    )


@contextmanager
def _uncollected() -> Iterator[None]:
    """Rows of files are in no cycles; to look for some is a third of the time of a million."""
    collecting = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collecting:
            gc.enable()


def _usable(capture: Capture) -> Capture:
    """The capture, unless a pose is wrong or no frame is left."""
    for lost in capture.lost.values():
        if lost.reason not in ("no pose", "no image"):
            raise lost.error
    if not capture.frames and not capture.lost:
        raise UserError("the capture has no frame", capture.path, "add images and their poses")
    if not capture.frames:
        without_image = {id: lost for id, lost in capture.lost.items() if lost.reason == "no image"}
        if without_image:
            error = next(iter(without_image.values())).error
            names = ids_in_words(without_image)
            what = f"no frame has a pose and an image; missing are those of {names}"
            others = _called_otherwise(capture)
            if others:
                what += f"; photos that are there have other names ({ids_in_words(others, 2)})"
                remedy = f"{error.remedy}; or give the photos the names that the capture has"
                raise UserError(what, error.where, remedy)
            raise UserError(what, error.where, error.remedy)
        raise _without_poses(capture)
    _check_images(capture)
    return capture


def _called_otherwise(capture: Capture) -> list[str]:
    """Photos where a capture has its images, if none of them is called as a frame is."""
    folder = capture.path if capture.path.is_dir() else capture.path.parent
    for place in filter(Path.is_dir, (folder / "images", folder)):
        names = sorted(file.name for file in listed(place, *IMAGE_SUFFIXES))
        if names and not {Path(name).stem for name in names} & {
            Path(id).name for id in capture.lost
        }:
            return names
    return []


def _without_poses(capture: Capture) -> UserError:
    """Why no frame has a pose: where one file has all, a key of it may be misspelt."""
    errors = [lost.error for lost in capture.lost.values()]
    first = errors[0]
    if len({error.where for error in errors}) == 1:
        return UserError(f"every pose is lost: {first.what}", first.where, first.remedy)
    what = f"every pose is lost (NaN, infinite or missing; frames {ids_in_words(capture.lost)})"
    return UserError(what, Path(first.where).parent, "run the tracking again")


def _check_images(capture: Capture) -> None:
    """Refuse a capture whose images are all of a kind that is not read, or broken.

    One that can be read is enough: what is wrong with a few is said where they are needed.
    """
    for frame in capture.frames.values():
        path = frame.image_path
        if frame.image_span or not path.is_file() or image_size_of(path) is not None:
            return
    first = capture.frames.at(0)
    try:
        first.read_image()
    except UserError as error:
        what = f"none of the {len(capture.frames)} images can be used: {error.what}"
        remedy = "convert them to JPEG or PNG, or copy them again"
        raise UserError(what, first.image_path, remedy) from error
