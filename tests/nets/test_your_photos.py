"""The recipes of docs/your_photos.md and the README: what they write is read as it was meant."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.opening import open_capture

ROOT = Path(__file__).resolve().parents[2]
MakeCapture = Callable[..., Path]


def python_of(page: str) -> list[str]:
    text = (ROOT / page).read_text(encoding="utf-8")
    return re.findall(r"^```python\n(.*?)^```$", text, flags=re.DOTALL | re.MULTILINE)


@pytest.fixture
def recipes() -> dict[str, Any]:
    """What the page's snippets define, run one after another as a reader would."""
    names: dict[str, Any] = {}
    for snippet in python_of("docs/your_photos.md"):
        exec(compile(snippet, "docs/your_photos.md", "exec"), names)
    return names


@pytest.fixture
def turned(capture: Capture) -> list[np.ndarray]:
    """Poses (4, 4) of the capture's frames, all turned differently."""
    poses = []
    for id, frame in capture.frames.items():
        turn = np.eye(4)
        turn[:3, :3] = Rotation.from_rotvec([0.1 * int(id), 0.3, -0.2]).as_matrix()
        poses.append(turn @ frame.cam_from_world)
    return poses


def test_both_pages_have_the_same_recipe() -> None:
    (in_readme,) = [text for text in python_of("README.md") if "def write_capture" in text]
    assert in_readme == python_of("docs/your_photos.md")[0]


def test_a_capture_is_written_from_k_and_poses(
    capture: Capture, turned: list[np.ndarray], recipes: dict[str, Any], tmp_path: Path
) -> None:
    frames = list(capture.frames.values())
    photos = [frame.image_path for frame in frames]
    recipes["write_capture"](tmp_path / "new", photos, turned, frames[0].K)
    written = open_capture(tmp_path / "new")
    assert list(written.frames) == ["0", "1", "2", "3"]
    for frame, old, pose in zip(written.frames.values(), frames, turned, strict=True):
        assert np.abs(frame.cam_from_world - pose).max() < 1e-12
        assert np.array_equal(frame.K, old.K)
        # A second JPEG of noise is not the first; upside down it would differ by 85.
        difference = frame.read_image().astype(float) - old.read_image()
        assert np.abs(difference).mean() < 10


def test_colmaps_model_gives_the_same_capture(
    capture: Capture, turned: list[np.ndarray], recipes: dict[str, Any], tmp_path: Path
) -> None:
    frames = list(capture.frames.values())
    K, unit = frames[0].K, 0.5  # m
    (tmp_path / "sparse").mkdir()
    (tmp_path / "images").symlink_to(frames[0].image_path.parent)
    numbers = f"{K[0, 0]} {K[1, 1]} {K[0, 2] + 0.5} {K[1, 2] + 0.5}"
    cameras = f"# Camera list\n1 PINHOLE 64 48 {numbers}\n"
    (tmp_path / "sparse" / "cameras.txt").write_text(cameras)
    lines = ["# Image list"]
    for frame, pose in zip(frames, turned, strict=True):
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
        t = " ".join(map(str, pose[:3, 3] / unit))
        lines += [f"{frame.id} {w} {x} {y} {z} {t} 1 {frame.image_path.name}", "3.5 4.5 -1"]
    (tmp_path / "sparse" / "images.txt").write_text("\n".join(lines))
    recipes["write_capture"](tmp_path / "new", *recipes["read_colmap"](tmp_path, unit))
    written = open_capture(tmp_path / "new")
    for frame, pose in zip(written.frames.values(), turned, strict=True):
        assert np.abs(frame.cam_from_world - pose).max() < 1e-12
        assert np.abs(frame.K - K).max() < 1e-12
