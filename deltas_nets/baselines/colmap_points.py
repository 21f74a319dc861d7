"""COLMAP's sparse points of one view set, whose cameras are known."""

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from deltas_geom import PosedViews, project
from deltas_nets.captures.frame import FloatArray, Frame
from deltas_nets.captures.work_size import anchor_views
from deltas_nets.errors import UserError
from deltas_nets.extras import check_extra
from deltas_nets.predict.depth_map import KeypointDepths

__all__ = ["colmap", "sparse_points"]


def colmap() -> Any:
    """The module pycolmap, which says nothing but errors.

    Raises:
        UserError: it is not installed.
    """
    named = "colmap-sparse and colmap-densified"
    check_extra("colmap", "pycolmap", wanted_by="COLMAP's baselines need", where=named)
    import pycolmap

    pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value
    return pycolmap


def sparse_points(frames: Sequence[Frame], depth_range: tuple[float, float]) -> KeypointDepths:
    """SIFT points of all frames, matched, verified and triangulated with the known cameras.

    Args:
        frames: the anchor and its sources; straight ones, their lens undone.
        depth_range: points nearer or farther are left out, metres.

    Returns:
        Pixels and depths of the points that the anchor sees, at the size of its image. Only
        points that the anchor's own features belong to: the others may be hidden from it.

    Raises:
        UserError: pycolmap is not installed, an image cannot be read, or a K is skewed.
    """
    pycolmap = colmap()
    skewed = next((frame for frame in frames if frame.K[0, 1]), None)
    if skewed is not None:
        what = f"K of frame {skewed.id} is skewed ({skewed.K[0, 1]:g}), which COLMAP cannot say"
        raise UserError(what, skewed.image_path, "name another network with --weights")
    # Float64 until the camera's own arithmetic: baselines are what is left of large numbers.
    poses = anchor_views(frames, work_size=frames[0].image_size).cam_from_world.double().numpy()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        images = folder / "images"
        images.mkdir()
        names = [f"{number:03}.png" for number in range(len(frames))]
        for frame, file in zip(frames, names, strict=True):
            Image.fromarray(frame.read_image()).save(images / file, compress_level=1)
        found = _triangulated(pycolmap, folder, images, names, frames, poses)
        points = _points_of_anchor(found, names[0])
    height, width = frames[0].image_size
    K = torch.from_numpy(frames[0].K.copy())
    anchor = PosedViews(K[None], torch.eye(4, dtype=torch.float64)[None])
    seen = project(anchor, torch.from_numpy(points))
    pixels, depth = seen.pixels[0], seen.depth[0]
    near, far = depth_range
    used = (depth >= near) & (depth <= far)
    return KeypointDepths(pixels[used].float(), depth[used].float(), (height, width))


def _triangulated(
    pycolmap: Any,
    folder: Path,
    images: Path,
    names: Sequence[str],
    frames: Sequence[Frame],
    poses: FloatArray,
) -> Any:
    """COLMAP's reconstruction with the frames' cameras and poses as they are."""
    database, out = folder / "database.db", folder / "out"
    out.mkdir()
    extraction = pycolmap.FeatureExtractionOptions()
    matching = pycolmap.FeatureMatchingOptions()
    extraction.num_threads = matching.num_threads = 1
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = 0
    cpu = pycolmap.Device.cpu
    reader = pycolmap.ImageReaderOptions(camera_model="PINHOLE")
    pycolmap.extract_features(
        database,
        images,
        image_names=list(names),
        camera_mode=pycolmap.CameraMode.PER_IMAGE,
        reader_options=reader,
        extraction_options=extraction,
        device=cpu,
    )
    model = pycolmap.Reconstruction()
    with pycolmap.Database.open(database) as opened:
        for number, file in enumerate(names):
            image = opened.read_image_with_name(file)
            camera = opened.read_camera(image.camera_id)
            camera.params = _parameters(frames[number])
            camera.has_prior_focal_length = True
            opened.update_camera(camera)
            model.add_camera_with_trivial_rig(camera)
            pose = pycolmap.Rigid3d(poses[number][:3])
            model.add_image_with_trivial_frame(
                pycolmap.Image(name=file, camera_id=camera.camera_id, image_id=image.image_id), pose
            )
    pycolmap.match_exhaustive(
        database, matching_options=matching, verification_options=verification, device=cpu
    )
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = 1
    options.random_seed = 0
    return pycolmap.triangulate_points(model, database, images, out, options=options)


def _parameters(frame: Frame) -> list[float]:
    """Of COLMAP's PINHOLE, whose pixels begin at the corner of the image."""
    K = frame.K
    return [K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5]


def _points_of_anchor(model: Any, name: str) -> FloatArray:
    """``(D, 3)`` in the anchor's coordinates."""
    image = next(image for image in model.images.values() if image.name == name)
    ids = [point.point3D_id for point in image.points2D if point.has_point3D()]
    points = [model.points3D[id].xyz for id in ids]
    return np.array(points, dtype=np.float64).reshape(-1, 3)
