"""ALIKED, DISK and XFeat of kornia as dense score maps, with weights from a file.

All three give a value to every pixel of the image itself: pixel (x, y) of the map is about
pixel (x, y) of the image. They are padded to the sizes they need, never resized, so points stay
where they are.

Sources: Zhao et al., ALIKED (2023); Tyszkiewicz, Fua and Trulls, DISK (2020); Potje et al.,
XFeat (2024).
"""

from importlib import import_module
from pathlib import Path
from typing import Any

import torch.nn.functional as F
from torch import Tensor, nn

from deltas_nets.distill.weights_file import fill
from deltas_nets.errors import UserError
from deltas_nets.network.torch_file import read_state

ALIKED_BY_STEM = {8: "aliked-t16", 16: "aliked-n16"}
"""kornia's names of the sizes of ALIKED, by the channels of the first layer."""


class AlikedScores(nn.Module):
    """ALIKED's score map. kornia pads around the image's centre and crops back by itself."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, images: Tensor) -> Tensor:
        """Score map ``(B, 1, H, W)`` of RGB images ``(B, 3, H, W)`` in [0, 1]."""
        scores: Tensor = self.network.extract_dense_map(images)[1]  # type: ignore[operator]
        return scores


class DiskScores(nn.Module):
    """DISK's score map: the probability that a pixel, alone with its logit, is accepted."""

    MULTIPLE = 16

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, images: Tensor) -> Tensor:
        """Score map ``(B, 1, H, W)`` of RGB images ``(B, 3, H, W)`` in [0, 1]."""
        height, width = images.shape[-2:]
        padded = pad_to_multiple(images, self.MULTIPLE)
        heatmap: Tensor = self.network.heatmap_and_dense_descriptors(padded)[0]  # type: ignore[operator]
        return heatmap[..., :height, :width].sigmoid()


class XfeatScores(nn.Module):
    """XFeat's score map: the probability of a keypoint, times the reliability of its cell."""

    MULTIPLE = 32
    CELL = 8

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, images: Tensor) -> Tensor:
        """Score map ``(B, 1, H, W)`` of RGB images ``(B, 3, H, W)`` in [0, 1]."""
        height, width = images.shape[-2:]
        _, logits, reliability = self.network(pad_to_multiple(images, self.MULTIPLE))
        heatmap = F.pixel_shuffle(logits.softmax(dim=1)[:, :-1], self.CELL)
        # kornia reads it at points with a shifted frame; here cells share the image plane.
        reliability = F.interpolate(
            reliability, size=heatmap.shape[-2:], mode="bilinear", align_corners=False
        )
        return (heatmap * reliability)[..., :height, :width]


def pad_to_multiple(images: Tensor, multiple: int) -> Tensor:
    """Repeat the last row and column until both sides are multiples: pixels keep their places."""
    height, width = images.shape[-2:]
    return F.pad(images, (0, -width % multiple, 0, -height % multiple), mode="replicate")


def load_aliked(file: Path) -> AlikedScores:
    """ALIKED with a file's weights (``aliked-t16``, ``-n16``, ``-n16rot`` or ``-n32``).

    Raises:
        UserError: the file cannot be read, or a weight is missing; names the first one.
    """
    state = read_state(file)
    stem, aggregate = state.get("block1.conv1.weight"), state.get("desc_head.agg_weights")
    name = ALIKED_BY_STEM.get(16 if stem is None else len(stem), "aliked-n16")
    if aggregate is not None and len(aggregate) == 32:
        name = "aliked-n32"
    network = _of_kornia("ALIKED")(model_name=name)
    fill(network, state, file, what="ALIKED", computed=("dkd.hw_grid",))
    return AlikedScores(network).eval().requires_grad_(False)


def load_disk(file: Path) -> DiskScores:
    """DISK with a file's weights (``depth-save.pth`` or ``epipolar-save.pth``).

    Raises:
        UserError: the file cannot be read, or a weight is missing; names the first one.
    """
    network = _of_kornia("DISK")()
    fill(network, read_state(file), file, what="DISK")
    return DiskScores(network).eval().requires_grad_(False)


def load_xfeat(file: Path) -> XfeatScores:
    """XFeat with a file's weights (``xfeat.pt``).

    Raises:
        UserError: the file cannot be read, or a weight is missing; names the first one.
    """
    network = _of_kornia("XFeatModel")()
    fill(network, read_state(file), file, what="XFeat")
    return XfeatScores(network).eval().requires_grad_(False)


def _of_kornia(name: str) -> Any:
    """A class of kornia's.

    Raises:
        UserError: it is of a later version than the one that is installed.
    """
    found = getattr(import_module("kornia.feature"), name, None)
    if found is None:
        raise UserError(f"this kornia has no {name}", "kornia", 'pip install "kornia>=0.9"')
    return found
