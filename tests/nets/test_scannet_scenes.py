"""Scenes in ScanNet's layout: lists of them, and what is read of each."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from small_scannet import overwrite, written_list

from deltas_nets.captures.opening import open_capture
from deltas_nets.datasets import scene_cache
from deltas_nets.datasets.scene_cache import read_scene_cached
from deltas_nets.datasets.scene_names import choose_scenes, find_scenes
from deltas_nets.datasets.scenes import LeftOut, left_out, read_scene, skipped
from deltas_nets.datasets.skip_list import SkipList, read_skip_list
from deltas_nets.errors import UserError


def test_a_skip_list_names_frames_ranges_and_scenes(tmp_path: Path) -> None:
    file = written_list(tmp_path, "# bad", "", "a 3", "a 5-6 # blur", "a\t6-8", "b  *", "c 0-0")
    skip = read_skip_list(file)
    assert np.flatnonzero(skip.listed("a", np.arange(12))).tolist() == [3, 5, 6, 7, 8]
    assert skip.listed("b", np.arange(4)).all() and skip.whole == {"b"}
    assert skip.listed("c", np.array([0, 1])).tolist() == [True, False]
    assert not skip.listed("d", np.arange(12)).any()
    assert not SkipList().listed("a", np.arange(12)).any()


@pytest.mark.parametrize(
    ("line", "what"),
    [
        ("a", "line 2 has 1 words"),
        ("a 1 2", "line 2 has 3 words"),
        ("a first", "line 2 has 'first'"),
        ("a 1-", "line 2 has '1-'"),
        ("a -3", "line 2 has '-3'"),
        ("a 9-5", "line 2 ends before it begins"),
    ],
)
def test_a_wrong_line_of_a_skip_list_is_named(tmp_path: Path, line: str, what: str) -> None:
    with pytest.raises(UserError, match=what) as error:
        read_skip_list(written_list(tmp_path, "a 0", line))
    assert "SCENE FIRST-LAST" in error.value.remedy


def test_splits_by_name_are_the_papers(scannet_root: Path) -> None:
    assert list(find_scenes(scannet_root)) == ["scene0000_00", "scene0706_01", "scene0707_00"]
    assert list(choose_scenes(scannet_root, "train").folders) == ["scene0000_00", "scene0706_01"]
    assert list(choose_scenes(scannet_root, "test").folders) == ["scene0707_00"]
    assert len(choose_scenes(scannet_root, "all").folders) == 3
    # The folder of the scans, and a scene itself, are roots as well.
    assert list(find_scenes(scannet_root / "scans_test")) == ["scene0707_00"]
    scene = scannet_root / "scans" / "scene0000_00"
    assert choose_scenes(scene, "all").folders == {"scene0000_00": scene}


def test_a_split_file_keeps_its_order_and_tells_what_is_missing(
    scannet_root: Path, tmp_path: Path
) -> None:
    gone = "scene0001_00  # gone"
    names = ("scene0707_00", gone, "", "scene0000_00", "scene0000_00", gone)
    chosen = choose_scenes(scannet_root, str(written_list(tmp_path, *names)))
    assert list(chosen.folders) == ["scene0707_00", "scene0000_00"]
    assert chosen.missing == ["scene0001_00"]


def test_a_scene_holds_what_a_capture_of_it_holds(scannet_root: Path) -> None:
    path = scannet_root / "scans" / "scene0000_00"
    scene, capture = read_scene(path), open_capture(path)
    assert list(scene.frames) == list(capture.frames)
    assert left_out(scene) == LeftOut()
    assert scene.fingerprint() == capture.fingerprint()


def test_unusable_frames_are_left_out_and_counted(scannet_copy: Path) -> None:
    path = scannet_copy / "scans" / "scene0000_00"
    overwrite(path / "pose" / "0.txt", "-inf " * 16)
    (path / "pose" / "1.txt").unlink()
    overwrite(path / "pose" / "2.txt", "1 0 0 0")
    overwrite(path / "pose" / "3.txt", "2 0 0 0  0 2 0 0  0 0 2 0  0 0 0 1")
    (path / "depth" / "4.png").unlink()
    scene = read_scene(path)
    assert list(scene.frames) == ["5", "6", "7", "8"]
    assert left_out(scene) == LeftOut(lost=3, not_rigid=1, without_depth=1)
    fewer = skipped(scene, np.array([False, True, False, True]))
    assert list(fewer.frames) == ["5", "7"]
    assert fewer.frames.at(1).image_path == path / "color" / "7.png"
    assert left_out(fewer) + LeftOut(listed=1) == LeftOut(3, 1, 1, listed=3)


def test_poses_are_read_once_and_again_when_they_change(
    scannet_copy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, cache = scannet_copy / "scans" / "scene0000_00", tmp_path / "cache"
    (path / "depth" / "0.png").unlink()
    overwrite(path / "pose" / "1.txt", "1 0 0 0")
    first = read_scene_cached(path, cache)
    with monkeypatch.context() as patch:
        patch.setattr(scene_cache, "read_scene", None)
        again = read_scene_cached(path, cache)
    assert again.fingerprint() == first.fingerprint()
    assert left_out(again) == left_out(first) == LeftOut(lost=1, without_depth=1)
    assert {id: str(lost.error) for id, lost in again.lost.items()} == {
        id: str(lost.error) for id, lost in first.lost.items()
    }
    for ours, theirs in zip(again.frames.values(), first.frames.values(), strict=True):
        for field in dataclasses.fields(ours):
            assert np.array_equal(getattr(ours, field.name), getattr(theirs, field.name))
    (file,) = cache.iterdir()
    file.write_bytes(file.read_bytes()[:100])
    assert list(read_scene_cached(path, cache).frames) == list(first.frames)
    overwrite(path / "pose" / "3.txt", "nan " * 16)
    assert list(read_scene_cached(path, cache).frames) == ["2", "4", "5", "6", "7", "8"]


def test_images_of_another_size_in_the_same_files_are_seen(
    scannet_copy: Path, tmp_path: Path
) -> None:
    path, cache = scannet_copy / "scans" / "scene0000_00", tmp_path / "cache"
    for image in (path / "color").iterdir():
        overwrite(image, image.read_bytes())
    height, width = read_scene_cached(path, cache).frames.at(0).image_size
    for image in (path / "color").iterdir():
        Image.open(image).resize((2 * width, 2 * height)).save(image)
    with pytest.raises(UserError, match="intrinsics are of another resolution"):
        read_scene_cached(path, cache)
