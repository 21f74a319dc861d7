"""The trunk of EfficientNet-Lite0, with taps at 1/2 to 1/16: the encoder of `deltas-small`.

Source: Tan and Le, EfficientNet (2019); the Lite variant has no squeeze-and-excitation and
uses ReLU6, so that it is fast and quantisable on CPUs. Module names are those of the public
Apache-2.0 checkpoint, so that its file loads as it is.
"""

import torch.nn.functional as F
from torch import Tensor, nn

from deltas_nets.network.conv_norm import SameConv, conv_norm
from deltas_nets.network.encoder import Origin
from deltas_nets.network.features import Channels
from deltas_nets.network.lite.encoder import LiteEncoder

# Expansion, kernel, stride, channels, repeats of the stages up to 1/16.
_STAGES = (
    (1, 3, 1, 16, 1),
    (6, 3, 2, 24, 2),
    (6, 5, 2, 40, 2),
    (6, 3, 2, 80, 3),
    (6, 5, 1, 112, 3),
)
_TAPS = (0, 2, 4, 10)  # the last block at each stride


def _relu6(x: Tensor) -> Tensor:
    return F.relu6(x, inplace=True)


def _batch_norm(channels: int) -> nn.BatchNorm2d:
    return nn.BatchNorm2d(channels, eps=1e-3, momentum=0.01)


class _InvertedResidual(nn.Module):
    def __init__(self, inputs: int, outputs: int, expand: int, kernel: int, stride: int) -> None:
        super().__init__()
        width = inputs * expand
        self.expands = expand != 1
        self.residual = stride == 1 and inputs == outputs
        if self.expands:
            self._expand_conv = SameConv(inputs, width, 1, bias=False)
            self._bn0 = _batch_norm(width)
        self._depthwise_conv = SameConv(width, width, kernel, stride, groups=width, bias=False)
        self._bn1 = _batch_norm(width)
        self._project_conv = SameConv(width, outputs, 1, bias=False)
        self._bn2 = _batch_norm(outputs)

    def forward(self, x: Tensor) -> Tensor:
        y = _relu6(conv_norm(x, self._expand_conv, self._bn0)) if self.expands else x
        y = _relu6(conv_norm(y, self._depthwise_conv, self._bn1))
        y = conv_norm(y, self._project_conv, self._bn2)
        output: Tensor = x + y if self.residual else y
        return output


class EfficientNetLite0(LiteEncoder):
    """EfficientNet-Lite0 up to 1/16."""

    channels = Channels(fine=16, half=16, quarter=24, eighth=40, sixteenth=112)
    origin = Origin(
        "EfficientNet-Lite0",
        "Apache-2.0",
        "the file efficientnet-lite0-57934424.pth or one with its keys",
    )

    def __init__(self) -> None:
        super().__init__()
        self._conv_stem = SameConv(3, 32, 3, 2, bias=False)
        self._bn0 = _batch_norm(32)
        blocks: list[nn.Module] = []
        channels = 32
        for expand, kernel, stride, outputs, repeats in _STAGES:
            for repeat in range(repeats):
                step = stride if repeat == 0 else 1
                blocks.append(_InvertedResidual(channels, outputs, expand, kernel, step))
                channels = outputs
        self._blocks = nn.ModuleList(blocks)
        self.fine = self.fine_branch()

    def taps(self, images: Tensor) -> list[Tensor]:
        """The last map at each stride."""
        # The mean and range that the pretrained weights were trained with.
        x = _relu6(conv_norm((images - 0.498) / 0.502, self._conv_stem, self._bn0))
        taps = []
        for number, block in enumerate(self._blocks):
            x = block(x)
            if number in _TAPS:
                taps.append(x)
        return taps
