"""SuperPoint: the paper's teacher, from a file in either published layout.

Source: DeTone, Malisiewicz and Rabinovich, SuperPoint: self-supervised interest point detection
and description (2018). The open re-training puts batch norm after every activation.
"""

from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import torch.nn.functional as F
from torch import Tensor, nn

from deltas_nets.distill.weights_file import fill
from deltas_nets.errors import UserError
from deltas_nets.network.torch_file import read_state

CELL = 8
"""Side of a detector cell, pixels."""
WIDTHS = (64, 64, 128, 128)
"""Channels of the trunk at 1, 1/2, 1/4, 1/8."""
HEAD, LOGITS, DESCRIPTOR = 256, CELL * CELL + 1, 256
GREY = (0.299, 0.587, 0.114)

# Names of the original layout, in the order of the open one.
_TRUNK = ("conv1a", "conv1b", "conv2a", "conv2b", "conv3a", "conv3b", "conv4a", "conv4b")
_ORIGINAL = {f"{name}.": f"backbone.{i // 2}.{i % 2}.conv." for i, name in enumerate(_TRUNK)} | {
    "convPa.": "detector.0.conv.",
    "convPb.": "detector.1.conv.",
    "convDa.": "descriptor.0.conv.",
    "convDb.": "descriptor.1.conv.",
}


class SuperPointMaps(NamedTuple):
    """What SuperPoint sees in B images.

    Attributes:
        scores: ``(B, 1, H, W)`` probability of an interest point at every pixel.
        descriptors: ``(B, 256, ceil(H/8), ceil(W/8))`` of unit length, at the cells' centres.
    """

    scores: Tensor
    descriptors: Tensor


class _Layer(nn.Module):
    """Convolution, ReLU, and batch norm after it in the open re-training."""

    def __init__(
        self, inputs: int, outputs: int, *, kernel: int = 3, relu: bool = True, norm: bool
    ) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, kernel, padding=kernel // 2)
        self.activation = nn.ReLU() if relu else nn.Identity()
        self.bn = nn.BatchNorm2d(outputs, eps=1e-3) if norm else nn.Identity()

    def forward(self, x: Tensor) -> Tensor:
        output: Tensor = self.bn(self.activation(self.conv(x)))
        return output


class SuperPoint(nn.Module):
    """The network; names of its weights are those of the open re-training.

    Args:
        channels: of the input: 1 for grey images; some re-trainings have more.
        batch_norm: whether layers end in batch norm, as in the open re-training.

    Example:
        >>> import torch
        >>> network = SuperPoint(batch_norm=False).eval()
        >>> network(torch.rand(1, 3, 50, 70)).shape
        torch.Size([1, 1, 50, 70])
    """

    def __init__(self, channels: int = 1, *, batch_norm: bool) -> None:
        super().__init__()
        self.channels = channels
        widths = (channels, *WIDTHS)
        self.backbone = nn.ModuleList(
            nn.Sequential(
                _Layer(inputs, outputs, norm=batch_norm), _Layer(outputs, outputs, norm=batch_norm)
            )
            for inputs, outputs in pairwise(widths)
        )
        self.detector, self.descriptor = (
            nn.Sequential(
                _Layer(WIDTHS[-1], HEAD, norm=batch_norm),
                _Layer(HEAD, outputs, kernel=1, relu=False, norm=batch_norm),
            )
            for outputs in (LOGITS, DESCRIPTOR)
        )

    def forward(self, images: Tensor) -> Tensor:
        """Score map ``(B, 1, H, W)`` of RGB images ``(B, 3, H, W)`` in [0, 1]."""
        return self.maps(images).scores

    def maps(self, images: Tensor) -> SuperPointMaps:
        """Scores and descriptors.

        Args:
            images: ``(B, 3, H, W)`` RGB in [0, 1], turned to grey, or ``(B, channels, H, W)``
                as the network was trained with. Any H and W.
        """
        height, width = images.shape[-2:]
        padding = (0, -width % CELL, 0, -height % CELL)
        x = F.pad(self._as_trained(images), padding, mode="replicate")
        for number, stage in enumerate(self.backbone):
            x = stage(F.max_pool2d(x, 2) if number else x)
        probabilities = self.detector(x).softmax(dim=1)[:, :-1]
        scores = F.pixel_shuffle(probabilities, CELL)[..., :height, :width]
        return SuperPointMaps(scores, F.normalize(self.descriptor(x), dim=1))

    def _as_trained(self, images: Tensor) -> Tensor:
        if images.shape[1] == self.channels != 3:
            return images
        if images.shape[1] != 3:
            raise ValueError(f"images must have 3 or {self.channels} channels: {images.shape}")
        # One by one: a tensor of the shares would be copied to the device and waited for.
        channels = zip(images.unbind(dim=1), GREY, strict=True)
        red, green, blue = (share * channel for channel, share in channels)
        return (red + green + blue).unsqueeze(1).expand(-1, self.channels, -1, -1)


def load_superpoint(file: Path) -> SuperPoint:
    """SuperPoint with a file's weights, in evaluation mode.

    The layout and the number of input channels are read from the file.

    Raises:
        UserError: the file cannot be read, or a weight is missing; names the first one.
    """
    state = read_state(file)
    if any(name.startswith("conv1a.") for name in state):
        state, batch_norm, first = _renamed(state, file), False, "conv1a.weight"
    else:
        batch_norm, first = True, "backbone.0.0.conv.weight"
    stem = state.get("backbone.0.0.conv.weight")
    if stem is None:
        raise UserError(
            f"not weights of SuperPoint (no {first})", file, "name a file with SuperPoint's weights"
        )
    network = SuperPoint(stem.shape[1] if stem.ndim == 4 else 1, batch_norm=batch_norm)
    fill(network, state, file, what="SuperPoint")
    return network.eval().requires_grad_(False)


def _renamed(state: Mapping[str, Tensor], file: Path) -> dict[str, Tensor]:
    """Weights of the original layout under the names of the open one."""
    renamed = {}
    for old, new in _ORIGINAL.items():
        for kind in ("weight", "bias"):
            if old + kind not in state:
                raise UserError(
                    f"not weights of SuperPoint (no {old}{kind})",
                    file,
                    "name a file with SuperPoint's weights",
                )
            renamed[new + kind] = state[old + kind]
    return renamed
