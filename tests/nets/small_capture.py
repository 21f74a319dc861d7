"""A small capture on disk, whole and broken in every way that readers tell apart."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image


def write_matrix(path: Path, matrix: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(" ".join(f"{value:.6f}" for value in row) for row in matrix))


def write_capture(
    folder: Path,
    num_frames: int = 4,
    *,
    step: float = 0.15,
    image_size: tuple[int, int] = (48, 64),
    depth_size: tuple[int, int] | None = (48, 64),
    origin: tuple[float, float, float] = (0, 0, 0),
) -> Path:
    """Write a capture in ScanNet's layout.

    Frame i stands ``i * step`` metres to the right and looks along z, in a world whose origin
    is ``origin`` away; every frame sees a wall at 2.5 m.
    """
    height, width = image_size
    pixels = np.random.default_rng(0).integers(0, 255, (height, width, 3), dtype=np.uint8)
    (folder / "color").mkdir(parents=True)
    K = np.array([[width, 0, (width - 1) / 2], [0, width, (height - 1) / 2], [0, 0, 1.0]])
    write_matrix(folder / "intrinsic" / "intrinsic_color.txt", K)
    if depth_size is not None:
        (folder / "depth").mkdir()
        across, down = depth_size[1] / width, depth_size[0] / height
        change = np.array([[across, 0, (across - 1) / 2], [0, down, (down - 1) / 2], [0, 0, 1]])
        write_matrix(folder / "intrinsic" / "intrinsic_depth.txt", change @ K)
    for id in range(num_frames):
        shown = np.roll(pixels, -round(width * id * step / 2.5), axis=1)
        Image.fromarray(shown).save(folder / "color" / f"{id}.jpg", quality=95)
        world_from_cam = np.eye(4)
        world_from_cam[:3, 3] = np.array(origin) + np.array([id * step, 0, 0])
        write_matrix(folder / "pose" / f"{id}.txt", world_from_cam)
        if depth_size is not None:
            wall = np.full(depth_size, 2500, dtype=np.uint16)
            Image.fromarray(wall).save(folder / "depth" / f"{id}.png")
    return folder


def _write(name: str, content: str | bytes) -> Callable[[Path], None]:
    raw = content if isinstance(content, bytes) else content.encode()
    return lambda folder: (folder / name).write_bytes(raw) and None


def _pose(content: str | bytes) -> Callable[[Path], None]:
    return _write(POSE, content)


def _intrinsics(content: str) -> Callable[[Path], None]:
    return _write(K_FILE, content)


def _remove(name: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).rename(folder.parent / "elsewhere") and None


def _twice(folder: Path) -> None:
    Image.new("RGB", (64, 48)).save(folder / "color" / "01.png")


def _empty_color(folder: Path) -> None:
    for path in (folder / "color").iterdir():
        path.unlink()


def _other_numbers(folder: Path) -> None:
    for path in list((folder / "pose").iterdir()):
        path.rename(path.with_name(f"9{path.name}"))


def _all_lost(folder: Path) -> None:
    for path in (folder / "pose").iterdir():
        path.write_text("nan " * 16)


def _no_images(folder: Path) -> None:
    for path in (folder / "color").iterdir():
        path.write_bytes(b"")


def _turned(folder: Path) -> None:
    for file in (folder / "color").iterdir():
        Image.open(file).transpose(Image.Transpose.ROTATE_90).save(file)


POSE, K_FILE = "pose/1.txt", "intrinsic/intrinsic_color.txt"
IDENTITY = "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"
FAULTS: dict[str, Callable[[Path], None]] = {
    "no color": _remove("color"),
    "no pose folder": _remove("pose"),
    "empty color": _empty_color,
    "two files a frame": _twice,
    "no pose belongs": _other_numbers,
    "all poses lost": _all_lost,
    "no image decodes": _no_images,
    "pose of 12": _pose("1 " * 12),
    "empty pose": _pose(""),
    "pose of words": _pose("hello world"),
    "binary pose": _pose(b"\xff\xfe\x00\x80"),
    "scaled pose": _pose(IDENTITY.replace("1 0 0 0 0", "1.1 0 0 0 0", 1)),
    "zero pose": _pose("0 " * 15 + "1"),
    "mirrored pose": _pose("-" + IDENTITY),
    "last row": _pose(IDENTITY[:-1] + "2"),
    "no intrinsics": _remove(K_FILE),
    "intrinsics of 12": _intrinsics("1 " * 12),
    "intrinsics of words": _intrinsics("fx fy"),
    "infinite intrinsics": _intrinsics("nan 0 32 0 9 24 0 0 1"),
    "negative focal": _intrinsics("-9 0 32 0 9 24 0 0 1"),
    "transposed K": _intrinsics("9 0 0 0 9 0 32 24 1"),
    "larger images' K": _intrinsics("90 0 65 0 90 48 0 0 1"),
    "turned images": _turned,
    "smaller images' K": _intrinsics("9 0 16 0 9 12 0 0 1"),
}
"""What breaks a capture; messages.txt has the error of each."""

_GOOD = {"anchor": 2, "sources": [1]}
WRONG_VIEW_SETS: list[object] = [
    "[{",
    "",
    {"anchor": 1},
    [],
    [_GOOD, 3],
    [{"anchor": 1}],
    [{"anchor": "", "sources": [2]}],
    [{"anchor": True, "sources": [2]}],
    [{"anchor": 1.5, "sources": [2]}],
    [{"anchor": 1, "sources": 2}],
    [{"anchor": 1, "sources": [None]}],
    [{"anchor": 1, "sources": []}],
    [{"anchor": 1, "sources": [2, 1]}],
    [{"anchor": 1, "sources": [2, 2]}],
    [{"anchor": 1, "sources": [2, "2"]}],
    [_GOOD, {"anchor": "2", "sources": [1]}],
    [{"anchor": 77, "sources": [2]}],
    [{"anchor": 1, "sources": [-5]}],
    [{"anchor": 1, "sources": ["left"]}],
]
"""Of the capture above; text, or what becomes JSON."""


def write_view_sets(folder: Path, content: object) -> Path:
    path = folder / "sets.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path
