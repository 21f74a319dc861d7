"""The sample of the Robust MVD benchmark: a key image and its sources, each in a folder."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.float_files import read_npy_array
from deltas_nets.captures.frame import FloatArray
from deltas_nets.captures.ids import natural_key
from deltas_nets.captures.readers.cameras import camera_of_matrix
from deltas_nets.captures.readers.collected import Collected
from deltas_nets.captures.readers.listed import listed
from deltas_nets.captures.readers.poses import cam_from_world
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
    sources = [folder for folder in listed(path / "source") if folder.is_dir()]
    folders |= {
        folder.name: folder for folder in sorted(sources, key=lambda each: natural_key(each.name))
    }
    if len(folders) != len(sources) + 1:
        raise UserError("a source is called key", path / "source", "call it by a number")
    found = Collected(path)
    for id, folder in folders.items():
        image = next(
            (file for name in ("image.png", "image.jpg") if (file := folder / name).is_file()), None
        )
        photo = found.photo(id, image)
        if photo is None:
            continue
        K = _matrix(folder / "K.npy", 3)
        pose = cam_from_world(
            _matrix(folder / "to_ref_transform.npy", 4),
            id=id,
            path=folder / "to_ref_transform.npy",
        )
        depth = folder / "depth.npy"
        found.add(
            photo,
            pose,
            camera_of_matrix(K, path=folder / "K.npy"),
            depth=depth if depth.is_file() else None,
        )
    capture = found.capture(path, "Robust MVD", metric=True)
    of_key = tuple(id for id in folders if id in capture.frames and id != "key")
    if "key" not in capture.frames or not of_key:
        return capture
    return replace(capture, sources={**dict.fromkeys(of_key, ()), "key": of_key})


def _matrix(path: Path, side: int) -> FloatArray:
    try:
        with path.open("rb") as file:
            array = read_npy_array(file.read(_LIMIT), path)
    except FileNotFoundError as error:
        raise UserError(f"there is no {path.name}", path, _REMEDY) from error
    if array.shape != (side, side):
        raise UserError(f"{path.name} has shape {array.shape}", path, _REMEDY)
    return array.astype(np.float64)
