"""Quaternions whose four numbers were read in another order: w first where it stands last."""

from collections.abc import Iterator

import numpy as np

from deltas_nets.captures.frame import FloatArray
from deltas_nets.captures.rotations import quaternions_of, rotations_of
from deltas_nets.check.finding import Fault, Finding
from deltas_nets.check.mending import changing_poses
from deltas_nets.check.trying import Case, Suspect

__all__ = ["other_quaternions"]

ORDERS = {"x y z w": [3, 0, 1, 2], "w x y z": [1, 2, 3, 0]}
"""The order that the file has, read as the other of the two; where w, x, y and z then stand."""


def other_quaternions(case: Case) -> Iterator[Suspect]:
    """Orders that explain residuals, of world-to-camera rotations and of camera-to-world ones."""
    for order in ORDERS:
        for inverted in (False, True):

            def change(poses: FloatArray, order: str = order, inv: bool = inverted) -> FloatArray:
                return _reordered(poses, ORDERS[order], inverted=inv)

            mend = changing_poses(change)
            found = case.mended(mend)
            if found.explains:
                other = next(name for name in ORDERS if name != order)
                whose = "camera-to-world" if inverted else "world-to-camera"
                what = f"{whose} quaternions as {order} fit: {found.in_words}"
                cure = (
                    f"write quaternions as {other}: they are read so, and stand there as {order}; "
                    "or, of matrices, do so where quaternions become matrices"
                )
                yield Suspect(found, Finding(Fault.QUATERNION_ORDER, what, (), cure, "error", mend))


def _reordered(poses: FloatArray, places: list[int], *, inverted: bool) -> FloatArray:
    """``(F, 4, 4)`` cam_from_world with other rotations; ``inverted``: of the inverse poses."""
    given = _inverse(poses) if inverted else poses.copy()
    given[:, :3, :3] = rotations_of(quaternions_of(given[:, :3, :3])[:, places])
    return _inverse(given) if inverted else given


def _inverse(poses: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.inv(poses), dtype=np.float64)
