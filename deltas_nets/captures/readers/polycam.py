"""Polycam's raw data: keyframes with a JSON file of each camera."""

from pathlib import Path

import numpy as np

from deltas_nets.captures.capture import Capture, Lost
from deltas_nets.captures.frame import FloatArray, Frame
from deltas_nets.captures.frames import Frames
from deltas_nets.captures.images import image_size_of
from deltas_nets.captures.readers.cameras import CORNER, camera_matrix, fitted
from deltas_nets.captures.readers.image_sizes import SizedCamera, doubts_of_sizes
from deltas_nets.captures.readers.json_file import Fields, read_json
from deltas_nets.captures.readers.poses import OPENGL, cam_from_world_of, missing_images
from deltas_nets.errors import UserError

__all__ = ["read", "recognises"]

_REMEDY = "export raw data from Polycam again"
_JSON_LIMIT = 2**20
_KINDS = (("corrected_cameras", "corrected_images"), ("cameras", "images"))
"""Folders of cameras and their images: after the global optimisation, or as ARKit tracked."""


def recognises(path: Path) -> bool:
    """Whether the folder holds key frames, or is the folder of them."""
    return _keyframes(path) is not None


def read(path: Path) -> Capture:
    """Read key frames; see `deltas_nets.captures.opening.Reader` for the contract."""
    both = _keyframes(path)
    if both is None:
        raise UserError("there are no cameras in keyframes", path, _REMEDY)
    cameras, images = both
    folder = cameras.parent
    doubts = []
    if cameras.name == "cameras":
        doubts.append(f"poses are as tracked, not optimised (no corrected_cameras), {folder}")
    frames: list[Frame] = []
    lost: dict[str, Lost] = {}
    missing = []
    sized: list[SizedCamera] = []
    files = sorted(file for file in cameras.iterdir() if file.suffix.lower() == ".json")
    for file in files:
        id = file.stem
        image = next(
            (
                found
                for suffix in (".jpg", ".jpeg", ".png")
                if (found := images / f"{id}{suffix}").is_file()
            ),
            None,
        )
        size = None if image is None else image_size_of(image)
        if image is None or size is None:
            missing.append(id)
            continue
        content = read_json(file, name="camera", remedy=_REMEDY, limit=_JSON_LIMIT)
        fields = Fields(content, file, where="the camera", remedy=_REMEDY)
        pose = _pose(fields, id, file)
        if isinstance(pose, Lost):
            lost[id] = pose
            continue
        sized.append(_intrinsics(fields, size, image))
        depth = folder / "depth" / f"{id}.png"
        frames.append(
            Frame(
                id=id,
                image_path=image,
                image_size=size,
                K=sized[-1].K,
                cam_from_world=pose,
                depth_path=depth if depth.is_file() else None,
            )
        )
    lost |= missing_images(missing, images)
    doubts += doubts_of_sizes(sized)
    return Capture(path, Frames.of(frames, path), lost, tuple(doubts), "Polycam", metric=True)


def _keyframes(path: Path) -> tuple[Path, Path] | None:
    """The folders of cameras and of images, optimised ones first."""
    for folder in (path / "keyframes", path):
        for cameras, images in _KINDS:
            both = folder / cameras, folder / images
            if both[0].is_dir() and both[1].is_dir() and _holds_json(both[0]):
                return both
    return None


def _holds_json(folder: Path) -> bool:
    return any(file.suffix.lower() == ".json" for file in folder.iterdir())


def _intrinsics(fields: Fields, size: tuple[int, int], image: Path) -> SizedCamera:
    """ARKit measures the principal point from the corner of the image."""
    fx, fy, cx, cy = (fields.number(name) for name in ("fx", "fy", "cx", "cy"))
    K = camera_matrix(fx, fy, cx - CORNER, cy - CORNER, path=fields.path)
    stated = int(fields.number("height", size[0])), int(fields.number("width", size[1]))
    return fitted(K, stated, size, image=image)


def _pose(fields: Fields, id: str, path: Path) -> FloatArray | Lost:
    world_from_cam = np.eye(4)
    for row in range(3):
        for column in range(4):
            world_from_cam[row, column] = fields.numbers(f"t_{row}{column}", (), finite=False)
    return cam_from_world_of(world_from_cam * OPENGL, id=id, path=path)
