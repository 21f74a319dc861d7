"""Scenes kept on disk: two million small pose files are slow to read a second time."""

import hashlib
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from deltas_nets.captures.capture import Capture, Lost
from deltas_nets.captures.frame import Lens
from deltas_nets.captures.frames import Camera, FrameArrays, Frames
from deltas_nets.datasets.scenes import read_scene
from deltas_nets.errors import UserError
from deltas_nets.outputs.atomic_files import write_atomically

__all__ = ["read_scene_cached"]

VERSION = 6
"""Raised whenever the same files give another scene."""
WORDS = ("ids", "images", "depths")


def read_scene_cached(path: Path, cache: Path | None) -> Capture:
    """:func:`read_scene`, or what it found the last time.

    Args:
        path: the folder of the scene.
        cache: folder that keeps scenes; many processes may share it. None reads every time.

    Raises:
        UserError: as :func:`read_scene`; the cache cannot be written.
        OSError: the system refuses to read a file of the scene.
    """
    if cache is None:
        return read_scene(path)
    file = cache / f"scannet-v{VERSION}-{path.name}-{_state(path)}.safetensors"
    if file.exists():
        kept = _load(file, path)
        if kept is not None:
            return kept
    scene = read_scene(path)
    _save(file, scene)
    return scene


def _state(path: Path) -> str:
    """A word that changes with every file that a scene is read from."""
    digest = hashlib.sha256(str(path.resolve()).encode())
    # Images are only named in the scene: their folder's time says whether names have changed. The
    # first of them says how large all are.
    for folder in ("color", "depth"):
        if (path / folder).is_dir():
            digest.update(f"{folder} {(path / folder).stat().st_mtime_ns}".encode())
            digest.update(_state_of_first(path / folder).encode())
    for folder in ("intrinsic", "pose"):
        if (path / folder).is_dir():
            with os.scandir(path / folder) as entries:
                for entry in sorted(entries, key=lambda entry: entry.name):
                    state = entry.stat()
                    text = f"{folder} {entry.name} {state.st_mtime_ns} {state.st_size}"
                    digest.update(text.encode())
    return digest.hexdigest()[:16]


def _state_of_first(folder: Path) -> str:
    with os.scandir(folder) as entries:
        numbered = (entry for entry in entries if Path(entry.name).stem.isdecimal())
        first = min(numbered, key=lambda entry: int(Path(entry.name).stem), default=None)
    try:
        state = None if first is None else first.stat()
    except OSError:  # a link that leads nowhere
        return ""
    return "" if state is None else f"{state.st_mtime_ns} {state.st_size}"


def _save(file: Path, scene: Capture) -> None:
    arrays = scene.frames.arrays
    tensors: dict[str, NDArray[Any]] = {
        "cam_from_world": arrays.cam_from_world,
        "camera_of": arrays.camera_of,
    }
    for name in WORDS:
        words = getattr(arrays, name)
        tensors[name] = words.view(np.uint8).reshape(len(words), words.itemsize)
    lost = [(id, why.reason, *why.error.args) for id, why in scene.lost.items()]
    metadata = {
        "cameras": json.dumps([camera._asdict() for camera in arrays.cameras], default=_plain),
        "lost": json.dumps(lost, default=str),
        "doubts": json.dumps(scene.doubts),
    }
    content = save({name: np.ascontiguousarray(t) for name, t in tensors.items()}, metadata)
    write_atomically(file, lambda opened: opened.write(content))


def _load(file: Path, path: Path) -> Capture | None:
    """What a file holds; None where it is damaged, and will be written again."""
    try:
        with safe_open(str(file), framework="np") as opened:
            metadata = opened.metadata()
            tensors = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
    except (SafetensorError, OSError):
        return None
    for name in WORDS:
        letters = np.ascontiguousarray(tensors[name])
        tensors[name] = letters.view(f"S{letters.shape[1]}").reshape(-1)
    cameras = tuple(_camera(**fields) for fields in json.loads(metadata["cameras"]))
    lost = {
        id: Lost(reason, UserError(what, Path(where), remedy))
        for id, reason, what, where, remedy in json.loads(metadata["lost"])
    }
    frames = Frames(path, FrameArrays(**tensors, cameras=cameras))
    return Capture(path, frames, lost, tuple(json.loads(metadata["doubts"])))


def _camera(
    image_size: list[int],
    K: list[list[float]],
    depth_K: list[list[float]] | None,
    depth_size: list[int] | None,
    lens: list[Any] | None,
    depth_scale: float,
    cam_from_depth: list[list[float]] | None,
    depth_unit: float,
) -> Camera:
    return Camera(
        image_size=(image_size[0], image_size[1]),
        K=np.array(K),
        depth_K=None if depth_K is None else np.array(depth_K),
        depth_size=None if depth_size is None else (depth_size[0], depth_size[1]),
        lens=None if lens is None else Lens(lens[0], tuple(lens[1])),
        depth_scale=depth_scale,
        cam_from_depth=None if cam_from_depth is None else np.array(cam_from_depth),
        depth_unit=depth_unit,
    )


def _plain(matrix: NDArray[np.float64]) -> object:
    # Python writes as many digits as tell a number from all others.
    return matrix.tolist()
