"""VGG-9, the light backbone of the paper's supplement.

The supplement says of it only that it has nine layers "similar to that of SuperPoint" and that
the whole network then takes 16.9 GMACs. What is chosen here: the first six convolutions are
SuperPoint's, in pairs at full, half and quarter resolution, with 64, 64 and 128 channels, since
there the points are localised. The other three go on alone, with 256 channels, at 1/8, 1/16 and
1/32, which SuperPoint does not have but the heads and the densifier read. Batch norm follows
every convolution.

Around it the network is narrower: a quarter-width VGG-9 for the sparse depth, heads half as wide
(128) and a decoder of widths 96, 64, 32, 16, 8. That is 16.88 GMACs of convolutions for two images
of 240 x 320 if both heads run on both, as the paper counts, and 16.90 with the correlation
of 512 points; 12.0 of them are the backbone's.

Source: the paper's supplement, section 1, table "different architectures"; DeTone et al.,
SuperPoint (2018).
"""

import torch.nn.functional as F
from torch import Tensor, nn

from deltas_nets.network.encoder import Origin
from deltas_nets.network.paper.taps import Backbone, Taps, initialise_convolutions


class VGG9(Backbone):
    """Nine 3x3 convolutions with batch norm and ReLU, max-pooled by 2 five times.

    Args:
        inputs: channels of the image: 3, or 1 for sparse depth.
        width: channels of the first convolution: 64, or 16 for sparse depth.
    """

    origin = Origin("VGG-9", "licence of the file's authors", "a file with the names of our VGG-9")

    def __init__(self, inputs: int = 3, width: int = 64) -> None:
        super().__init__()
        self.conv1a = _Convolution(inputs, width)
        self.conv1b = _Convolution(width, width)
        self.conv2a = _Convolution(width, width)
        self.conv2b = _Convolution(width, width)
        self.conv3a = _Convolution(width, 2 * width)
        self.conv3b = _Convolution(2 * width, 2 * width)
        self.conv4 = _Convolution(2 * width, 4 * width)
        self.conv5 = _Convolution(4 * width, 4 * width)
        self.conv6 = _Convolution(4 * width, 4 * width)
        self.channels = (width, 2 * width, 4 * width, 4 * width, 4 * width)
        initialise_convolutions(self)

    def forward(self, images: Tensor) -> Taps:
        """Encode ``(B, inputs, H, W)``."""
        full = self.conv1b(self.conv1a(images))
        half = self.conv2b(self.conv2a(_pooled(full)))
        quarter = self.conv3b(self.conv3a(_pooled(half)))
        eighth = self.conv4(_pooled(quarter))
        sixteenth = self.conv5(_pooled(eighth))
        return Taps(half, quarter, eighth, sixteenth, self.conv6(_pooled(sixteenth)))


class _Convolution(nn.Sequential):
    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(
            nn.Conv2d(inputs, outputs, 3, padding=1, bias=False),
            nn.BatchNorm2d(outputs),
            nn.ReLU(inplace=True),
        )


def _pooled(x: Tensor) -> Tensor:
    # Rounded up, as the strided convolutions of a ResNet do: nothing of the image is lost.
    return F.max_pool2d(x, 2, ceil_mode=True)
