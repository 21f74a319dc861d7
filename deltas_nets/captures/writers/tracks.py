"""The tracks of points, as COLMAP lists them: by image, and again by point."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from deltas_nets.captures.colmap_model import ColmapModel

__all__ = ["TrackTables", "track_tables"]


class TrackTables(NamedTuple):
    """Where each image's and each point's part of the tracks begins and ends.

    Attributes:
        of_image: ``(I + 1,)``; image i has the tracks from entry i up to entry i + 1.
        of_point: ``(P + 1,)``, into the next.
        elements: ``(T, 2)`` id of the image and number of the pixel there, by point.
    """

    of_image: NDArray[np.int64]
    of_point: NDArray[np.int64]
    elements: NDArray[np.int64]


def track_tables(model: ColmapModel) -> TrackTables:
    """The tables of a model."""
    tracks = model.tracks
    num_images, num_points = len(model.images.ids), len(model.points.ids)
    of_image = np.searchsorted(tracks.image, np.arange(num_images + 1))
    number = np.arange(len(tracks.image)) - of_image[tracks.image]
    point = np.searchsorted(model.points.ids, tracks.point_ids)
    order = np.argsort(point, kind="stable")
    of_point = np.searchsorted(point[order], np.arange(num_points + 1))
    elements = np.stack([model.images.ids[tracks.image], number], axis=-1)[order]
    return TrackTables(of_image, of_point, elements)
