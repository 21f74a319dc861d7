"""Which true pixels a map is scored at: its own, or those of the sensor."""

from typing import Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from deltas_geom.cameras.pixels import resize_intrinsics
from deltas_nets.captures.frame import Frame
from deltas_nets.captures.work_size import sensor_at_image
from deltas_nets.evaluate.scores import resize_nearest

__all__ = ["Truth", "TruthSize"]

TruthSize = Literal["map", "own"]
Map = NDArray[np.float32]


class Truth(NamedTuple):
    """The sensor depth of a frame, and how maps are brought to it.

    Attributes:
        at_image: ``(H, W)`` metres on the grid of the colour image, 0 where unknown.
        own: ``(h, w)`` metres as the sensor has it.
        rows: ``(h,)`` where its rows are in the image, as a share of its height.
        columns: ``(w,)`` where its columns are, as a share of its width.
        size: which pixels count: "map" resizes the truth to the map, each pixel of the map takes
            the nearest true one; "own" leaves the truth, each true pixel takes the nearest one of
            the map, so that maps of any size are scored at the same pixels.
    """

    at_image: Map
    own: Map
    rows: NDArray[np.float64]
    columns: NDArray[np.float64]
    size: TruthSize

    @classmethod
    def of(cls, frame: Frame, size: TruthSize) -> "Truth":
        """Read the depth of a frame once.

        Raises:
            UserError: it has none, or it cannot be read.
        """
        own = frame.read_depth()
        height, width = own.shape
        K = torch.from_numpy(frame.K.copy())
        seen = resize_intrinsics(K, old_size=frame.image_size, new_size=(height, width)).numpy()
        depth_K = seen if frame.depth_K is None else frame.depth_K
        rows = _places(frame.K[1], depth_K[1], 1, height, frame.image_size[0])
        columns = _places(frame.K[0], depth_K[0], 0, width, frame.image_size[1])
        return cls(sensor_at_image(frame, own), own, rows, columns, size)

    def beside(self, *maps: Map) -> tuple[Map, ...]:
        """The truth, then the maps ``(H, W)`` of one size, all at the pixels that count."""
        if self.size == "map":
            return resize_nearest(self.at_image, (maps[0].shape[0], maps[0].shape[1])), *maps
        return self.own, *(self._read(each) for each in maps)

    def _read(self, image: Map) -> Map:
        """The pixel of a map that each true one lies in; 0 where the map does not reach."""
        height, width = image.shape
        row = np.floor(self.rows * height).astype(int)
        column = np.floor(self.columns * width).astype(int)
        inside = ((row >= 0) & (row < height))[:, None] & ((column >= 0) & (column < width))
        found = image[row.clip(0, height - 1)[:, None], column.clip(0, width - 1)]
        return np.where(inside, found, np.float32(0))


def _places(
    image_row: NDArray[np.float64], depth_row: NDArray[np.float64], axis: int, count: int, side: int
) -> NDArray[np.float64]:
    """Where the depth image's pixels are along an axis, from 0 to 1 across the image."""
    across = (np.arange(count) - depth_row[2]) / depth_row[axis] * image_row[axis] + image_row[2]
    place: NDArray[np.float64] = (across + 0.5) / side
    return place
