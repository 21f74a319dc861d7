"""Poses that belong to frames before or after: stamps of two clocks, a list that lost its head."""

from dataclasses import replace

import numpy as np
import torch

from deltas_geom.diagnosis.evidence import Evidence, residuals
from deltas_geom.diagnosis.trials import level
from deltas_nets.captures.capture import Capture
from deltas_nets.captures.frames import Frames
from deltas_nets.check.finding import Fault, Finding, Mend
from deltas_nets.check.matched import Matched
from deltas_nets.check.trying import ENOUGH, Suspect, Tried

__all__ = ["poses_of_other_frames"]

MOST = 10
"""Frames that poses may be early or late."""
_LEAST = 0.15  # of the pairs must have both poses, for a shift to count
_NEARLY_ALL = 0.7  # of those pairs must fit: a shift is of all frames, or of none


def poses_of_other_frames(capture: Capture, matched: Matched, evidence: Evidence) -> Suspect | None:
    """The best shift, if any explains residuals."""
    frames, positions = capture.frames, np.array(matched.positions)
    views = matched.views(frames)
    given = residuals(evidence, *views)
    best: tuple[Tried, int] | None = None
    # A shift that leaves half of the frames without a pose would be judged by the other half.
    most = min(MOST, (len(frames) - 1) // 2)
    for shift in (shift for size in range(1, most + 1) for shift in (-size, size)):
        there = positions + shift
        inside = torch.from_numpy((there >= 0) & (there < len(frames)))
        both = inside[evidence.pairs].all(dim=-1)
        if float(both.double().mean()) < _LEAST:
            continue
        poses = torch.from_numpy(frames.cam_from_world[there.clip(0, len(frames) - 1)])
        after = residuals(evidence.of(both), views.K, poses)
        found = Tried(level(given[both]), level(after))
        fits = float((after <= ENOUGH).double().mean()) >= _NEARLY_ALL
        if fits and found.explains and (best is None or found.after < best[0].after):
            best = found, shift
    if best is None:
        return None
    found, shift = best
    size, which = abs(shift), "later" if shift > 0 else "earlier"
    evidence_in_words = f"the pose of the frame {size} {which} fits each frame: {found.in_words}"
    first, second = frames.id_at(0), frames.id_at(size)
    of = f"{first} the pose of {second}" if shift > 0 else f"{second} the pose of {first}"
    cure = f"give each frame the pose of the frame {size} {which} ({of}, and so on); "
    cure += f"{size} frames at the {'end' if shift > 0 else 'beginning'} have none then"
    finding = Finding(
        Fault.POSES_OF_OTHER_FRAMES, evidence_in_words, (), cure, "error", _shifted(shift)
    )
    return Suspect(found, finding)


def _shifted(shift: int) -> Mend:
    def mend(capture: Capture) -> Capture:
        frames = capture.frames
        there = np.arange(len(frames)) + shift
        inside = (there >= 0) & (there < len(frames))
        kept = frames.kept(inside)
        arrays = kept.arrays._replace(cam_from_world=frames.cam_from_world[there[inside]])
        frames = Frames(kept.folder, arrays, memory=kept.memory)
        return replace(capture, frames=frames, points=None, depth_ranges=None)

    return mend
