"""A capture as a COLMAP model: images/ and sparse/0/, text or binary, with points and tracks."""

from pathlib import Path

import numpy as np

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.colmap_model import (
    ColmapCamera,
    ColmapImages,
    ColmapModel,
    ColmapPoints,
    ColmapTracks,
    camera_of,
)
from deltas_nets.captures.rotations import quaternions_of
from deltas_nets.captures.writers.colmap_binary import write_binary_model
from deltas_nets.captures.writers.colmap_text import write_text_model
from deltas_nets.captures.writers.files import Putting, image_name, put_image
from deltas_nets.errors import UserError

__all__ = ["model_of_capture", "write_binary", "write_text"]


def write_text(capture: Capture, folder: Path, putting: Putting) -> list[str]:
    """Write text files; see `deltas_nets.captures.writers` for the contract."""
    model = _put_images(capture, folder, putting)
    write_text_model(model, folder / "sparse" / "0")
    cut = [name for name in model.images.names if " " in name]
    if not cut:
        return _left_out(capture)
    known = f"COLMAP reads names in text up to a space ({cut[0]}): --to colmap-bin keeps them whole"
    return [*_left_out(capture), known]


def write_binary(capture: Capture, folder: Path, putting: Putting) -> list[str]:
    """Write binary files; see `deltas_nets.captures.writers` for the contract."""
    model = _put_images(capture, folder, putting)
    write_binary_model(model, folder / "sparse" / "0")
    return _left_out(capture)


def _put_images(capture: Capture, folder: Path, putting: Putting) -> ColmapModel:
    model = model_of_capture(capture)
    for name, frame in zip(model.images.names, capture.frames.values(), strict=True):
        put_image(frame, folder / "images" / name, putting)
    (folder / "sparse" / "0").mkdir(parents=True)
    return model


def _left_out(capture: Capture) -> list[str]:
    said = []
    if any(capture.frames.arrays.depths):
        said.append("depth is left out: COLMAP's models have none")
    if capture.metric:
        said.append("that the unit is the metre is left out: COLMAP's models do not state it")
    return said


def model_of_capture(capture: Capture) -> ColmapModel:
    """The model that COLMAP would have written.

    Raises:
        UserError: a lens is of no model that COLMAP knows, or K is skewed.
    """
    arrays = capture.frames.arrays
    cameras: dict[ColmapCamera, int] = {}
    ids_of_cameras = []
    for camera in arrays.cameras:
        same = camera_of(camera.K, camera.lens, camera.image_size)
        if same is None:
            lens = "skewed pixels" if camera.lens is None else camera.lens.model
            what = f"COLMAP has no camera with {lens}"
            raise UserError(what, capture.path, "use --to own, or undistort the images")
        ids_of_cameras.append(cameras.setdefault(same, len(cameras) + 1))
    count = len(capture.frames)
    images = ColmapImages(
        np.arange(1, count + 1),
        [image_name(frame) for frame in capture.frames.values()],
        quaternions_of(arrays.cam_from_world[:, :3, :3]).reshape(-1, 4),
        arrays.cam_from_world[:, :3, 3],
        np.array(ids_of_cameras, dtype=np.int64)[arrays.camera_of],
    )
    return ColmapModel({id: camera for camera, id in cameras.items()}, images, *_tracks(capture))


def _tracks(capture: Capture) -> tuple[ColmapPoints, ColmapTracks]:
    """Points and the pixels that see them, those of each image together."""
    known = capture.points
    if known is None:
        nothing = np.zeros(0, dtype=np.int64)
        return ColmapPoints.none(), ColmapTracks(nothing, np.zeros((0, 2)), nothing)
    error = np.where(np.isnan(known.error), -1.0, known.error)
    points = ColmapPoints(np.arange(1, len(known.xyz) + 1), known.xyz, known.rgb, error)
    order = np.argsort(known.seen.frame, kind="stable")
    seen = known.seen
    pixels = seen.pixels[order] + 0.5
    return points, ColmapTracks(seen.frame[order], pixels, seen.point[order] + 1)
