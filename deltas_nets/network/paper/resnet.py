"""ResNet-50, the paper's image encoder; a quarter as wide it encodes the sparse depth.

Source: He et al., Deep residual learning (2016), with the stride on the 3x3 convolution of a
bottleneck. Module names are the common ones of public ResNet checkpoints, without the
classifier, so that published weights load as they are.
"""

import torch.nn.functional as F
from torch import Tensor, nn

from deltas_nets.network.encoder import Origin
from deltas_nets.network.paper.taps import Backbone, Taps, initialise_convolutions

_EXPANSION = 4
_BLOCKS = (3, 4, 6, 3)


class ResNet50(Backbone):
    """Stem and four stages of bottlenecks.

    Args:
        inputs: channels of the image: 3, or 1 for sparse depth.
        width: channels of the stem and inner channels of the first stage: 64, or 16 for
            sparse depth.

    Example:
        >>> ResNet50().channels
        (64, 256, 512, 1024, 2048)
    """

    origin = Origin(
        "ResNet-50", "licence of the file's authors", "a ResNet-50 file with the common key names"
    )

    def __init__(self, inputs: int = 3, width: int = 64) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, width, 7, 2, 3, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.maxpool = nn.MaxPool2d(3, 2, 1)
        inner = [width * 2**stage for stage in range(4)]
        first, second, third, fourth = (_EXPANSION * channels for channels in inner)
        self.layer1 = _stage(width, inner[0], _BLOCKS[0], stride=1)
        self.layer2 = _stage(first, inner[1], _BLOCKS[1], stride=2)
        self.layer3 = _stage(second, inner[2], _BLOCKS[2], stride=2)
        self.layer4 = _stage(third, inner[3], _BLOCKS[3], stride=2)
        self.channels = (width, first, second, third, fourth)
        initialise_convolutions(self)

    def forward(self, images: Tensor) -> Taps:
        """Encode ``(B, inputs, H, W)``."""
        half = F.relu(self.bn1(self.conv1(images)), inplace=True)
        quarter = self.layer1(self.maxpool(half))
        eighth = self.layer2(quarter)
        sixteenth = self.layer3(eighth)
        return Taps(half, quarter, eighth, sixteenth, self.layer4(sixteenth))


class _Bottleneck(nn.Module):
    """1x1, 3x3 and 1x1 convolutions beside a shortcut."""

    def __init__(self, inputs: int, inner: int, stride: int, shortcut: nn.Module) -> None:
        super().__init__()
        outputs = _EXPANSION * inner
        self.conv1 = nn.Conv2d(inputs, inner, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(inner)
        self.conv2 = nn.Conv2d(inner, inner, 3, stride, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(inner)
        self.conv3 = nn.Conv2d(inner, outputs, 1, bias=False)
        self.bn3 = nn.BatchNorm2d(outputs)
        self.downsample = shortcut

    def forward(self, x: Tensor) -> Tensor:
        y = F.relu(self.bn1(self.conv1(x)), inplace=True)
        y = F.relu(self.bn2(self.conv2(y)), inplace=True)
        return F.relu(self.bn3(self.conv3(y)) + self.downsample(x), inplace=True)


def _stage(inputs: int, inner: int, blocks: int, *, stride: int) -> nn.Sequential:
    outputs = _EXPANSION * inner
    projection = nn.Sequential(
        nn.Conv2d(inputs, outputs, 1, stride, bias=False), nn.BatchNorm2d(outputs)
    )
    first = _Bottleneck(inputs, inner, stride, projection)
    others = (_Bottleneck(outputs, inner, 1, nn.Identity()) for _ in range(blocks - 1))
    return nn.Sequential(first, *others)
