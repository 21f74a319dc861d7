"""Scenes of the image plane, without cameras: maps read, scores averaged, depths drawn."""

from typing import NamedTuple

from torch import Tensor


class MapScene(NamedTuple):
    """A feature map, and where it is read.

    Attributes:
        feature_map: ``(D, h, w)``, the image plane in cells of a whole number of pixels.
        pixels: ``(N, 2)`` of the image, which may be beyond the centres of the outer cells.
        descriptors: ``(N, D)``, to be multiplied with what is read.
        image_size: (height, width) of the image.
    """

    feature_map: Tensor
    pixels: Tensor
    descriptors: Tensor
    image_size: tuple[int, int]

    def sketch(self) -> str:
        """One line: what one has to draw."""
        size = "x".join(map(str, self.feature_map.shape))
        first = ", ".join(f"{value:.7g}" for value in self.pixels[0].tolist())
        return f"map {size} of an image {self.image_size}, read at ({first}) px first"


class ScoreScene(NamedTuple):
    """Scores of places: on the grid of an image, and of places anywhere.

    Attributes:
        logits: ``(h, w)``.
        positions: ``(h w, D)``, in raster order of the logits, in any unit.
        mask: ``(h, w)`` bool, True = possible, at least one.
    """

    logits: Tensor
    positions: Tensor
    mask: Tensor

    def sketch(self) -> str:
        """One line: what one has to draw."""
        row = ", ".join(f"{value:.4g}" for value in self.logits[0].tolist())
        return f"logits {tuple(self.logits.shape)}, the first row ({row})"


class DepthScene(NamedTuple):
    """Pixels with a depth, in and around a small image.

    Attributes:
        pixels: ``(N, 2)``.
        depth: ``(N)`` metres, all different.
        weights: ``(N)`` positive.
        image_size: (height, width).
    """

    pixels: Tensor
    depth: Tensor
    weights: Tensor
    image_size: tuple[int, int]

    def sketch(self) -> str:
        """One line: what one has to draw."""
        points = ", ".join(
            f"({x:.4g}, {y:.4g}) {depth:.4g} m"
            for (x, y), depth in zip(self.pixels.tolist(), self.depth.tolist(), strict=True)
        )
        return f"image {self.image_size}, points at {points}"
