"""What files and cameras tell before any image is looked at: well below a second."""

from collections.abc import Callable

from deltas_nets.captures.capture import Capture
from deltas_nets.check.copies import copied_images
from deltas_nets.check.finding import Fault, Finding
from deltas_nets.check.intrinsics import wrong_intrinsics
from deltas_nets.check.lenses import wrong_lenses
from deltas_nets.check.lost import lost_frames
from deltas_nets.check.places import wrong_places
from deltas_nets.check.sparse import wrong_points

__all__ = ["TOLD_BEFORE", "quick_findings"]

QUICK: tuple[Callable[[Capture], list[Finding]], ...] = (
    lost_frames,
    wrong_intrinsics,
    wrong_lenses,
    wrong_places,
    wrong_points,
    copied_images,
)
"""One row a check: from a capture to what is wrong with it."""


TOLD_BEFORE = (Fault.POSES_LOST, Fault.IMAGES_MISSING, Fault.NOT_METRES)
"""What commands that read a capture warn of anyway."""


def quick_findings(capture: Capture) -> list[Finding]:
    """Findings from files and cameras alone: no pixels, no network.

    Lost poses, missing images, intrinsics and lenses that no camera has or that are of other
    images, cameras that stand still or repeat a pose, poses that are not in metres, sparse points
    that contradict cameras, copies of one image. A finding of intrinsics may be wrong where photos
    were cropped; `check_capture` knows more.
    """
    return [finding for check in QUICK for finding in check(capture)]
