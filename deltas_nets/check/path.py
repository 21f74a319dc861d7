"""Frames off the path of the camera: what matches suspect, the frames before and after confirm.

A camera that was moved towards what it sees moves matches along their epipolar lines, so its
residuals grow by little. Beside other frames that disagree, little and a jump are enough.
"""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from deltas_geom.diagnosis.evidence import Evidence
from deltas_nets.captures.frame import FloatArray
from deltas_nets.check.places import centres_of

__all__ = ["views_off_path"]

_JUMP = 5.0  # times the usual distance from the middle of the frames before and after
_SUSPECT = 2.0  # times the usual residual


def views_off_path(
    evidence: Evidence, residual: Tensor, poses: FloatArray, apart: list[int]
) -> list[int]:
    """Views that jump and whose matches are off by more than usual.

    Args:
        evidence: P pairs.
        residual: ``(P)`` px.
        poses: ``(V, 4, 4)`` in the order of time.
        apart: views that are known to be wrong.
    """
    left = np.setdiff1d(np.arange(len(poses)), apart)
    if len(left) < 5:
        return []
    jump = _jumps(centres_of(poses[left]))
    kept = ~evidence.with_camera(*apart) if apart else torch.ones(len(residual), dtype=torch.bool)
    if not bool(kept.any()):
        return []
    usual = float(residual[kept].median())
    # A frame that jumps makes its neighbours seem to: the largest is the one.
    around = np.maximum(np.append(jump[1:], 0), np.insert(jump[:-1], 0, 0))
    found = []
    for view in left[(jump > _JUMP * np.median(jump)) & (jump >= around)].tolist():
        own = residual[kept & evidence.with_camera(view)]
        if len(own) and float(own.mean()) > _SUSPECT * usual:
            found.append(view)
    return found


def _jumps(centres: FloatArray) -> NDArray[np.float64]:
    """Distances from the middle of the neighbours, at the ends from the line through the next."""
    inner = centres[1:-1] - (centres[:-2] + centres[2:]) / 2
    first = (centres[0] - 2 * centres[1] + centres[2]) / 2
    last = (centres[-1] - 2 * centres[-2] + centres[-3]) / 2
    jumps: NDArray[np.float64] = np.linalg.norm(np.vstack([first, inner, last]), axis=-1)
    return jumps
