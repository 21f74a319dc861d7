"""COLMAP's sparse points as depth maps: interpolated, and through our densifier."""

import numpy as np
import torch
from numpy.typing import NDArray

from deltas_geom.cameras.pixels import resize_pixels
from deltas_nets.baselines.colmap_points import colmap, sparse_points
from deltas_nets.baselines.densified import densified, densifier_record
from deltas_nets.baselines.named import Named
from deltas_nets.predict.depth_map import DepthMap, Wanted, point_cloud
from deltas_nets.predict.encoded_frames import EncodedFrames
from deltas_nets.predict.ours import work_size_of
from deltas_nets.weights_file import load_model


class SparseInterpolated(Named):
    """COLMAP's points, linear in inverse depth between them and the nearest beyond them.

    Args:
        device: of no meaning here: all is done by the processor.

    Raises:
        UserError: pycolmap is not installed.
    """

    name = "colmap-sparse"

    def __init__(self, device: str | torch.device = "cpu") -> None:
        colmap()

    def depth_map(self, wanted: Wanted) -> DepthMap:
        """Depth of the first frame from all of them; 0 everywhere where COLMAP finds no point."""
        self.refuse_measured(wanted)
        found, size = sparse_points(wanted.frames, wanted.config.depth_range), wanted.size
        pixels = resize_pixels(found.pixels, old_size=found.image_size, new_size=size)
        depth = interpolated(pixels.double().numpy(), found.depth.double().numpy(), size)
        work_size = work_size_of(wanted.anchor, wanted.config)
        points, colors = point_cloud(wanted.anchor, depth, size, work_size)
        return DepthMap(depth, None, points, colors, found)


class SparseDensified(Named):
    """COLMAP's points through the densifier of `deltas-small`.

    Args:
        device: of the densifier.

    Raises:
        UserError: pycolmap is not installed.
    """

    name = "colmap-densified"

    def __init__(self, device: str | torch.device = "cpu") -> None:
        colmap()
        self.encode = EncodedFrames(load_model(device=device))

    def depth_map(self, wanted: Wanted) -> DepthMap:
        """Depth of the first frame; the others give points."""
        self.refuse_measured(wanted)
        found = sparse_points(wanted.frames, wanted.config.depth_range)
        return densified(self.encode, wanted, found)

    def weights_record(self, name_or_file: str) -> dict[str, str]:
        """Of the densifier."""
        return densifier_record(name_or_file)


def interpolated(
    pixels: NDArray[np.float64], depth: NDArray[np.float64], size: tuple[int, int]
) -> NDArray[np.float32]:
    """Scattered depth as a map: inverse depth is linear in the triangles between points.

    Args:
        pixels: ``(N, 2)``.
        depth: ``(N,)`` metres, positive.
        size: (height, width) of the map.

    Returns:
        ``(H, W)``; outside of all triangles that of the nearest point, 0 if there is none.

    Example:
        >>> corners = np.array([[0.0, 0], [2, 0], [0, 2], [2, 2]])
        >>> 1 / interpolated(corners, np.array([1.0, 0.5, 1.0, 0.5]), (1, 3))
        array([[1. , 1.5, 2. ]], dtype=float32)
    """
    from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator
    from scipy.spatial import QhullError

    if len(depth) == 0:
        return np.zeros(size, np.float32)
    rows, columns = np.mgrid[: size[0], : size[1]]
    places = np.stack([columns, rows], axis=-1)
    inverse = NearestNDInterpolator(pixels, 1 / depth)(places)
    try:
        linear = LinearNDInterpolator(pixels, 1 / depth)(places)
    except QhullError:  # fewer than three points, or all on a line
        linear = np.full(size, np.nan)
    dense: NDArray[np.float32] = (1 / np.where(np.isnan(linear), inverse, linear)).astype(
        np.float32
    )
    return dense
