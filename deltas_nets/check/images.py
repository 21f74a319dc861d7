"""Images that are blurred, or all but the same as another frame's, by small copies of them."""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from deltas_nets.captures.capture import Capture, Frame
from deltas_nets.captures.ids import ids_in_words
from deltas_nets.captures.images import header_of, is_8_bit, open_span, why_not_decoded
from deltas_nets.check.copies import repeated
from deltas_nets.check.finding import Fault, Finding
from deltas_nets.check.mending import leaving_out

__all__ = ["look_at_images"]

MOST = 400
"""Images that are looked at; of more, every second, third, ..."""
THUMB = (72, 96)
WIDTH = 320  # of the longer side, at which sharpness is judged
SAME = 0.6  # of 255, mean difference of thumbs that show the same
BLURRED = 0.28  # of its neighbours' sharpness
_NEIGHBOURS = 5  # on either side


class _Seen(NamedTuple):
    """An image, small.

    Attributes:
        position: of the frame.
        thumb: ``(72, 96)`` grey.
        sharpness: how much of the change from pixel to pixel is not there over two pixels.
    """

    position: int
    thumb: NDArray[np.float32]
    sharpness: float


def look_at_images(capture: Capture) -> list[Finding]:
    """Findings of blurred and repeated images, and of files that cannot be used."""
    step = max(1, -(-len(capture.frames) // MOST))
    seen, broken = [], dict[str, str]()
    for position in range(0, len(capture.frames), step):
        frame = capture.frames.at(position)
        looked = _look(frame, position)
        if isinstance(looked, str):
            broken[frame.id] = looked
        else:
            seen.append(looked)
    found: list[Finding] = []
    if broken:
        first = next(iter(broken))
        total = len(seen) + len(broken)
        what = f"{len(broken)} of {total} images cannot be used ({first}: {broken[first]})"
        cure, ids = "copy them again, or convert them to 8-bit JPEG", tuple(broken)
        found = [Finding(Fault.IMAGES_UNREADABLE, what, (), cure, "error")]
        if seen:
            cure += f", or leave out {ids_in_words(broken, 20)}"
            found = [Finding(Fault.IMAGES_UNREADABLE, what, ids, cure, "error", leaving_out(ids))]
    return [*found, *_blurred(capture, seen), *_same(capture, seen)]


def _look(frame: Frame, position: int) -> _Seen | str:
    try:
        with (
            open_span(frame.image_path, frame.image_span) as file,
            Image.open(file) as image,
        ):
            if not is_8_bit(header_of(image)):
                return f"pixels of type {image.mode}, not 8-bit colour"
            image.draft("L", (WIDTH, WIDTH * 2 // 3))
            grey = image.convert("L")
            # Of the longer side: a portrait is looked at as finely as the landscapes around it.
            share = min(1.0, WIDTH / max(grey.size))
            width, height = (max(8, int(share * side)) for side in grey.size)
            small = grey.resize((width, height), Image.Resampling.BOX)
            thumb = small.resize(THUMB[::-1], Image.Resampling.BOX)
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        return why_not_decoded(frame.image_path, error)
    return _Seen(position, np.asarray(thumb, np.float32), _sharpness(np.asarray(small, np.float32)))


def _sharpness(grey: NDArray[np.float32]) -> float:
    """Variance of second differences over that of first: what blur takes first."""
    if min(grey.shape) < 3:
        return 1.0  # too small to tell
    first = (np.diff(grey, axis=0).var() + np.diff(grey, axis=1).var()) / 2
    inner = grey[1:-1, 1:-1]
    second = 4 * inner - grey[:-2, 1:-1] - grey[2:, 1:-1] - grey[1:-1, :-2] - grey[1:-1, 2:]
    return float(second.var() / (first + 1))


def _blurred(capture: Capture, seen: list[_Seen]) -> list[Finding]:
    sharp = np.array([one.sharpness for one in seen])
    ids = []
    for place, value in enumerate(sharp):
        around = sharp[max(0, place - _NEIGHBOURS) : place + _NEIGHBOURS + 1]
        if value < BLURRED * float(np.median(around)):
            ids.append(capture.frames.id_at(seen[place].position))
    if not ids:
        return []
    evidence = f"{len(ids)} of {len(seen)} images ({ids_in_words(ids)}) have less than "
    evidence += f"{100 * BLURRED:.0f} % of the detail of their neighbours"
    cure = f"leave out {ids_in_words(ids, 20)}"
    return [Finding(Fault.BLURRED, evidence, tuple(ids), cure, "warning", leaving_out(ids))]


def _same(capture: Capture, seen: list[_Seen]) -> list[Finding]:
    """Neighbours whose thumbs are the same, though their files may not be."""
    groups: list[list[str]] = []
    for one, other in pairwise(seen):
        if float(abs(one.thumb - other.thumb).mean()) > SAME:
            continue
        first, second = (capture.frames.id_at(each.position) for each in (one, other))
        if groups and groups[-1][-1] == first:
            groups[-1].append(second)
        else:
            groups.append([first, second])
    return repeated(capture, groups, "they look the same")
