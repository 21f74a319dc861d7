"""Poses of cameras whose axes point elsewhere: all ways to name them, those of left hands, too."""

from collections.abc import Iterator
from itertools import permutations, product
from typing import NamedTuple

import numpy as np

from deltas_nets.captures.file_form import FileForm
from deltas_nets.captures.frame import FloatArray
from deltas_nets.check.finding import Fault, Finding
from deltas_nets.check.mending import changing_poses
from deltas_nets.check.trying import Case, Suspect

__all__ = ["other_axes"]

MIRROR = np.diag([1.0, 1, -1, 1])
"""A world of a left hand, made one of a right hand."""
WAYS = (("right", "left"), ("down", "up"), ("forward", "backward"))
_LEFT = 0.25
"""Of the residuals, at most: of so many ways one takes half of them by accident."""
ORDINALS = ("first", "second", "third")


class _Axes(NamedTuple):
    """One way to write poses.

    Attributes:
        inverted: whether they are world-to-camera in the place of camera-to-world.
        ours: ``(4, 4)`` a signed permutation: the camera axes that files should have from theirs.
    """

    inverted: bool
    ours: FloatArray

    @property
    def left_handed(self) -> bool:
        """Whether the camera's axes, and so the world's, are a left hand's."""
        return bool(np.linalg.det(self.ours) < 0)

    def mended(self, poses: FloatArray) -> FloatArray:
        """``(F, 4, 4)`` cam_from_world with the axes that files should have."""
        given = np.linalg.inv(poses) if self.inverted else poses
        mended: FloatArray = self.ours @ given @ (MIRROR if self.left_handed else np.eye(4))
        return mended

    def in_words(self, form: FileForm) -> str:
        """Where their axes point, in files of a form."""
        ways = []
        for column in (form.axes @ self.ours)[:3, :3].T:
            axis = int(np.abs(column).argmax())
            ways.append(WAYS[axis][int(column[axis] < 0)])
        return f"x {ways[0]}, y {ways[1]}, z {ways[2]}"

    @property
    def cure(self) -> str:
        """What to do to the files."""
        columns = []
        for row in self.ours[:3, :3]:
            axis = int(np.abs(row).argmax())
            columns.append(f"{'minus ' if row[axis] < 0 else ''}the {ORDINALS[axis]}")
        steps = ["invert each pose"] if self.inverted else []
        steps.append(f"make the columns of camera-to-world {', '.join(columns)}")
        if self.left_handed:
            steps.append("negate its third row, as the world is left-handed")
        return ", then ".join(steps)


def other_axes(case: Case) -> Suspect | None:
    """The way to write poses with which matches fit best, if that explains them."""
    best: Suspect | None = None
    for axes in _all_axes():
        mend = changing_poses(axes.mended)
        found = case.mended(mend)
        explains = found.explains and found.after <= _LEFT * found.given
        # Cameras that hardly turn fit several: the first is the simplest.
        if explains and (best is None or found.after < 0.8 * best.tried.after):
            form = case.capture.form
            cause = Fault.OTHER_AXES_THAN_OPENGL if form.opengl else Fault.OTHER_AXES
            what = f"axes as {axes.in_words(form)} fit: {found.in_words}"
            best = Suspect(found, Finding(cause, what, (), axes.cure, "error", mend))
    return best


def _all_axes() -> Iterator[_Axes]:
    """Those of right hands first."""
    both = []
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        ours = np.eye(4)
        ours[:3, :3] = np.diag(signs) @ np.eye(3)[list(order)]
        both.append(ours)
    for inverted in (False, True):
        for right in (True, False):
            for ours in both:
                if (np.linalg.det(ours) > 0) == right:
                    yield _Axes(inverted, ours)
