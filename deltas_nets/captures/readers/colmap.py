"""COLMAP's models, text and binary, of every version up to rigs and frames.

Poses are those of images.txt or images.bin, which hold them in all versions: rigs and frames say
the same in another way.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np

from deltas_nets.captures.capture import Capture, Frame, Lost
from deltas_nets.captures.colmap_model import CAMERA_MODELS, ColmapCamera, ColmapModel, k_and_lens
from deltas_nets.captures.file_form import FileForm
from deltas_nets.captures.frame import FloatArray
from deltas_nets.captures.frames import Frames
from deltas_nets.captures.ids import ids_in_words
from deltas_nets.captures.images import in_words
from deltas_nets.captures.points import Observations, SparsePoints
from deltas_nets.captures.readers.colmap_folder import find_models, has_model, is_binary, read_model
from deltas_nets.captures.readers.files import FileFinder
from deltas_nets.captures.readers.image_sizes import (
    SizedCamera,
    at_size,
    doubts_of_sizes,
    first_size,
)
from deltas_nets.captures.readers.names import frame_ids, without_common_folder
from deltas_nets.captures.rigid import rigid
from deltas_nets.captures.rotations import rotations_of
from deltas_nets.errors import UserError

__all__ = ["capture_of_model", "read", "recognises"]

IMAGE_FOLDERS = ("images", "input", "resized_images")
"""Where programs that use COLMAP look for images: beside the model, or a folder or two above.
ScanNet++ has the last, and images without distortion of the same names in another."""
LARGEST_SIZE = 2**20
"""Pixels of a side."""


def recognises(path: Path) -> bool:
    """Whether there is a model here, or this is a file of one."""
    return has_model(path)


def read(path: Path) -> Capture:
    """Read a model and find its images; see `deltas_nets.captures.opening.Reader`."""
    found = find_models(path)
    most = found.models[0][1]
    tried = []
    for capture, (folder, count) in product(found.captures, found.models):
        if count == most:
            model = read_model(folder)
            images, guesses = _find_images(folder, model, capture)
            there = sum(image is not None for image in images)
            tried.append((there, folder, model, images, guesses, capture))
            if there == len(images):
                break
    _, folder, model, images, guesses, capture = max(tried, key=lambda each: each[0])
    read = capture_of_model(model, images, folder, capture)
    read = replace(read, doubts=(*guesses, *read.doubts))
    rest = [f"{other.name} ({count})" for other, count in found.models if other != folder]
    if not rest:
        return read
    doubt = f"{folder} with {most} images is read; there are other models: {ids_in_words(rest)}"
    return replace(read, doubts=(doubt, *read.doubts))


def _find_images(
    folder: Path, model: ColmapModel, capture: Path
) -> tuple[list[Path | None], list[str]]:
    """The images of a model, None where there is none, and a warning of those that are guessed."""
    around = [each for each in (folder, *folder.parents) if each.is_relative_to(capture)]
    roots = [each / name for each in around for name in IMAGE_FOLDERS]
    names = model.images.names
    finder = FileFinder(capture, [*roots, *around], names=names)
    return [finder.find(name) for name in names], finder.doubts()


def capture_of_model(
    model: ColmapModel, images: Sequence[Path | None], folder: Path, path: Path
) -> Capture:
    """The capture of a model.

    Args:
        model: as COLMAP's files hold it.
        images: the file of each of its images, None where there is none.
        folder: of the model, for errors.
        path: of the capture.

    Raises:
        UserError: an image's camera is missing or is none, or its files are of another shape.
    """
    file = _file(folder, "images")
    if not model.images.names:
        raise UserError("the model has no images", file, "estimate poses with COLMAP first")
    ids = _ids(model.images.names, file)
    cameras = _cameras(model, images, folder)
    rotations = rotations_of(model.images.quaternions)
    frames: list[Frame] = []
    lost: dict[str, Lost] = {}
    frame_of_image: dict[int, str] = {}
    for position, (id, image) in enumerate(zip(ids, images, strict=True)):
        pose = rigid(rotations[position], model.images.translations[position])
        if not np.isfinite(pose).all():
            error = UserError(f"the pose of {id} is not finite", file, "estimate it again")
            lost[id] = Lost("no pose", error)
        elif image is None:
            lost[id] = Lost("no image", _no_image(model.images.names[position], path))
        else:
            camera = cameras[int(model.images.camera_ids[position])]
            frames.append(
                Frame(
                    id=id,
                    image_path=image,
                    image_size=camera.image_size,
                    K=camera.K,
                    cam_from_world=pose,
                    lens=camera.lens,
                )
            )
            frame_of_image[position] = id
    packed = Frames.of(frames, path)
    scales = np.array([cameras[int(id)].scale for id in model.images.camera_ids]).reshape(-1, 2)
    return Capture(
        path=path,
        frames=packed,
        lost=lost,
        doubts=tuple(doubts_of_sizes(cameras.values())),
        layout=f"COLMAP {'binary' if is_binary(folder) else 'text'}",
        metric=False,
        points=_points(model, packed, frame_of_image, scales),
        form=FileForm(centre=0.5),
    )


def _file(folder: Path, stem: str) -> Path:
    return folder / f"{stem}{'.bin' if is_binary(folder) else '.txt'}"


def _no_image(name: str, path: Path) -> UserError:
    return UserError(f"the image {name[:80]} is missing", path, "put it there, or into images/")


def _ids(names: Sequence[str], file: Path) -> list[str]:
    try:
        return frame_ids(names, file)
    except UserError:
        # Programs that write absolute paths: what is below the folder of all is as good.
        return frame_ids(without_common_folder(names), file)


def _cameras(
    model: ColmapModel, images: Sequence[Path | None], folder: Path
) -> dict[int, SizedCamera]:
    """Cameras that took an image, at the size of its file."""
    file = _file(folder, "cameras")
    files: dict[int, list[Path]] = {int(id): [] for id in model.images.camera_ids}
    for id, image in zip(model.images.camera_ids.tolist(), images, strict=True):
        if image is not None:
            files[id].append(image)
    cameras = {}
    for id, taken in files.items():
        if id not in model.cameras:
            what = f"images are of camera {id}, which is missing"
            raise UserError(what, file, "export the model from COLMAP again")
        stated = _checked(model.cameras[id], id, file)
        image, size = first_size(taken) or (file, stated.image_size)
        K, lens = k_and_lens(stated)
        cameras[id] = at_size(K, lens, stated=stated.image_size, size=size, image=image)
    return cameras


def _checked(camera: ColmapCamera, id: int, file: Path) -> ColmapCamera:
    focal = camera.params[: CAMERA_MODELS[camera.model].num_focal]
    if not np.isfinite(camera.params).all() or any(f <= 0 for f in focal):
        numbers = " ".join(f"{number:g}" for number in camera.params)
        what = f"camera {id} is no camera ({camera.model} {numbers})"
        raise UserError(what, file, "calibrate it again")
    if not all(0 < side <= LARGEST_SIZE for side in camera.image_size):
        what = f"camera {id} has images of {in_words(camera.image_size)}"
        raise UserError(what, file, "write the size of its images in pixels")
    return camera


def _points(
    model: ColmapModel, frames: Frames, frame_of_image: Mapping[int, str], scales: FloatArray
) -> SparsePoints | None:
    """The model's points, and where the frames see them.

    Args:
        model: as COLMAP's files hold it.
        frames: those that are used.
        frame_of_image: their ids by the image's position.
        scales: ``(I, 2)`` of images, right and down, from the cameras as stated.
    """
    points, tracks = model.points, model.tracks
    good = np.isfinite(points.xyz).all(axis=-1)
    ids, first = np.unique(points.ids[good], return_index=True)
    if not len(ids):
        return None
    place_of_frame = {id: place for place, id in enumerate(frames)}
    frame = np.full(len(model.images.ids), -1)
    for position, id in frame_of_image.items():
        frame[position] = place_of_frame[id]
    place = np.searchsorted(ids, tracks.point_ids).clip(max=len(ids) - 1)
    used = (ids[place] == tracks.point_ids) & (frame[tracks.image] >= 0)
    used &= np.isfinite(tracks.pixels).all(axis=-1)
    pixels = tracks.pixels * scales[tracks.image] - 0.5
    error = np.where(points.error < 0, np.nan, points.error)
    return SparsePoints(
        points.xyz[good][first],
        points.rgb[good][first],
        error[good][first],
        Observations(place[used], frame[tracks.image][used], pixels[used]),
    )
