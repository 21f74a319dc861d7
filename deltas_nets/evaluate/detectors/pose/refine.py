"""Least squares over the six numbers of a small motion.

Source: Hartley and Zisserman, 2nd ed., appendix 6.2 (Levenberg-Marquardt); the motion is applied
from the left, so that its six numbers stay near zero.
"""

from collections.abc import Callable

import torch
from torch import Tensor

__all__ = ["moved", "refine_pose"]

STEPS = 10
SMALL = 1e-10
"""A step that moves no more ends the search."""


def refine_pose(pose: Tensor, residuals: Callable[[Tensor], Tensor]) -> Tensor:
    """The pose near ``pose`` whose residuals are least, in the sum of squares.

    Args:
        pose: ``(4, 4)``.
        residuals: poses ``(4, 4)`` to ``(R,)``, differentiable.
    """

    def at(motion: Tensor) -> Tensor:
        return residuals(moved(pose, motion))

    zero = pose.new_zeros(6)
    damping, current = 1e-4, residuals(pose).square().sum()
    for _ in range(STEPS):
        jacobian, values = torch.func.jacfwd(at)(zero), at(zero)
        normal, gradient = jacobian.mT @ jacobian, jacobian.mT @ values
        # The translation of an essential matrix has no length: damping keeps that direction still.
        damped = normal + damping * normal.diagonal().mean().clamp(min=1e-12) * torch.eye(6).to(
            pose
        )
        step = -torch.linalg.solve(damped, gradient)
        tried = moved(pose, step)
        new = residuals(tried).square().sum()
        if bool(new < current):
            pose, current, damping = tried, new, damping / 10
            if float(step.abs().max()) < SMALL:
                break
        else:
            damping *= 10
    return pose


def moved(pose: Tensor, motion: Tensor) -> Tensor:
    """A pose ``(4, 4)`` after a motion ``(6,)``: axis times angle, then translation."""
    generator = torch.zeros(4, 4, dtype=pose.dtype, device=pose.device)
    x, y, z = motion[:3]
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
    twist = torch.cat([torch.cat([cross, motion[3:, None]], dim=1), generator[3:]], dim=0)
    after: Tensor = torch.linalg.matrix_exp(twist) @ pose
    return after
