"""Which frames of a scene are looked at together, by gap or by baseline."""

import errno
import itertools
import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from small_scannet import SCANNET, SIZE, opened, overwrite, view_sets, written_list

from deltas_nets.captures.frame import FloatArray, Frame
from deltas_nets.captures.frames import Frames
from deltas_nets.captures.opening import open_capture
from deltas_nets.captures.view_sets import ViewSet
from deltas_nets.config.scannet import ScanNetConfig
from deltas_nets.datasets.view_rules import ByBaseline, ByGap
from deltas_nets.errors import UserError


def frames_of(ids: list[int], cam_from_world: FloatArray | None = None) -> Frames:
    """Frames without files."""
    poses = np.tile(np.eye(4), (len(ids), 1, 1)) if cam_from_world is None else cam_from_world
    return Frames.of(
        Frame(str(id), Path(f"{id}.jpg"), SIZE, np.eye(3), pose)
        for id, pose in zip(ids, poses, strict=True)
    )


# Frames 0 to N - 1, a few of which are not usable.
frame_numbers = st.tuples(st.integers(1, 40), st.sets(st.integers(0, 39), max_size=6)).map(
    lambda drawn: sorted(set(range(drawn[0])) - drawn[1])
)


@given(ids=frame_numbers, gap=st.integers(1, 5), num_views=st.integers(2, 7))
def test_by_gap_every_view_set_is_exact_and_none_is_forgotten(
    ids: list[int], gap: int, num_views: int
) -> None:
    rule, frames = ByGap(gap, num_views), frames_of(ids)
    anchors = rule.anchors(frames)
    for anchor in anchors:
        sources = [ids[position] for position in rule.sources(frames, anchor)]
        seen = sorted([ids[anchor], *sources])
        assert len(seen) == num_views and set(seen) <= set(ids)
        assert {after - before for before, after in itertools.pairwise(seen)} == {gap}
        # As many before the anchor as after it, or one more; nearest first.
        before = sum(source < ids[anchor] for source in sources)
        assert before == num_views // 2
        away = [abs(source - ids[anchor]) for source in sources]
        assert away == sorted(away)
    past, future = num_views // 2, (num_views - 1) // 2
    wanted = [id for id in ids if all(id + gap * k in ids for k in range(-past, future + 1))]
    assert [ids[anchor] for anchor in anchors] == wanted


def test_gaps_are_the_papers() -> None:
    gaps = [ScanNetConfig().gap_of(num_views) for num_views in (2, 3, 4, 5, 7)]
    assert gaps == [20, 20, 15, 12, 10]
    assert ScanNetConfig(gap=3).gap_of(7) == 3
    assert ScanNetConfig().gap_of(13) == 5


def rigid(turn: FloatArray, centre: FloatArray) -> FloatArray:
    """cam_from_world of a camera."""
    cam_from_world = np.eye(4)
    cam_from_world[:3, :3] = cv2.Rodrigues(turn)[0]
    cam_from_world[:3, 3] = -cam_from_world[:3, :3] @ centre
    return cam_from_world


places = st.tuples(*[st.floats(-0.3, 0.3)] * 6).map(np.array)


@given(cameras=st.lists(places, min_size=1, max_size=12), num_views=st.integers(2, 4))
def test_by_baseline_every_source_is_in_range_and_no_anchor_is_forgotten(
    cameras: list[FloatArray], num_views: int
) -> None:
    low, high, limit = 0.1, 0.4, 0.3
    poses = np.stack([rigid(camera[:3], 7 + camera[3:]) for camera in cameras])
    rule = ByBaseline(low, high, limit, num_views)
    frames = frames_of(list(range(0, 3 * len(cameras), 3)), poses)

    def qualifies(one: int, other: int) -> bool:
        relative = poses[other] @ np.linalg.inv(poses[one])
        angle = np.linalg.norm(cv2.Rodrigues(relative[:3, :3])[0])
        distance = np.linalg.norm(cameras[one][3:] - cameras[other][3:])
        margin = 1e-6  # hypothesis likes limits; there, rounding may decide
        return bool(low - margin < distance < high + margin and angle < limit + margin)

    anchors = rule.anchors(frames).tolist()
    for anchor in anchors:
        sources = rule.sources(frames, anchor)
        assert len(set(sources)) == num_views - 1
        assert all(qualifies(anchor, source) for source in sources)
        assert sources == rule.sources(frames, anchor)
    others = [sum(qualifies(a, b) for b in range(len(cameras))) for a in range(len(cameras))]
    assert set(anchors) <= {a for a, count in enumerate(others) if count >= num_views - 1}
    sure = ByBaseline(low - 1e-5, high + 1e-5, limit + 1e-5, num_views).anchors(frames).tolist()
    assert {a for a, count in enumerate(others) if count >= num_views - 1} <= set(sure)


def test_sources_by_baseline_stand_on_both_sides() -> None:
    places = [np.array([x, 0, 0.0]) for x in (-0.21, -0.2, 0, 0.2, 0.21)]
    frames = frames_of([1, 2, 3, 4, 5], np.stack([rigid(np.zeros(3), place) for place in places]))
    sources = ByBaseline(0.1, 0.3, 0.1, 3).sources(frames, 2)
    assert sorted(np.sign([places[source][0] for source in sources])) == [-1, 1]


def test_view_sets_stay_within_a_scene_and_off_skipped_frames(
    scannet_copy: Path, tmp_path: Path
) -> None:
    overwrite(scannet_copy / "scans" / "scene0706_01" / "pose" / "8.txt", "nan " * 16)
    skip = written_list(tmp_path, "scene0000_00 3", "scene0707_00 *")
    said: list[str] = []
    config = replace(SCANNET, root=str(scannet_copy), skip=str(skip))
    tuples = opened(config, "all", report=said.append)
    whole = [("scene0000_00", anchor) for anchor in (2, 4, 6)]  # not 1, 3, 5: they need frame 3
    whole += [("scene0706_01", anchor) for anchor in (2, 3, 4, 5)]  # not 6: it needs frame 8
    wanted = [
        (name, ViewSet(str(anchor), (str(anchor - 2), str(anchor + 2)))) for name, anchor in whole
    ]
    # Frame 3 lies between 2 and 4, which are two apart without it.
    assert view_sets(tuples) == wanted
    assert view_sets(opened(config, "all")) == wanted
    (line,) = said
    assert "7 times 3 views 2 frames apart; 16 usable frames in 2 scenes" in line
    assert "1 without a finite pose" in line and "1 listed, 1 scenes listed as a whole" in line


def test_scenes_that_are_not_there_are_counted(scannet_root: Path, tmp_path: Path) -> None:
    split = written_list(tmp_path, "scene0000_00", "scene0300_00", "scene0301_00")
    said: list[str] = []
    opened(replace(SCANNET, root=str(scannet_root)), str(split), report=said.append)
    assert said[1] == "2 of its 3 scenes are not there: scene0300_00, scene0301_00"


def test_a_pose_that_is_no_file_costs_its_frame(scannet_copy: Path) -> None:
    file = scannet_copy / "scans" / "scene0706_01" / "pose" / "3.txt"
    file.unlink()
    file.mkdir()
    said: list[str] = []
    opened(replace(SCANNET, root=str(scannet_copy)), report=said.append)
    assert "1 without a finite pose" in said[0]


def test_a_number_that_is_too_large_is_told(scannet_copy: Path) -> None:
    scene = scannet_copy / "scans" / "scene0706_01"
    for place in ("color", "depth", "pose"):
        (file,) = (scene / place).glob("8.*")
        file.rename(file.with_stem(str(2**63)))
    with pytest.raises(UserError, match=r"frame 9223372036854775808: .*too large.*scene0706_01"):
        opened(replace(SCANNET, root=str(scannet_copy)))


def test_what_the_system_does_not_read_is_named(
    scannet_root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    listed = Path.iterdir

    def forbidden(folder: Path) -> Iterator[Path]:
        if folder.name == "pose":
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(folder))
        return listed(folder)

    monkeypatch.setattr(Path, "iterdir", forbidden)
    with pytest.raises(UserError, match=r"scenes cannot be read .*denied.*/pose: check"):
        opened(replace(SCANNET, root=str(scannet_root)))


def test_view_sets_by_baseline_come_from_the_config(scannet_root: Path) -> None:
    config = ScanNetConfig(
        root=str(scannet_root), tuples="baseline", baseline=(0.05, 0.3), max_rotation=25
    )
    tuples = opened(config)
    assert tuples.rule == ByBaseline(0.05, 0.3, np.radians(25), 3)
    for name, (anchor, sources) in view_sets(tuples):
        capture = open_capture(scannet_root / "scans" / name)
        centres = [
            np.linalg.inv(capture.frame(id).cam_from_world)[:3, 3] for id in (anchor, *sources)
        ]
        for centre in centres[1:]:
            assert 0.05 <= np.linalg.norm(centre - centres[0]) <= 0.3
