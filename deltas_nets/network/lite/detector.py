"""Interest points of the anchor: detected ones and evenly spread ones.

Source: DeTone et al., SuperPoint (2018): 65 channels at 1/8, one for each pixel of the 8 x 8
cell and one for "none"; the paper, section 3.1, for the mixture.
"""

import torch
import torch.nn.functional as F
from kornia.geometry.subpix import nms2d
from torch import Tensor, nn

from deltas_geom.numerics.arithmetic import at_least_single
from deltas_geom.records import Record
from deltas_nets.config import DetectorConfig
from deltas_nets.network.features import Channels, Features
from deltas_nets.network.layers import ConvBlock, upsample_like, zero_initialised

CELL = 8
"""Side of a detector cell, pixels."""


class Keypoints(Record):
    """Interest points of the anchor.

    Attributes:
        pixels: ``(*B, N, 2)``.
        scores: ``(*B, N)`` probability of the detection; 0 for points that were spread.
        logits: ``(*B, 65, H/8, W/8)`` what the detector is trained by.
    """

    pixels: Tensor
    scores: Tensor
    logits: Tensor


class FineLogits(nn.Module):
    """Where in its cell a point is, seen at half the image's resolution.

    A feature at 1/8 has to name one of 64 pixels; here every pixel is judged by the same
    convolutions, so what is learned at one place holds at all. Starts as no correction.
    """

    def __init__(self, inputs: int, width: int) -> None:
        super().__init__()
        self.convs = nn.Sequential(
            ConvBlock(inputs, width),
            ConvBlock(width, width),
            ConvBlock(width, width),
            zero_initialised(nn.Conv2d(width, 4, 1)),
        )

    def forward(self, fine: Tensor, *, like: Tensor) -> Tensor:
        """Corrections of the 65 logits; "none" has 0.

        Args:
            fine: ``(B, inputs, ceil(H/2), ceil(W/2))``.
            like: ``(B, 65, h, w)`` the logits.
        """
        pixels = F.pixel_shuffle(at_least_single(self.convs(fine)), 2)
        rows, columns = CELL * like.shape[-2], CELL * like.shape[-1]
        missing = (0, columns - pixels.shape[-1], 0, rows - pixels.shape[-2])
        cells = F.pixel_unshuffle(F.pad(pixels, missing), CELL)
        return F.pad(cells, (0, 0, 0, 0, 0, 1))


class Detector(nn.Module):
    """Head on the anchor's features, and the choice of N points.

    Args:
        config: how many, how strong and how far apart.
        channels: of the features.
    """

    def __init__(self, config: DetectorConfig, channels: Channels) -> None:
        super().__init__()
        self.config = config
        self.coarse = ConvBlock(channels.sixteenth, 48, kernel=1)
        self.head = nn.Sequential(
            ConvBlock(48 + channels.eighth, 64), nn.Conv2d(64, CELL * CELL + 1, 1)
        )
        width = config.fine_width
        self.fine = FineLogits(channels.fine, width) if width else None

    def forward(
        self,
        features: Features,
        *,
        image_size: tuple[int, int],
        num_keypoints: int | None = None,
        shift: Tensor | None = None,
    ) -> Keypoints:
        """Interest points of the anchor.

        Args:
            features: of all views; only view 0 is looked at.
            image_size: (height, width).
            num_keypoints: instead of the config's.
            shift: ``(B, 2)`` in [0, 1): moves the spread points, for variety in training.
        """
        anchor = features.of_anchor()
        coarse = upsample_like(self.coarse(anchor.sixteenth), anchor.eighth)
        logits = at_least_single(self.head(torch.cat([coarse, anchor.eighth], dim=1)))
        if self.fine is not None:
            logits = logits + self.fine(anchor.fine, like=logits)
        return choose_keypoints(
            logits, self.config, image_size=image_size, num_keypoints=num_keypoints, shift=shift
        )


def choose_keypoints(
    logits: Tensor,
    config: DetectorConfig,
    *,
    image_size: tuple[int, int],
    num_keypoints: int | None = None,
    shift: Tensor | None = None,
) -> Keypoints:
    """The best detections, and evenly spread points for the rest.

    Args:
        logits: ``(B, 65, h, w)`` of the 8 x 8 cells.
        config: how many, how strong and how far apart.
        image_size: (height, width).
        num_keypoints: instead of the config's.
        shift: ``(B, 2)`` in [0, 1): moves the spread points.
    """
    count = num_keypoints or config.num_keypoints
    device, (height, width) = logits.device, image_size
    # CUDA has read so small a table when the call returns, and is not waited for; other devices
    # may read it later.
    spread = spread_points(count, image_size=image_size)
    dtype = torch.promote_types(logits.dtype, torch.float32)  # halves do not know every pixel
    spread = spread.to(device, dtype, non_blocking=device.type == "cuda")
    if shift is None:
        shift = torch.zeros(len(logits), 2, device=device)
    # Not torch.tensor, which copies numbers of the host to the device and waits for them.
    size = torch.linspace(width, height, 2, device=device, dtype=dtype)
    pixels = (spread + (shift[:, None] * size).floor()).remainder(size)
    heatmap = detector_heatmap(logits.detach().to(dtype), image_size=image_size)
    best, scores = _best(heatmap, config, count)
    detected = scores > config.threshold
    pixels[:, : best.shape[1]] = torch.where(detected[..., None], best, pixels[:, : best.shape[1]])
    padded = F.pad(torch.where(detected, scores, 0.0), (0, count - scores.shape[1]))
    return Keypoints(pixels, padded, logits)


def _best(heatmap: Tensor, config: DetectorConfig, count: int) -> tuple[Tensor, Tensor]:
    """The strongest local maxima ``(B, n, 2)`` and their probabilities ``(B, n)``."""
    border, window = config.border, 2 * config.nms_radius + 1
    peaks = nms2d(heatmap, (window, window))[:, 0]
    inner = torch.zeros_like(peaks)
    height, width = heatmap.shape[-2:]
    rows, columns = slice(border, height - border), slice(border, width - border)
    inner[:, rows, columns] = peaks[:, rows, columns]
    wanted = min(int(count * config.detected_share), inner[0].numel())
    scores, index = inner.flatten(1).topk(wanted, dim=1)
    row = index.div(width, rounding_mode="floor")
    return torch.stack([index % width, row], dim=-1).to(heatmap.dtype), scores


def detector_heatmap(logits: Tensor, *, image_size: tuple[int, int]) -> Tensor:
    """Probability of an interest point at every pixel, ``(B, 1, H, W)``.

    Args:
        logits: ``(B, 65, ceil(H/8), ceil(W/8))``; the last channel is "none".
        image_size: (height, width).
    """
    heatmap = F.pixel_shuffle(logits.softmax(dim=1)[:, :-1], CELL)
    return heatmap[..., : image_size[0], : image_size[1]]


def spread_points(count: int, *, image_size: tuple[int, int]) -> Tensor:
    """Evenly spread pixels ``(count, 2)``, whole numbers, the same every time.

    Every prefix of the sequence is spread evenly, so any part of it can be replaced.

    Source: Roberts, The unreasonable effectiveness of quasirandom sequences (2018): R2.
    """
    plastic = 1.32471795724474602596
    steps = torch.tensor([1 / plastic, 1 / plastic**2], dtype=torch.float64)
    unit = (0.5 + torch.arange(1, count + 1, dtype=torch.float64)[:, None] * steps) % 1
    size = torch.tensor(image_size[::-1], dtype=torch.float64)
    return (unit * size).floor().float()
