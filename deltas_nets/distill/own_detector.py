"""A detector of ours as a teacher, of itself or of another network.

What it finds from many sides is steadier than what it finds from one, so a detector learns from
its own points, looked at anew: the second round of SuperPoint's training (section 5).
"""

from pathlib import Path

from torch import Tensor, nn

from deltas_nets.network.lite.detector import detector_heatmap
from deltas_nets.weights_file import load_model


class OwnScores(nn.Module):
    """The heatmap of a network of ours."""

    def __init__(self, encoder: nn.Module, detector: nn.Module) -> None:
        super().__init__()
        self.encoder = encoder
        self.detector = detector

    def forward(self, images: Tensor) -> Tensor:
        """Score map ``(B, 1, H, W)`` of RGB images ``(B, 3, H, W)`` in [0, 1]."""
        size = (images.shape[-2], images.shape[-1])
        features = self.encoder(images[:, None])
        return detector_heatmap(self.detector(features, image_size=size).logits, image_size=size)


def load_own(file: Path) -> nn.Module:
    """The detector of a shipped network or of a weights file of ours.

    Raises:
        UserError: the file is missing or holds something else.
    """
    model = load_model(file)
    return OwnScores(model.encoder, model.detector).eval()
