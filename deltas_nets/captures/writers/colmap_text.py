"""COLMAP's text files, every number with all its digits."""

from collections.abc import Iterable, Iterator
from pathlib import Path

from deltas_nets.captures.colmap_model import ColmapModel
from deltas_nets.captures.writers.tracks import TrackTables, track_tables

__all__ = ["write_text_model"]


def write_text_model(model: ColmapModel, folder: Path) -> None:
    """Write cameras.txt, images.txt and points3D.txt."""
    tables = track_tables(model)
    _write(folder / "cameras.txt", _cameras(model))
    _write(folder / "images.txt", _images(model, tables))
    _write(folder / "points3D.txt", _points(model, tables))


def _write(path: Path, lines: Iterable[str]) -> None:
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.writelines(f"{line}\n" for line in lines)


def _cameras(model: ColmapModel) -> Iterator[str]:
    yield "# Camera list with one line of data per camera:"
    yield "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"
    yield f"# Number of cameras: {len(model.cameras)}"
    for id, camera in model.cameras.items():
        height, width = camera.image_size
        yield f"{id} {camera.model} {width} {height} {_numbers(camera.params)}"


def _images(model: ColmapModel, tables: TrackTables) -> Iterator[str]:
    images, tracks = model.images, model.tracks
    yield "# Image list with two lines of data per image:"
    yield "#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME"
    yield "#   POINTS2D[] as (X, Y, POINT3D_ID)"
    yield f"# Number of images: {len(images.ids)}"
    for index, name in enumerate(images.names):
        pose = [*images.quaternions[index].tolist(), *images.translations[index].tolist()]
        yield f"{images.ids[index]} {_numbers(pose)} {images.camera_ids[index]} {name}"
        part = slice(tables.of_image[index], tables.of_image[index + 1])
        pixels, points = tracks.pixels[part].tolist(), tracks.point_ids[part].tolist()
        yield " ".join(f"{x!r} {y!r} {id}" for (x, y), id in zip(pixels, points, strict=True))


def _points(model: ColmapModel, tables: TrackTables) -> Iterator[str]:
    points = model.points
    yield "# 3D point list with one line of data per point:"
    yield "#   POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"
    yield f"# Number of points: {len(points.ids)}"
    columns = (points.ids, points.xyz, points.rgb, points.error)
    rows = zip(*(column.tolist() for column in columns), strict=True)
    for index, (id, xyz, rgb, error) in enumerate(rows):
        track = tables.elements[tables.of_point[index] : tables.of_point[index + 1]]
        numbers = [_numbers(xyz), *map(str, rgb), repr(error), *map(str, track.ravel().tolist())]
        yield f"{id} {' '.join(numbers)}"


def _numbers(numbers: Iterable[float]) -> str:
    return " ".join(map(repr, numbers))
