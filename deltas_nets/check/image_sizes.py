"""Image files of another size than the capture says."""

from dataclasses import replace

from deltas_nets.captures.capture import Capture, Frame
from deltas_nets.captures.ids import ids_in_words
from deltas_nets.captures.images import image_size_of, in_words, orientation_of
from deltas_nets.check.finding import Fault, Finding
from deltas_nets.check.intrinsics import in_a_line
from deltas_nets.check.mending import changing_frames
from deltas_nets.check.rewrite import of_shape, swapped

__all__ = ["wrong_sizes"]

MOST = 2000  # files whose header is read


def wrong_sizes(capture: Capture) -> list[Finding]:
    """A finding where files are not of the size that their camera is for.

    Headers alone are read. Its mend gives cameras the size of the files.
    """
    wrong = {}
    for frame in list(capture.frames.values())[:MOST]:
        size = image_size_of(frame.image_path) if frame.image_span is None else None
        if size is not None and size != frame.image_size:
            wrong[frame.id] = size
    if not wrong:
        return []
    first, size = next(iter(wrong.items()))
    frame = capture.frames[first]
    evidence = (
        f"{len(wrong)} images ({ids_in_words(wrong)}) are {in_words(size)}, and the capture says "
        f"{in_words(frame.image_size)}"
    )
    turned = size == frame.image_size[::-1]
    right = _of_file(frame, size)
    cure = f"state width {size[1]} and height {size[0]} with "
    cure += in_a_line(right.K, capture.form.centre)
    exif = [id for id in wrong if orientation_of(capture.frames[id].image_path) > 1]
    if turned and exif:
        cure = f"turn {ids_in_words(exif, 20)} as EXIF says, which is not followed"
    cause = Fault.SIDES_SWAPPED if turned else Fault.IMAGES_UNREADABLE
    ids = () if len(wrong) == len(capture.frames) else tuple(wrong)

    def change(position: int, frame: Frame) -> Frame:
        return _of_file(frame, wrong[frame.id]) if frame.id in wrong else frame

    return [Finding(cause, evidence, ids, cure, "error", changing_frames(change))]


def _of_file(frame: Frame, size: tuple[int, int]) -> Frame:
    """The frame with the size of its file, and a K for that."""
    if size != frame.image_size[::-1]:
        K = of_shape(frame.K, frame.image_size, size)
        return replace(frame, image_size=size, K=K)
    # Either the sizes alone were swapped, or K with them: it is of the size whose middle it has.
    as_it_is, other = (
        max(abs((K[0, 2] + 0.5) / size[1] - 0.5), abs((K[1, 2] + 0.5) / size[0] - 0.5))
        for K in (frame.K, swapped(frame.K))
    )
    return replace(frame, image_size=size, K=frame.K if as_it_is <= other else swapped(frame.K))
