"""Every frame matched to those after it, small: which ones disagree, once some are known to."""

import torch
from torch import Tensor

from deltas_geom.diagnosis.evidence import Evidence, residuals
from deltas_nets.captures.capture import Capture
from deltas_nets.check.descriptors import Described, describe
from deltas_nets.check.frames_apart import MOSTLY, views_apart
from deltas_nets.check.matched import LEAST, cameras_of
from deltas_nets.check.matching import match
from deltas_nets.check.path import views_off_path
from deltas_nets.check.workers import side_by_side
from deltas_nets.errors import UserError
from deltas_nets.network.deltas import Deltas

__all__ = ["MOST", "scan_frames"]

MOST = 400
"""Frames that are looked at; of a longer capture every second, third, ..."""
WORK_PIXELS = 30_000
NUM_KEYPOINTS = 160
_ENOUGH = 1.2  # px at that size
_STEPS = (1, 2)  # frames on, to match


def scan_frames(capture: Capture, network: Deltas, *, threads: int = 1) -> tuple[list[int], int]:
    """Positions of the frames that disagree with their neighbours, and how many were looked at.

    A frame in the wrong place by a hand's breadth shows at a fourth of the pixels as well, and all
    frames of a capture are looked at in the time of thirty.

    Args:
        capture: whose other frames agree.
        network: with descriptors.
        threads: that look at frames.
    """
    positions = list(range(0, len(capture.frames), -(-len(capture.frames) // MOST)))
    known: list[Described | None] = []
    sizes: list[tuple[int, int]] = []
    pairs: list[tuple[int, int]] = []
    matches: list[Tensor] = []
    looked = side_by_side(lambda position: _look(capture, network, position), positions, threads)
    for number, described in enumerate(looked):
        known.append(described)
        sizes.append((1, 1) if described is None else described.size)
        for step in _STEPS:
            one, other = known[number - step] if number >= step else None, known[number]
            if one is None or other is None:
                continue
            there, kept = match(one, other)
            if int(kept.sum()) >= LEAST // 2:
                pairs.append((number - step, number))
                matches.append(torch.stack([one.keypoints[kept], there[kept]]).double().cpu())
        if number >= max(_STEPS):
            known[number - max(_STEPS)] = None  # its descriptors are not needed any more
    if not pairs:
        return [], len(positions)
    evidence = _evidence(pairs, matches)
    views = cameras_of(capture.frames, positions, sizes)
    residual = residuals(evidence, *views, share=MOSTLY)
    apart = views_apart(evidence, residual, len(positions), enough=_ENOUGH)
    poses = capture.frames.cam_from_world[positions]
    apart += views_off_path(evidence, residual, poses, apart)
    return [positions[number] for number in sorted(apart)], len(positions)


def _look(capture: Capture, network: Deltas, position: int) -> Described | None:
    frame = capture.frames.at(position)
    try:
        return describe(network, frame, work_pixels=WORK_PIXELS, num_keypoints=NUM_KEYPOINTS)
    except UserError:
        return None


def _evidence(pairs: list[tuple[int, int]], matches: list[Tensor]) -> Evidence:
    counts = torch.tensor([both.shape[1] for both in matches])
    filled = torch.full((len(pairs), 2, int(counts.max()), 2), torch.nan, dtype=torch.float64)
    for pair, both in enumerate(matches):
        filled[pair, :, : both.shape[1]] = both
    return Evidence(torch.tensor(pairs), filled[:, 0], filled[:, 1], counts)
