"""Small captures on disk."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from deltas_nets.data.capture import Capture, open_capture

MakeCapture = Callable[..., Path]


def write_matrix(path: Path, matrix: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(" ".join(f"{value:.6f}" for value in row) for row in matrix))


@pytest.fixture
def make_capture(tmp_path: Path) -> MakeCapture:
    """A function that writes a capture in ScanNet's layout and returns its folder.

    Frame i stands ``i * step`` metres to the right and looks along z, in a world whose origin
    is ``origin`` away; every frame sees a wall at 2.5 m.
    """

    def make(
        num_frames: int = 4,
        *,
        path: Path | None = None,
        step: float = 0.15,
        image_size: tuple[int, int] = (48, 64),
        depth_size: tuple[int, int] | None = (48, 64),
        origin: tuple[float, float, float] = (0, 0, 0),
    ) -> Path:
        folder = tmp_path / "capture" if path is None else path
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
            Image.fromarray(pixels).save(folder / "color" / f"{id}.jpg", quality=95)
            world_from_cam = np.eye(4)
            world_from_cam[:3, 3] = np.array(origin) + np.array([id * step, 0, 0])
            write_matrix(folder / "pose" / f"{id}.txt", world_from_cam)
            if depth_size is not None:
                wall = np.full(depth_size, 2500, dtype=np.uint16)
                Image.fromarray(wall).save(folder / "depth" / f"{id}.png")
        return folder

    return make


@pytest.fixture
def capture(make_capture: MakeCapture) -> Capture:
    """Four frames in a row."""
    return open_capture(make_capture())
