"""Images, where they were taken from, and how far away what they show is."""

from collections.abc import Callable
from typing import NamedTuple

from torch import Tensor

from deltas_geom.cameras.views import PosedViews


class PosedImages(NamedTuple):
    """Some views of one scene, the item that every data set hands to training."""

    images: Tensor
    """``(*B, V, 3, H, W)`` RGB, float32 in [0, 1], or uint8 as kept in a cache."""
    views: PosedViews
    """Cameras of the images: K ``(*B, V, 3, 3)``, cam_from_world ``(*B, V, 4, 4)``."""
    depth: Tensor
    """``(*B, V, H, W)`` metres along z at the pixel centres; 0 where unknown."""

    def tensors(self) -> list[Tensor]:
        """Images, K, cam_from_world and depth."""
        return [self.images, *self.views, self.depth]

    def map(self, change: Callable[[Tensor], Tensor]) -> "PosedImages":
        """The same with every tensor changed by one function."""
        return PosedImages(
            change(self.images), PosedViews(*map(change, self.views)), change(self.depth)
        )
