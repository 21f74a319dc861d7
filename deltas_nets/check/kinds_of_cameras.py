"""Intrinsics that matches contradict: of all frames, or of those that share a camera."""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from deltas_geom import PosedViews
from deltas_geom.cameras.pixels import resize_intrinsics
from deltas_geom.diagnosis.evidence import Evidence, residuals
from deltas_geom.diagnosis.hypotheses import resized
from deltas_nets.captures.capture import Capture
from deltas_nets.captures.frames import Frames
from deltas_nets.captures.ids import ids_in_words
from deltas_nets.check.finding import Fault, Finding
from deltas_nets.check.intrinsics import in_a_line, off_middle
from deltas_nets.check.matched import Matched
from deltas_nets.check.mending import changing_frames
from deltas_nets.check.rewrite import of_size, swapped, with_focal, with_K
from deltas_nets.check.trying import Suspect, rounded, searched, tried

__all__ = ["kinds_of", "wrong_kinds"]

APART = 0.03  # relative, between focal lengths of different kinds
MOST_KINDS = 4
LEAST_CHANGE = 0.03  # relative: less is a lens that is a little off, and nobody's mistake


class _Way(NamedTuple):
    """How K may have become wrong, by a factor.

    Attributes:
        cause: if all frames are concerned.
        of_views: ``(V, 3, 3)`` mended, at the size that frames are looked at.
        of_frame: ``(3, 3)`` mended, of a frame.
        what: is to be multiplied.
    """

    cause: Fault
    of_views: Callable[[Tensor, float], Tensor]
    of_frame: Callable[[NDArray[np.float64], float], NDArray[np.float64]]
    what: str


def _longer(K: Tensor, factor: float) -> Tensor:
    return K * K.new_tensor([[factor, 1, 1], [1, factor, 1], [1, 1, 1]])


WAYS = (
    _Way(Fault.K_OF_OTHER_SIZE, resized, of_size, "K"),
    _Way(Fault.FOCAL_LENGTH, _longer, with_focal, "fx and fy"),
)


def wrong_kinds(capture: Capture, matched: Matched, evidence: Evidence) -> Iterator[Suspect]:
    """Changes of K that explain residuals: of all frames, and of each kind of camera alone."""
    frames = capture.frames
    views = matched.views(frames)
    given = residuals(evidence, *views)
    kinds = kinds_of(frames)
    groups = [np.ones(len(frames), dtype=np.bool_)]
    if 1 < kinds.max() + 1 <= MOST_KINDS:
        kinds_by_size = np.argsort(np.bincount(kinds), kind="stable")
        groups += [kinds == kind for kind in kinds_by_size]
    for group in groups:
        members = torch.from_numpy(group[list(matched.positions)])[:, None, None]
        suspects = dict[float, Suspect]()
        for way in WAYS if members.any() else ():

            def changed(factor: float, way: _Way = way, members: Tensor = members) -> PosedViews:
                K = torch.where(members, way.of_views(views.K, factor), views.K)
                return PosedViews(K, views.cam_from_world)

            def cost(factor: float) -> float:
                return float(residuals(evidence, *changed(factor)).mean())

            factor = rounded(searched(cost), cost)
            found = tried(evidence, given, changed(factor))
            if found.explains and abs(np.log(factor)) > LEAST_CHANGE:
                index = int(np.flatnonzero(group)[0])
                middle = off_middle(
                    way.of_frame(frames.K[index], factor), frames.at(index).image_size
                )
                finding = _finding(capture, group, way, factor, found.in_words)
                suspects[middle] = Suspect(found, finding)
        # Of two that fit alike, the one that leaves the principal point nearer to the middle.
        yield from (suspects[middle] for middle in sorted(suspects))
    yield from _swapped(capture, matched, evidence, given)


def kinds_of(frames: Frames) -> NDArray[np.int64]:
    """``(F,)`` which kind of camera took each frame: focal lengths apart by 3 % are of two."""
    relative = np.log(frames.K[:, 0, 0] / frames.image_sizes[:, 1])
    order = np.argsort(relative, kind="stable")
    jumps = np.diff(relative[order], prepend=relative[order[:1]]) > np.log1p(APART)
    kinds = np.empty(len(order), dtype=np.int64)
    kinds[order] = np.cumsum(jumps)
    return kinds


def _finding(
    capture: Capture, group: NDArray[np.bool_], way: _Way, factor: float, figures: str
) -> Finding:
    frames = capture.frames
    ids = () if group.all() else tuple(frames.kept(group))
    position = int(np.flatnonzero(group)[0])
    right = {int(index): way.of_frame(frames.K[index], factor) for index in np.flatnonzero(group)}
    cause = way.cause if group.all() else Fault.K_OF_SOME_FRAMES
    whose = "" if group.all() else f" of {len(ids)} frames ({ids_in_words(ids)})"
    evidence = f"{way.what}{whose} times {factor:.4g} fits: {figures}"
    cure = f"multiply {way.what}{whose} by {factor:.4g}: "
    cure += in_a_line(right[position], capture.form.centre)
    return Finding(cause, evidence, ids, cure, "error", changing_frames(with_K(right)))


def _swapped(
    capture: Capture, matched: Matched, evidence: Evidence, given: Tensor
) -> Iterator[Suspect]:
    """K of images of swapped width and height."""
    frames = capture.frames
    views = matched.views(frames)
    K = torch.stack(
        [
            resize_intrinsics(
                torch.from_numpy(swapped(frames.K[position]).copy()),
                old_size=tuple(frames.image_sizes[position].tolist()),
                new_size=size,
            )
            for position, size in zip(matched.positions, matched.sizes, strict=True)
        ]
    )
    found = tried(evidence, given, PosedViews(K, views.cam_from_world))
    if found.explains:
        right: dict[int, Any] = {index: swapped(K) for index, K in enumerate(frames.K)}
        cure = f"exchange fx with fy and cx with cy: {in_a_line(right[0], capture.form.centre)}"
        mend = changing_frames(with_K(right))
        what = f"K with x and y exchanged fits: {found.in_words}"
        yield Suspect(found, Finding(Fault.SIDES_SWAPPED, what, (), cure, "error", mend))
