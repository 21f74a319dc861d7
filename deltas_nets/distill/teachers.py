"""Detectors to distil from: score maps of networks that others trained, or we did.

A teacher is used in training only; nothing of it is in the shipped weights but what the student
learned. The paper's teacher is SuperPoint.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from torch import Tensor, nn

from deltas_nets.distill.kornia_detectors import load_aliked, load_disk, load_xfeat
from deltas_nets.distill.own_detector import load_own
from deltas_nets.distill.superpoint import load_superpoint
from deltas_nets.errors import UserError

__all__ = ["LICENCES", "TEACHERS", "Teacher", "load_teacher"]


class Teacher(Protocol):
    """Anything that says how much of an interest point every pixel is."""

    def __call__(self, images: Tensor, /) -> Tensor:
        """Score map ``(B, 1, H, W)`` in [0, 1] of RGB images ``(B, 3, H, W)`` in [0, 1]."""
        ...


TEACHERS: dict[str, Callable[[Path], nn.Module]] = {
    "superpoint": load_superpoint,
    "aliked": load_aliked,
    "disk": load_disk,
    "xfeat": load_xfeat,
    "deltas": load_own,
}
"""What loads a teacher from a file, by name."""

LICENCES = {
    "superpoint": "as the file's authors say (the original: non-commercial research)",
    "aliked": "BSD-3-Clause",
    "disk": "Apache-2.0",
    "xfeat": "Apache-2.0",
    "deltas": "as the teacher's own weights say",
}
"""Licences of the published weights, recorded beside what was distilled from them."""


def load_teacher(name: str, file: str | Path) -> nn.Module:
    """A :class:`Teacher` with the weights of a file, in evaluation mode.

    Args:
        name: superpoint, aliked, disk, xfeat or deltas, a network of ours.
        file: its published weights.

    Raises:
        UserError: no such teacher, or the file holds something else; names the first key that
            is missing.
    """
    if name not in TEACHERS:
        raise UserError("no such teacher", name, f"use one of {', '.join(TEACHERS)}")
    return TEACHERS[name](Path(file))
