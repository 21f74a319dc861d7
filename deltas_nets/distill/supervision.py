"""A teacher's labels for the images of a training step (paper, section 4.1)."""

import torch
from torch import Tensor, nn

from deltas_nets.distill.labels import soft_labels


class TeacherLabels:
    """What a teacher says about the cells of an image.

    Not a module: what holds it neither trains the teacher nor saves it, and DDP does not see it.

    Args:
        teacher: gives score maps; stays in evaluation mode, without gradients.
    """

    def __init__(self, teacher: nn.Module) -> None:
        self.teacher = teacher.eval().requires_grad_(False)

    @torch.no_grad()
    def __call__(self, images: Tensor) -> Tensor:
        """Distributions ``(B, 65, ceil(H/8), ceil(W/8))`` over the channels of every cell.

        Args:
            images: ``(B, 3, H, W)`` RGB in [0, 1], on the teacher's device.
        """
        own = next(self.teacher.parameters()).dtype
        scores: Tensor = self.teacher(images.to(own))
        return soft_labels(scores).to(images.dtype)
