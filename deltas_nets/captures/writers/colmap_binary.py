"""COLMAP's binary files, as its versions before rigs wrote them and all later ones read."""

import struct
from pathlib import Path

import numpy as np

from deltas_nets.captures.colmap_model import CAMERA_MODELS, ColmapModel
from deltas_nets.captures.readers.colmap_binary import CAMERA, COUNT, HEAD, POINT, TRACKED
from deltas_nets.captures.writers.tracks import TrackTables, track_tables

__all__ = ["write_binary_model"]


def write_binary_model(model: ColmapModel, folder: Path) -> None:
    """Write cameras.bin, images.bin and points3D.bin."""
    tables = track_tables(model)
    _write_cameras(model, folder / "cameras.bin")
    _write_images(model, tables, folder / "images.bin")
    _write_points(model, tables, folder / "points3D.bin")


def _write_cameras(model: ColmapModel, path: Path) -> None:
    with path.open("wb") as file:
        file.write(COUNT.pack(len(model.cameras)))
        for id, camera in model.cameras.items():
            height, width = camera.image_size
            file.write(CAMERA.pack(id, CAMERA_MODELS[camera.model].id, width, height))
            file.write(struct.pack(f"<{len(camera.params)}d", *camera.params))


def _write_images(model: ColmapModel, tables: TrackTables, path: Path) -> None:
    images, tracks = model.images, model.tracks
    with path.open("wb") as file:
        file.write(COUNT.pack(len(images.ids)))
        for index, name in enumerate(images.names):
            part = slice(tables.of_image[index], tables.of_image[index + 1])
            pose = [*images.quaternions[index], *images.translations[index]]
            file.write(HEAD.pack(images.ids[index], *pose, images.camera_ids[index]))
            file.write(name.encode() + b"\0" + COUNT.pack(part.stop - part.start))
            pixels = np.empty(part.stop - part.start, TRACKED)
            pixels["pixel"], pixels["point"] = tracks.pixels[part], tracks.point_ids[part]
            file.write(pixels.tobytes())


def _write_points(model: ColmapModel, tables: TrackTables, path: Path) -> None:
    points = model.points
    records = np.empty(len(points.ids), POINT)
    records["id"], records["xyz"] = points.ids, points.xyz
    records["rgb"], records["error"] = points.rgb, points.error
    records["length"] = np.diff(tables.of_point)
    elements = tables.elements.astype("<u4")
    with path.open("wb") as file:
        file.write(COUNT.pack(len(points.ids)))
        for index, record in enumerate(records):
            file.write(record.tobytes())
            file.write(elements[tables.of_point[index] : tables.of_point[index + 1]].tobytes())
