"""What is there to see in three dimensions: layers of surfaces, and cameras."""

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.frame import FloatArray, Frame
from deltas_nets.captures.rigid import rigid_inverse
from deltas_nets.captures.spread import spread
from deltas_nets.captures.straight import lens_of
from deltas_nets.page.maps import Maps, fused_in
from deltas_nets.page.surfaces import Surface, read_surface, thinned

__all__ = [
    "Camera",
    "Layer",
    "SurePoints",
    "camera_of",
    "fused_layers",
    "layers_of",
    "points_of_maps",
    "sparse_layer",
]

MOST_POINTS, MOST_FACES = 200_000, 200_000
"""Of a page: 9 bytes a point and 15 a face, a third more in base64."""
SURE = 0.5
"""Confidence from which points of maps are shown."""
MAPS_OF_CLOUD, POINTS_OF_CLOUD = 120, 1_200_000
"""At most so many maps are read for their points, and so many points of all of them."""


class Layer(NamedTuple):
    """Something to see, which can be switched on and off.

    Attributes:
        name: for the switch.
        surface: points or a mesh.
    """

    name: str
    surface: Surface


class Camera(NamedTuple):
    """Where a frame was taken.

    Attributes:
        id: of the frame.
        world_from_cam: ``(4, 4)`` rigid, OpenCV axes.
        slopes: left, top, right, bottom of the image on the plane z = 1.
    """

    id: str
    world_from_cam: FloatArray
    slopes: tuple[float, float, float, float]


def camera_of(frame: Frame) -> Camera:
    """The camera of a frame; a lens is taken for a pinhole, whose outline is straight."""
    height, width = frame.image_size
    corners = np.array([[-0.5, width - 0.5], [-0.5, height - 0.5], [1, 1]])
    (left, right), (top, bottom), _ = np.linalg.solve(frame.K, corners).tolist()
    return Camera(frame.id, rigid_inverse(frame.cam_from_world), (left, top, right, bottom))


def layers_of(maps: Maps) -> list[Layer]:
    """The mesh and the cloud of `deltas fuse`, else the points of the maps together.

    Raises:
        UserError: a file cannot be read.
    """
    found = fused_layers(maps, most_points=MOST_POINTS, most_faces=MOST_FACES)
    if found:
        return found
    points = points_of_maps(maps)
    sure = points.confidence >= SURE
    surface = Surface(points.surface.xyz[sure], points.surface.rgb[sure])
    return [Layer("points of the maps", thinned(surface, MOST_POINTS))] if sure.any() else []


def fused_layers(maps: Maps, *, most_points: int, most_faces: int) -> list[Layer]:
    """The mesh and the cloud of `deltas fuse`, those that are there.

    Raises:
        UserError: a file cannot be read.
    """
    found = []
    for file in fused_in(maps.fused):
        surface = read_surface(file)
        most = most_points if surface.faces is None else most_faces
        found.append(Layer(file.stem, thinned(surface, most)))
    return [layer for layer in found if len(layer.surface.xyz)]


def sparse_layer(capture: Capture, *, most_points: int) -> Layer | None:
    """The points that the capture's own program triangulated; None where there are none."""
    if capture.points is None or not len(capture.points.xyz):
        return None
    surface = Surface(capture.points.xyz, capture.points.rgb)
    return Layer("sparse points of the capture", thinned(surface, most_points))


class SurePoints(NamedTuple):
    """Points, and how sure each is.

    Attributes:
        surface: N points.
        confidence: ``(N,)`` in [0, 1]; 1 where the network stated none.
    """

    surface: Surface
    confidence: NDArray[np.float32]


def points_of_maps(maps: Maps) -> SurePoints:
    """Some of the points of some of the maps, evenly spread.

    Raises:
        UserError: a file cannot be read.
    """
    xyz, rgb = [np.zeros((0, 3))], [np.zeros((0, 3), np.uint8)]
    confidence = [np.zeros(0, np.float32)]
    read_ids = spread(maps.ids, MAPS_OF_CLOUD)
    of_each = POINTS_OF_CLOUD // len(read_ids)
    for id in read_ids:
        read = maps.points(id)
        if read is None:
            continue
        points, colors = read
        # Copies: a slice would keep all of a file's points in memory.
        some = slice(None, None, -(-len(points) // of_each) or 1)
        xyz.append(points[some].copy())
        rgb.append(colors[some].copy())
        confidence.append(_confidence_at(xyz[-1], maps, id))
    return SurePoints(Surface(np.concatenate(xyz), np.concatenate(rgb)), np.concatenate(confidence))


def _confidence_at(points: NDArray[np.float64], maps: Maps, id: str) -> NDArray[np.float32]:
    """``(N,)`` of the pixels of a map that points lie on; 1 where the network stated none."""
    confidence = maps.confidence(id)
    if confidence is None or not len(points):
        return np.ones(len(points), np.float32)
    frame = maps.capture.frame(id)
    local = points @ frame.cam_from_world[:3, :3].T + frame.cam_from_world[:3, 3]
    share = np.divide(confidence.shape, frame.image_size)[::-1]
    seen = lens_of(frame).project(torch.from_numpy(local)).pixels.numpy()
    pixels = (seen + 0.5) * share - 0.5
    limits = np.array(confidence.shape)[::-1] - 1
    column, row = np.rint(pixels).clip(0, limits).astype(int).T
    there: NDArray[np.float32] = confidence[row, column]
    return there
