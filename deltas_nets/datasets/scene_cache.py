"""Scenes kept on disk: two million small pose files are slow to read a second time."""

import hashlib
import json
import os
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from deltas_nets.datasets.scenes import LeftOut, Scene, read_scene
from deltas_nets.outputs.atomic_files import write_atomically

__all__ = ["read_scene_cached"]

VERSION = 2
"""Raised whenever the same files give another scene."""


def read_scene_cached(path: Path, cache: Path | None) -> Scene:
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
    """Changes with every file that a scene is read from."""
    digest = hashlib.sha256(str(path.resolve()).encode())
    # An image is only named in the scene: its folder's time says whether names have changed.
    for folder in ("color", "depth"):
        if (path / folder).is_dir():
            digest.update(f"{folder} {(path / folder).stat().st_mtime_ns}".encode())
    for folder in ("intrinsic", "pose"):
        if (path / folder).is_dir():
            with os.scandir(path / folder) as entries:
                for entry in sorted(entries, key=lambda entry: entry.name):
                    state = entry.stat()
                    text = f"{folder} {entry.name} {state.st_mtime_ns} {state.st_size}"
                    digest.update(text.encode())
    return digest.hexdigest()[:16]


def _save(file: Path, scene: Scene) -> None:
    tensors: dict[str, NDArray[Any]] = {
        "K": scene.K,
        "ids": scene.ids,
        "cam_from_world": scene.cam_from_world,
    }
    if scene.depth_K is not None:
        tensors["depth_K"] = scene.depth_K
    for name, words in (("images", scene.images), ("depths", scene.depths)):
        tensors[name] = words.view(np.uint8).reshape(len(words), words.itemsize)
    metadata = {
        "image_size": json.dumps(scene.image_size),
        "depth_size": json.dumps(scene.depth_size),
        "left_out": json.dumps(asdict(scene.left_out)),
        "doubts": json.dumps(scene.doubts),
    }
    content = save({name: np.ascontiguousarray(t) for name, t in tensors.items()}, metadata)
    write_atomically(file, lambda opened: opened.write(content))


def _load(file: Path, path: Path) -> Scene | None:
    """None where the file is damaged: it is written again."""
    try:
        with safe_open(str(file), framework="np") as opened:
            metadata = opened.metadata()
            tensors = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
    except (SafetensorError, OSError):
        return None
    height, width = json.loads(metadata["image_size"])
    depth_size = json.loads(metadata["depth_size"])

    def words(name: str) -> NDArray[np.bytes_]:
        letters = np.ascontiguousarray(tensors[name])
        return letters.view(f"S{letters.shape[1]}").reshape(-1)

    return Scene(
        path=path,
        image_size=(height, width),
        K=tensors["K"],
        depth_K=tensors.get("depth_K"),
        depth_size=None if depth_size is None else (depth_size[0], depth_size[1]),
        ids=tensors["ids"],
        cam_from_world=tensors["cam_from_world"],
        images=words("images"),
        depths=words("depths"),
        left_out=LeftOut(**json.loads(metadata["left_out"])),
        doubts=tuple(json.loads(metadata["doubts"])),
    )
