"""What the network remembers of a frame: enough to find a pixel of it in any other."""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from deltas_nets.captures.frame import Frame
from deltas_nets.captures.straight import straight
from deltas_nets.captures.work_size import fit_work_size, load_image
from deltas_nets.network.deltas import Deltas

__all__ = ["Described", "describe"]

WORK_PIXELS = 120_000
NUM_KEYPOINTS = 400


class Described(NamedTuple):
    """A frame in the eyes of the network.

    Attributes:
        size: (height, width) it was looked at.
        keypoints: ``(N, 2)`` px of that size.
        fine: ``(D, h, w)`` descriptors of unit length at half that size.
        rows: ``(h w, D)`` the same in another order, which is quicker to gather from.
        coarse: ``(D, h/2, w/2)`` of unit length at a quarter.
    """

    size: tuple[int, int]
    keypoints: Tensor
    fine: Tensor
    rows: Tensor
    coarse: Tensor

    def at(self, pixels: Tensor) -> Tensor:
        """Descriptors ``(N, D)`` of unit length at pixels ``(N, 2)``."""
        size = pixels.new_tensor(self.size[::-1])
        grid = ((pixels + 0.5) / size * 2 - 1)[None, None]
        read = F.grid_sample(self.fine[None], grid, align_corners=False, padding_mode="border")
        return F.normalize(read[0, :, 0].mT, dim=-1)


@torch.inference_mode()
def describe(
    network: Deltas,
    frame: Frame,
    *,
    work_pixels: int = WORK_PIXELS,
    num_keypoints: int = NUM_KEYPOINTS,
) -> Described:
    """Look at a frame.

    Args:
        network: one with descriptors, on any device.
        frame: with an image.
        work_pixels: how many pixels it is looked at with, at most.
        num_keypoints: that are searched in other frames.

    Raises:
        UserError: the image cannot be read.
    """
    frame = straight(frame)
    size = fit_work_size(frame.image_size, max_pixels=work_pixels)
    device = next(network.parameters()).device
    encoded = network.encode(load_image(frame, work_size=size).to(device)[None, None])
    keypoints = network.detector(encoded.features, image_size=size, num_keypoints=num_keypoints)
    fine = encoded.descriptors.maps[0, 0]
    coarse = F.normalize(F.avg_pool2d(fine[None], 2)[0], dim=0)
    rows = fine.flatten(1).mT.contiguous()
    return Described(size, keypoints.pixels[0], fine, rows, coarse)
