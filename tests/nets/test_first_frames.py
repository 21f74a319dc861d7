"""Depth that teaches nothing, and held-out scenes that are not: told before training begins."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from small_scannet import opened, tiny
from torch.utils.data import Subset

from deltas_nets.config.scannet import ScanNetConfig
from deltas_nets.errors import UserError
from deltas_nets.train.first_frames import check_frames, check_parallax, check_true_depth
from deltas_nets.train.fit import Start, fit

RANGE = (0.5, 10.0)
Depth = NDArray[np.uint16]


def rewrite(files: list[Path], change: Callable[[Depth], Depth]) -> None:
    """Change depth files, which may be links to others."""
    for file in files:
        depth = np.asarray(Image.open(file)).astype(np.uint16)
        file.unlink()
        Image.fromarray(change(depth)).save(file)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda depth: depth // 100, r"\(it is 0\.0\d+ to 0\.\d+ m\)"),  # steps of 0.1 m
        (lambda depth: np.zeros_like(depth), r"\(none is measured\)"),
    ],
)
def test_training_does_not_begin_without_depth_in_range(
    scannet_copy: Path, tmp_path: Path, change: Callable[[Depth], Depth], said: str
) -> None:
    rewrite(sorted(scannet_copy.glob("scans/*/depth/*.png")), change)
    with pytest.raises(UserError, match=f"10 of 10 frames looked at have no depth .* {said}"):
        fit(tiny(scannet_copy), tmp_path / "run", Start())
    assert not (tmp_path / "run").exists()


def test_most_frames_without_depth_in_range_are_a_warning(scannet_copy: Path) -> None:
    frames = sorted(scannet_copy.glob("scans/scene0000_00/depth/*.png"))
    split = opened(ScanNetConfig(root=str(scannet_copy), gap=2))
    said: list[str] = []
    rewrite(frames, np.zeros_like)  # half of all
    check_true_depth(split, RANGE, report=said.append)
    assert not said
    rewrite(sorted(scannet_copy.glob("scans/scene0706_01/depth/[2-5].png")), np.zeros_like)
    check_true_depth(split, RANGE, report=said.append)
    (warning,) = said
    assert warning.startswith("warning: ") and warning.endswith("is frame 2 of scene0000_00")


def test_a_damaged_depth_is_left_to_its_step(scannet_copy: Path) -> None:
    for file in scannet_copy.glob("scans/*/depth/*.png"):
        file.unlink()
        file.write_bytes(b"damaged")
    split = opened(ScanNetConfig(root=str(scannet_copy), gap=2))
    check_true_depth(split, RANGE)


def test_scenes_that_are_trained_and_validated_on_are_named(scannet_root: Path) -> None:
    config = ScanNetConfig(root=str(scannet_root), gap=2)
    learned, others, all_of_them = (opened(config, split) for split in ("train", "test", "all"))
    said: list[str] = []
    check_frames(learned, Subset(others, [0]), RANGE, report=said.append)
    assert not said
    check_frames(learned, Subset(all_of_them, [0]), RANGE, report=said.append)
    (warning,) = said
    assert "2 of 3 scenes (scene0000_00, scene0706_01) of --data.validation" in warning


def stand_still(scene: Path) -> None:
    for file in scene.glob("pose/*.txt"):
        pose = np.loadtxt(file)
        pose[:3, 3] = 1.0
        file.unlink()
        np.savetxt(file, pose)


def test_cameras_that_all_stand_are_refused_and_some_are_named(
    scannet_copy: Path, tmp_path: Path
) -> None:
    first, *others = sorted(scannet_copy.glob("scans/*"))
    stand_still(first)
    said: list[str] = []
    check_parallax(opened(ScanNetConfig(root=str(scannet_copy), gap=2)), report=said.append)
    (warning,) = said
    assert f"in one place in 1 of 2 scenes ({first.name})" in warning
    for scene in others:
        stand_still(scene)
    with pytest.raises(UserError, match="one place in all 2 scenes"):
        fit(tiny(scannet_copy), tmp_path / "run", Start())
    assert not (tmp_path / "run").exists()
