"""The sample of the Robust MVD benchmark: a key image and its sources, each in a folder."""

from pathlib import Path

import numpy as np

from deltas_nets.captures.capture import Capture, Lost
from deltas_nets.captures.float_files import read_npy_array
from deltas_nets.captures.frame import FloatArray, Frame
from deltas_nets.captures.frames import Frames
from deltas_nets.captures.ids import natural_key
from deltas_nets.captures.images import image_size_of
from deltas_nets.captures.readers.cameras import camera_matrix
from deltas_nets.captures.readers.poses import cam_from_world, missing_images
from deltas_nets.errors import UserError

__all__ = ["read", "recognises"]

_REMEDY = "write image.png, K.npy (3x3) and to_ref_transform.npy (4x4) into each folder"
_LIMIT = 2**16


def recognises(path: Path) -> bool:
    """Whether the folder has a key and sources."""
    return (path / "key").is_dir() and (path / "source").is_dir()


def read(path: Path) -> Capture:
    """Read key and sources; see `deltas_nets.captures.opening.Reader` for the contract.

    A transform takes the key camera's points to the camera of its own folder: the key's camera is
    the world, whatever the name says.
    """
    folders = {"key": path / "key"}
    sources = [folder for folder in (path / "source").iterdir() if folder.is_dir()]
    folders |= {
        folder.name: folder for folder in sorted(sources, key=lambda each: natural_key(each.name))
    }
    if len(folders) != len(sources) + 1:
        raise UserError("a source is called key", path / "source", "call it by a number")
    frames: list[Frame] = []
    lost: dict[str, Lost] = {}
    missing = []
    for id, folder in folders.items():
        image = next(
            (file for name in ("image.png", "image.jpg") if (file := folder / name).is_file()), None
        )
        size = None if image is None else image_size_of(image)
        if image is None or size is None:
            missing.append(id)
            continue
        K = _matrix(folder / "K.npy", 3)
        pose = cam_from_world(
            _matrix(folder / "to_ref_transform.npy", 4),
            id=id,
            path=folder / "to_ref_transform.npy",
        )
        if isinstance(pose, Lost):
            lost[id] = pose
            continue
        depth = folder / "depth.npy"
        frames.append(
            Frame(
                id=id,
                image_path=image,
                image_size=size,
                K=camera_matrix(K[0, 0], K[1, 1], K[0, 2], K[1, 2], path=folder / "K.npy"),
                cam_from_world=pose,
                depth_path=depth if depth.is_file() else None,
            )
        )
    lost |= missing_images(missing, path)
    known = [frame.id for frame in frames]
    of_key = tuple(id for id in known if id != "key")
    return Capture(
        path,
        Frames.of(frames, path),
        lost,
        layout="Robust MVD",
        metric=True,
        sources={"key": of_key} if "key" in known and of_key else None,
    )


def _matrix(path: Path, side: int) -> FloatArray:
    try:
        with path.open("rb") as file:
            array = read_npy_array(file.read(_LIMIT), path)
    except FileNotFoundError as error:
        raise UserError(f"there is no {path.name}", path, _REMEDY) from error
    if array.shape != (side, side):
        raise UserError(f"{path.name} has shape {array.shape}", path, _REMEDY)
    return array.astype(np.float64)
