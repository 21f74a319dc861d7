"""Whether there is something to learn from, and to measure on, before a night is spent on it."""

from collections.abc import Callable

import numpy as np
from torch.utils.data import Dataset, Subset

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.centres import camera_centres
from deltas_nets.captures.ids import ids_in_words
from deltas_nets.captures.posed_images import PosedImages
from deltas_nets.captures.work_size import SMALLEST_BASELINE
from deltas_nets.datasets.scannet import ScanNetViewSets
from deltas_nets.errors import UserError

__all__ = ["check_frames", "check_parallax", "check_true_depth"]

Report = Callable[[str], None]
LOOKED_AT = 16
"""Anchors whose depth is read: a few hundredths of a second each."""


def check_frames(
    data: Dataset[PosedImages],
    held_out: Subset[PosedImages] | None,
    depth_range: tuple[float, float],
    *,
    report: Report = lambda _: None,
) -> None:
    """Look at the frames of a training; rooms, which are as we draw them, are not looked at.

    Args:
        data: what is trained on.
        held_out: of what it is validated on; None if that is rooms.
        depth_range: (near, far) metres, what is learned from.
        report: gets warnings.

    Raises:
        UserError: there is no depth in this range, or no camera moves.
    """
    if not isinstance(data, ScanNetViewSets):
        return
    check_parallax(data, report=report)
    check_true_depth(data, depth_range, report=report)
    if held_out is not None and isinstance(held_out.dataset, ScanNetViewSets):
        check_true_depth(held_out.dataset, depth_range, report=report)
        learned = dict(data.scenes)
        both = [name for name, _ in held_out.dataset.scenes if name in learned]
        if both:
            scenes = f"{len(both)} of {len(held_out.dataset.scenes)} scenes ({ids_in_words(both)})"
            report(f"warning: {scenes} of --data.validation are trained on, too: no held-out ones")


def check_parallax(data: ScanNetViewSets, *, report: Report = lambda _: None) -> None:
    """Look at the poses of all scenes: a camera that stands sees no depth.

    Args:
        data: view sets of scenes.
        report: gets a warning where some of the cameras stand.

    Raises:
        UserError: all of them do.
    """
    still = [name for name, scene in data.scenes if _stands(scene)]
    if still and len(still) == len(data.scenes):
        what = f"the camera stands in one place in all {len(still)} scenes, and shows no parallax"
        remedy = "poses are camera-to-world, in metres: check what wrote them"
        raise UserError(what, dict(data.scenes)[still[0]].path / "pose", remedy)
    if still:
        scenes = f"{len(still)} of {len(data.scenes)} scenes ({ids_in_words(still)})"
        report(f"warning: the camera stands in one place in {scenes}, which teach no matching")


def _stands(scene: Capture) -> bool:
    centres = camera_centres(scene.frames.cam_from_world)
    return len(centres) > 0 and bool(np.ptp(centres, axis=0).max() < SMALLEST_BASELINE)


def check_true_depth(
    data: ScanNetViewSets, depth_range: tuple[float, float], *, report: Report = lambda _: None
) -> None:
    """Look at the depth of a few anchors, spread evenly over all of them.

    Losses leave out what is not measured, or in another range. Where that is everything, in a wrong
    unit for example, they fall as smooth maps do, and nothing is learned.

    Args:
        data: view sets of scenes.
        depth_range: (near, far) metres, what is learned from.
        report: gets a warning where most of them have none in this range.

    Raises:
        UserError: all of them have none.
    """
    (near, far), scenes = depth_range, dict(data.scenes)
    count = min(LOOKED_AT, len(data))
    without: list[tuple[str, str]] = []
    found: list[float] = []
    seen = 0
    for number in range(count):
        name, views = data.view_set(len(data) * number // count)
        try:
            depth = scenes[name].frame(views.anchor).read_depth()
        except UserError:
            continue  # what is damaged is told when its step comes
        seen += 1
        known = depth[depth > 0]
        found += [float(known.min()), float(known.max())] if known.size else []
        if not ((known >= near) & (known <= far)).any():
            without.append((name, views.anchor))
    if 2 * len(without) <= seen:
        return
    what = f"{len(without)} of {seen} frames looked at have no depth within {near:g} to {far:g} m"
    name, anchor = without[0]
    if len(without) == seen:
        extent = f"it is {min(found):.3g} to {max(found):.3g} m" if found else "none is measured"
        remedy = "write 16-bit millimetres, 0 where unknown"
        raise UserError(f"{what} ({extent})", scenes[name].path / "depth", remedy)
    report(f"warning: {what}, and teach nothing; the first is frame {anchor} of {name}")
