"""Lenses that matches contradict: undone though images are straight, or not stated at all."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from deltas_geom import Lens, PosedViews
from deltas_geom.cameras.pixels import resize_intrinsics
from deltas_geom.diagnosis.evidence import SHARE, Evidence, gather_evidence, residuals
from deltas_geom.diagnosis.trials import level
from deltas_nets.captures.capture import Capture
from deltas_nets.captures.frame import Frame
from deltas_nets.captures.frame import Lens as FrameLens
from deltas_nets.captures.straight import StraightFrame, photo_pixels, straight
from deltas_nets.check.finding import Fault, Finding
from deltas_nets.check.frames_apart import MOSTLY
from deltas_nets.check.matched import Matched
from deltas_nets.check.mending import changing_frames
from deltas_nets.check.trying import ENOUGH, MENDED, Suspect, Tried

__all__ = ["LENSES", "wrong_lenses_of_matches"]

LENSES = (Fault.LENS_TWICE, Fault.LENS_MISSING)
"""Cures of these move pixels: what was matched before says nothing of cameras then."""
_MODEL = "SIMPLE_RADIAL"
_STRENGTHS = torch.arange(-0.6, 0.31, 0.05).tolist()
_ENOUGH_TO_SEE, _BETTER = (-0.2, -0.1, 0.1), 0.95
_FINEST = 0.005
_LEAST_GAIN = 0.3  # px
_LEFT = 0.6  # of the residuals, at most: of so many matches some are wrong, whatever the lens


def wrong_lenses_of_matches(
    capture: Capture, matched: Matched, evidence: Evidence
) -> Iterator[Suspect]:
    """Changes of the lens that explain residuals.

    Most matches have to fit, not a quarter as elsewhere: near the middle of an image every lens
    is straight.
    """
    views = matched.views(capture.frames)
    no_camera = (views.K[:, 2] != views.K.new_tensor([0, 0, 1])).any()  # as a transposed one
    if no_camera or level(residuals(evidence, *views, share=MOSTLY)) < _LEAST_GAIN:
        return
    kinds = {kind.lens is None for kind in capture.frames.arrays.cameras}
    found = None
    if kinds == {False}:
        found = _undone_twice(capture, matched, evidence, views)
    elif kinds == {True}:
        found = _not_stated(matched, evidence, views)
    if found is not None:
        yield found


def _undone_twice(
    capture: Capture, matched: Matched, evidence: Evidence, views: PosedViews
) -> Suspect | None:
    """The pixels that the photos have, seen by cameras without a lens."""
    pixels, K = [], []
    for view, (position, size) in enumerate(zip(matched.positions, matched.sizes, strict=True)):
        frame = straight(capture.frames.at(position))
        assert isinstance(frame, StraightFrame)
        # Of such a size that a pixel is as far from its neighbour as in the straight image.
        share = size[1] / frame.image_size[1] * frame.K[0, 0] / frame.photo.K[0, 0]
        height, width = frame.photo.image_size
        photo_size = max(1, round(share * height)), max(1, round(share * width))
        known = matched.pixels[view].nan_to_num()
        pixels.append(photo_pixels(frame, known, size, photo_size))
        K.append(
            resize_intrinsics(
                torch.from_numpy(frame.photo.K.copy()),
                old_size=(height, width),
                new_size=photo_size,
            )
        )
    of_photos = PosedViews(torch.stack(K), views.cam_from_world)
    lens = capture.frames.at(0).lens
    cure = f"state no lens (pinhole) in the place of {lens.model if lens else ''}"
    return _suspect(
        Fault.LENS_TWICE, cure, None, evidence, views, torch.stack(pixels), matched.seen, of_photos
    )


def _not_stated(matched: Matched, evidence: Evidence, views: PosedViews) -> Suspect | None:
    """The pixels that a straight image has, of photos that bend lines by one number."""
    unbent = partial(_unbent, matched.pixels.nan_to_num(), views.K)

    def cost(strength: float) -> float:
        moved = gather_evidence(unbent(strength), matched.seen)
        return float(residuals(moved, *views, share=MOSTLY).mean())

    if min(map(cost, _ENOUGH_TO_SEE)) > _BETTER * cost(0.0):
        return None  # of most captures: the search takes seconds
    best = min(_STRENGTHS, key=cost)
    step = _STRENGTHS[1] - _STRENGTHS[0]
    while step > _FINEST:
        step /= 2
        best = min((best - step, best, best + step), key=cost)
    cure = (
        f"calibrate the lens and state it (k1 is about {best:.2f}), as COLMAP does, or undistort "
        "the images"
    )
    lens = FrameLens(_MODEL, (best,))
    return _suspect(
        Fault.LENS_MISSING, cure, lens, evidence, views, unbent(best), matched.seen, views
    )


def _unbent(pixels: Tensor, K: Tensor, strength: float) -> Tensor:
    """``(V, N, 2)`` where the lens has a ray, else as they are."""
    found = []
    for of_view, K_of_view in zip(pixels, K, strict=True):
        lens = Lens(K_of_view, K_of_view.new_tensor([strength]), _MODEL)
        rays, valid = lens.unproject(of_view)
        good = valid & (rays[:, 2] > 0)
        x, y, w = (torch.where(good[:, None], rays, 1.0) @ K_of_view.mT).T
        there = torch.stack([x / w, y / w], dim=-1)
        found.append(torch.where(good[:, None], there, of_view))
    return torch.stack(found)


def _suspect(
    cause: Fault,
    cure: str,
    lens: FrameLens | None,
    evidence: Evidence,
    views: PosedViews,
    pixels: Tensor,
    seen: Tensor,
    mended: PosedViews,
) -> Suspect | None:
    """The suspect of pixels and cameras as they are with the cure, if they explain residuals."""
    moved = gather_evidence(pixels, seen)
    mostly, quarter = (
        Tried(
            level(residuals(evidence, *views, share=share)),
            level(residuals(moved, *mended, share=share)),
        )
        for share in (MOSTLY, SHARE)
    )
    least = min(_LEFT * mostly.given, ENOUGH)
    if mostly.given - mostly.after < _LEAST_GAIN or mostly.after > least:
        return None
    if quarter.after > MENDED:
        return None

    def change(_: int, frame: Frame) -> Frame:
        return replace(frame, lens=lens)

    mend = changing_frames(change)
    return Suspect(quarter, Finding(cause, mostly.in_words, (), cure, "error", mend))
