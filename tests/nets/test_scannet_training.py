"""Training on scenes in ScanNet's layout: lists, tuples of frames, items, and the command."""

import dataclasses
import itertools
import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from run_command import Run, assert_one_line, runner
from run_fit import assert_same_state, logged

from deltas_geom import PosedViews, in_image, project, unproject
from deltas_nets import cli
from deltas_nets.atomic_files import write_depth_png
from deltas_nets.cli_training import Train
from deltas_nets.config import (
    TRAIN_CONFIGS,
    DataConfig,
    DetectorConfig,
    MatcherConfig,
    NetworkConfig,
    TrainConfig,
)
from deltas_nets.data import scannet_scenes
from deltas_nets.data.capture import FloatArray, open_capture
from deltas_nets.data.frame_tuples import ByBaseline, ByGap
from deltas_nets.data.posed_images import PosedImages
from deltas_nets.data.sample import depth_at_image, load_views
from deltas_nets.data.scannet_cache import read_scene_cached
from deltas_nets.data.scannet_config import ScanNetConfig
from deltas_nets.data.scannet_scenes import LeftOut, Scene, read_scene
from deltas_nets.data.scannet_tuples import ScanNetTuples, open_scannet
from deltas_nets.data.scene_names import choose_scenes, find_scenes
from deltas_nets.data.skip_list import SkipList, read_skip_list
from deltas_nets.data.synthetic import render_room
from deltas_nets.data.view_sets import ViewSet
from deltas_nets.errors import UserError
from deltas_nets.pretrained import read_metadata
from deltas_nets.targets import read_nearest
from deltas_nets.train.batches import BatchMaker, Part, room_loader, validation_data
from deltas_nets.train.fit import Start, fit

SIZE = (48, 64)
FRAMES = 9


def write_scene(folder: Path, room: PosedImages) -> None:
    """A rendered room as ScanNet would have exported it."""
    for name in ("color", "depth", "pose", "intrinsic"):
        (folder / name).mkdir(parents=True)
    np.savetxt(folder / "intrinsic" / "intrinsic_color.txt", room.views.K[0].numpy(), fmt="%.6f")
    world_from_cam = torch.linalg.inv(room.views.cam_from_world.double())
    for id in range(len(room.images)):
        pixels = room.images[id].permute(1, 2, 0).numpy()
        Image.fromarray(pixels).save(folder / "color" / f"{id}.png")
        write_depth_png(folder / "depth" / f"{id}.png", room.depth[id].numpy())
        np.savetxt(folder / "pose" / f"{id}.txt", world_from_cam[id].numpy(), fmt="%.9f")


@pytest.fixture(scope="session")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three scenes of 9 frames, two to train on and one to test on; never written to."""
    root = tmp_path_factory.mktemp("scannet")
    room = render_room(0, num_views=FRAMES, image_size=(96, 128))
    # One room, its frames in another order each time: rendering takes longer than the tests.
    for turn, name in enumerate(
        ("scans/scene0000_00", "scans/scene0706_01", "scans_test/scene0707_00")
    ):
        order = torch.arange(FRAMES).roll(4 * turn)
        views = PosedViews(*(tensor[order] for tensor in room.views))
        write_scene(root / name, PosedImages(room.images[order], views, room.depth[order]))
    return root


@pytest.fixture
def root(written: Path, tmp_path: Path) -> Path:
    """A copy to break; files that are not touched stay links."""
    copy = tmp_path / "scannet"
    for file in written.rglob("*.*"):
        target = copy / file.relative_to(written)
        target.parent.mkdir(parents=True, exist_ok=True)
        target.symlink_to(file)
    return copy


def overwrite(file: Path, content: str | bytes) -> None:
    file.unlink()  # or the link would be followed
    file.write_bytes(content if isinstance(content, bytes) else content.encode())


def written_list(tmp_path: Path, *lines: str, name: str = "list.txt") -> Path:
    file = tmp_path / name
    file.write_text("\n".join(lines))
    return file


def scene_of(ids: list[int], cam_from_world: FloatArray | None = None) -> Scene:
    """A scene without files."""
    poses = np.tile(np.eye(4), (len(ids), 1, 1)) if cam_from_world is None else cam_from_world
    names = np.array([str(id).encode() for id in ids], dtype=np.bytes_)
    return Scene(
        Path("nowhere"), SIZE, np.eye(3), None, np.array(ids), poses, names, names, LeftOut()
    )


# Skip lists and splits.


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


def test_splits_by_name_are_the_papers(written: Path) -> None:
    assert list(find_scenes(written)) == ["scene0000_00", "scene0706_01", "scene0707_00"]
    assert list(choose_scenes(written, "train").folders) == ["scene0000_00", "scene0706_01"]
    assert list(choose_scenes(written, "test").folders) == ["scene0707_00"]
    assert len(choose_scenes(written, "all").folders) == 3
    # The folder of the scans, and a scene itself, are roots as well.
    assert list(find_scenes(written / "scans_test")) == ["scene0707_00"]
    scene = written / "scans" / "scene0000_00"
    assert choose_scenes(scene, "all").folders == {"scene0000_00": scene}


def test_a_split_file_keeps_its_order_and_tells_what_is_missing(
    written: Path, tmp_path: Path
) -> None:
    gone = "scene0001_00  # gone"
    names = ("scene0707_00", gone, "", "scene0000_00", "scene0000_00", gone)
    chosen = choose_scenes(written, str(written_list(tmp_path, *names)))
    assert list(chosen.folders) == ["scene0707_00", "scene0000_00"]
    assert chosen.missing == ["scene0001_00"]


def test_splits_that_cannot_be_used_are_refused(written: Path, tmp_path: Path) -> None:
    def refuse(root: Path, split: object, match: str) -> None:
        with pytest.raises(UserError, match=match):
            choose_scenes(root, str(split))

    refuse(tmp_path / "none", "all", r"no such folder, .*none: name the folder that holds scans/")
    refuse(tmp_path, "all", "no scene in the folder")
    refuse(written / "scans_test", "train", "none of the 1 scenes .scene0707_00. is in the split t")
    refuse(written, written_list(tmp_path, "# nothing"), "the split names no scene")
    refuse(written, written_list(tmp_path, "scene0009_00"), "none of the 1 scenes of .* is there")
    refuse(written, written_list(tmp_path, "two words"), "line 1 of the split has 2 words")
    refuse(written, tmp_path / "none.txt", r"cannot be read .*--data.split.*train, test and all")


# Scenes as arrays.


def test_a_scene_holds_what_a_capture_of_it_holds(written: Path) -> None:
    path = written / "scans" / "scene0000_00"
    scene, capture = read_scene(path), open_capture(path)
    assert scene.ids.tolist() == list(capture.frames)
    assert scene.left_out == LeftOut()
    for position, id in enumerate(scene.ids):
        ours, theirs = scene.frame(position), capture.frame(int(id))
        for field in dataclasses.fields(ours):
            assert np.array_equal(getattr(ours, field.name), getattr(theirs, field.name))


def test_unusable_frames_are_left_out_and_counted(root: Path) -> None:
    path = root / "scans" / "scene0000_00"
    overwrite(path / "pose" / "0.txt", "-inf " * 16)
    (path / "pose" / "1.txt").unlink()
    overwrite(path / "pose" / "2.txt", "1 0 0 0")
    overwrite(path / "pose" / "3.txt", "2 0 0 0  0 2 0 0  0 0 2 0  0 0 0 1")
    (path / "depth" / "4.png").unlink()
    scene = read_scene(path)
    assert scene.ids.tolist() == [5, 6, 7, 8]
    assert scene.left_out == LeftOut(lost=3, not_rigid=1, without_depth=1)
    skipped = scene.without(np.array([False, True, False, True]))
    assert skipped.ids.tolist() == [5, 7]
    assert skipped.frame(1).image_path == path / "color" / "7.png"
    assert skipped.left_out + LeftOut(listed=1) == LeftOut(3, 1, 1, listed=3)


def test_poses_are_read_once_and_again_when_they_change(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, cache = root / "scans" / "scene0000_00", tmp_path / "cache"
    (path / "depth" / "0.png").unlink()
    first = read_scene_cached(path, cache)
    with monkeypatch.context() as patch:
        patch.setattr(scannet_scenes, "read_pose", None)
        again = read_scene_cached(path, cache)
    for name, value in first._asdict().items():
        assert np.array_equal(getattr(again, name), value), name
        assert type(getattr(again, name)) is type(value), name
    (file,) = cache.iterdir()
    file.write_bytes(file.read_bytes()[:100])
    assert read_scene_cached(path, cache).ids.tolist() == first.ids.tolist()
    overwrite(path / "pose" / "3.txt", "nan " * 16)
    assert read_scene_cached(path, cache).ids.tolist() == [1, 2, 4, 5, 6, 7, 8]


# Which frames go together.

# Frames 0 to N - 1, a few of which are not usable.
frame_numbers = st.tuples(st.integers(1, 40), st.sets(st.integers(0, 39), max_size=6)).map(
    lambda drawn: sorted(set(range(drawn[0])) - drawn[1])
)


@given(ids=frame_numbers, gap=st.integers(1, 5), num_views=st.integers(2, 7))
def test_by_gap_every_tuple_is_exact_and_none_is_forgotten(
    ids: list[int], gap: int, num_views: int
) -> None:
    rule, scene = ByGap(gap, num_views), scene_of(ids)
    anchors = rule.anchors(scene)
    for anchor in anchors:
        sources = [ids[position] for position in rule.sources(scene, anchor)]
        frames = sorted([ids[anchor], *sources])
        assert len(frames) == num_views and set(frames) <= set(ids)
        assert {after - before for before, after in itertools.pairwise(frames)} == {gap}
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
    scene = scene_of(list(range(0, 3 * len(cameras), 3)), poses)

    def qualifies(one: int, other: int) -> bool:
        relative = poses[other] @ np.linalg.inv(poses[one])
        angle = np.linalg.norm(cv2.Rodrigues(relative[:3, :3])[0])
        distance = np.linalg.norm(cameras[one][3:] - cameras[other][3:])
        margin = 1e-6  # hypothesis likes limits; there, rounding may decide
        return bool(low - margin < distance < high + margin and angle < limit + margin)

    anchors = rule.anchors(scene).tolist()
    for anchor in anchors:
        sources = rule.sources(scene, anchor)
        assert len(set(sources)) == num_views - 1
        assert all(qualifies(anchor, source) for source in sources)
        assert sources == rule.sources(scene, anchor)
    others = [sum(qualifies(a, b) for b in range(len(cameras))) for a in range(len(cameras))]
    assert set(anchors) <= {a for a, count in enumerate(others) if count >= num_views - 1}
    sure = ByBaseline(low - 1e-5, high + 1e-5, limit + 1e-5, num_views).anchors(scene).tolist()
    assert {a for a, count in enumerate(others) if count >= num_views - 1} <= set(sure)


def test_sources_by_baseline_stand_on_both_sides() -> None:
    places = [np.array([x, 0, 0.0]) for x in (-0.21, -0.2, 0, 0.2, 0.21)]
    scene = scene_of([1, 2, 3, 4, 5], np.stack([rigid(np.zeros(3), place) for place in places]))
    sources = ByBaseline(0.1, 0.3, 0.1, 3).sources(scene, 2)
    assert sorted(np.sign([places[source][0] for source in sources])) == [-1, 1]


SCANNET = ScanNetConfig(gap=2)


def opened(config: ScanNetConfig, split: str = "train", **more: object) -> ScanNetTuples:
    return open_scannet(config, split, **{"num_views": 3, "image_size": SIZE, **more})  # type: ignore[arg-type]


def view_sets(tuples: ScanNetTuples) -> list[tuple[str, ViewSet]]:
    return [tuples.view_set(index) for index in range(len(tuples))]


def test_tuples_stay_within_a_scene_and_off_skipped_frames(root: Path, tmp_path: Path) -> None:
    overwrite(root / "scans" / "scene0706_01" / "pose" / "8.txt", "nan " * 16)
    skip = written_list(tmp_path, "scene0000_00 3", "scene0707_00 *")
    said: list[str] = []
    config = replace(SCANNET, root=str(root), skip=str(skip))
    tuples = opened(config, "all", report=said.append)
    whole = [("scene0000_00", anchor) for anchor in (2, 4, 6)]  # not 1, 3, 5: they need frame 3
    whole += [("scene0706_01", anchor) for anchor in (2, 3, 4, 5)]  # not 6: it needs frame 8
    wanted = [(name, ViewSet(anchor, (anchor - 2, anchor + 2))) for name, anchor in whole]
    # Frame 3 lies between 2 and 4, which are two apart without it.
    assert view_sets(tuples) == wanted
    assert view_sets(opened(config, "all")) == wanted
    (line,) = said
    assert "7 times 3 views 2 frames apart; 16 usable frames in 2 scenes" in line
    assert "1 without a finite pose" in line and "1 listed, 1 scenes listed as a whole" in line


def test_scenes_that_are_not_there_are_counted(written: Path, tmp_path: Path) -> None:
    split = written_list(tmp_path, "scene0000_00", "scene0300_00", "scene0301_00")
    said: list[str] = []
    opened(replace(SCANNET, root=str(written)), str(split), report=said.append)
    assert said[1] == "2 of its 3 scenes are not there: scene0300_00, scene0301_00"


def test_what_the_system_does_not_read_is_named(root: Path) -> None:
    file = root / "scans" / "scene0706_01" / "pose" / "3.txt"
    file.unlink()
    file.mkdir()
    with pytest.raises(UserError, match=r"scenes cannot be read .*directory.*pose/3.txt: check"):
        opened(replace(SCANNET, root=str(root)))


def test_tuples_by_baseline_come_from_the_config(written: Path) -> None:
    config = ScanNetConfig(
        root=str(written), tuples="baseline", baseline=(0.05, 0.3), max_rotation=25
    )
    tuples = opened(config)
    assert tuples.rule == ByBaseline(0.05, 0.3, np.radians(25), 3)
    for name, (anchor, sources) in view_sets(tuples):
        capture = open_capture(written / "scans" / name)
        centres = [
            np.linalg.inv(capture.frame(id).cam_from_world)[:3, 3] for id in (anchor, *sources)
        ]
        for centre in centres[1:]:
            assert 0.05 <= np.linalg.norm(centre - centres[0]) <= 0.3


# Items and batches.


def test_an_item_is_the_frames_at_the_training_size(written: Path) -> None:
    tuples = opened(replace(SCANNET, root=str(written)))
    item = tuples[5]
    name, (anchor, sources) = tuples.view_set(5)
    capture = open_capture(written / "scans" / name)
    frames = [capture.frame(id) for id in (anchor, *sources)]
    images, views = load_views(frames, work_size=SIZE)
    assert item.images.dtype == torch.uint8 and item.images.shape == (3, 3, *SIZE)
    assert torch.equal(item.images.float() / 255, images)
    assert torch.equal(item.views.cam_from_world, views.cam_from_world)
    # Half of 96 x 128: the centre of a new pixel lies between two old ones.
    old, new = torch.from_numpy(frames[0].K.copy()), item.views.K[0].double()
    torch.testing.assert_close(new[:2, :2], old[:2, :2] / 2, rtol=0, atol=1e-5)
    torch.testing.assert_close(new[:2, 2], (old[:2, 2] + 0.5) / 2 - 0.5, rtol=0, atol=1e-5)
    assert item.depth.dtype == torch.float32 and item.depth.shape == (3, *SIZE)
    full = torch.from_numpy(frames[0].read_depth())
    near = torch.stack([full[i::2, j::2] for i in (0, 1) for j in (0, 1)])
    assert ((item.depth[0] - near).abs().amin(dim=0) == 0).all()


def test_views_of_an_item_agree_on_the_scene_at_any_size(written: Path) -> None:
    def share(size: tuple[int, int]) -> float:
        tuples = opened(replace(SCANNET, root=str(written)), image_size=size)
        return float(np.mean([agreeing_share(tuples[index]) for index in range(5)]))

    as_rendered = share((96, 128))
    assert as_rendered > 0.98
    for size in ((48, 64), (40, 64), (64, 56)):
        assert share(size) > as_rendered - 0.05


def agreeing_share(item: PosedImages, *, within: float = 0.03) -> float:
    """Share of the anchor's pixels whose depth is that of source 1, of those it sees."""
    height, width = item.depth.shape[-2:]
    pixels = torch.cartesian_prod(torch.arange(4.0, width - 4, 3), torch.arange(4.0, height - 4, 3))
    depth = read_nearest(item.depth[:1], pixels[None])
    points = unproject(item.views.select(0), pixels[None], depth)[0]
    there = project(item.views.select(1), points)
    surface = read_nearest(item.depth[1:2], there.pixels)[0]
    inside = in_image(there.pixels[0], image_size=(height, width))
    used = inside & there.in_front[0] & (surface > 0) & (depth[0] > 0)
    ratio = there.depth[0] / surface.clamp_min(1e-6)
    seen = used & (ratio < 1 + within)  # not hidden by something nearer
    assert seen.sum() > 0.5 * used.sum()
    return float((ratio[seen] > 1 - within).float().mean())


def test_unknown_depth_is_zero(root: Path) -> None:
    file = root / "scans" / "scene0000_00" / "depth" / "2.png"
    millimetres = np.full((96, 128), 2000, dtype=np.uint16)
    millimetres[:48], millimetres[48:, :64] = 0, 65535
    file.unlink()
    Image.fromarray(millimetres).save(file)
    depth = opened(replace(SCANNET, root=str(root)))[0].depth[0]
    assert (depth[:24] == 0).all() and (depth[24:, :32] == 0).all()
    assert (depth[24:, 32:] == 2).all()


def test_depth_at_the_work_size_is_read_at_the_same_ray(written: Path) -> None:
    frame = open_capture(written / "scans" / "scene0000_00").frame(0)
    assert np.array_equal(depth_at_image(frame), depth_at_image(frame, work_size=(96, 128)))
    full, third = depth_at_image(frame), depth_at_image(frame, work_size=(32, 42))
    rows = np.floor((np.arange(32) + 0.5) * 3).astype(int)
    columns = np.floor((np.arange(42) + 0.5) * 128 / 42 - 1e-6).astype(int)
    assert np.array_equal(third, full[rows[:, None], columns])


TINY = TrainConfig(
    network=NetworkConfig(
        detector=DetectorConfig(num_keypoints=48), matcher=MatcherConfig(num_samples=32)
    ),
    data=DataConfig(source="scannet", height=48, width=64, workers=0),
    sizes=((48, 64),),
    steps=4,
    batch_size=2,
    warmup=2,
    min_views=3,
    max_views=3,
    num_keypoints=48,
)


def tiny(root: Path, **more: object) -> TrainConfig:
    scannet = replace(SCANNET, root=str(root), **more)  # type: ignore[arg-type]
    return replace(TINY, data=replace(TINY.data, scannet=scannet))


def test_batches_keep_the_anchor_and_know_its_depth(written: Path) -> None:
    config = replace(tiny(written), min_views=2, max_views=4, pose_noise=(0.01, 0.01))
    counts = set()
    for step, tuples in enumerate(room_loader(config, start=0, stop=8)):
        batch = BatchMaker(config)(tuples, step)
        counts.add(batch.images.shape[1])
        assert batch.images.dtype == torch.float32 and batch.images.max() <= 1
        identity = torch.eye(4).expand(2, 4, 4)
        torch.testing.assert_close(batch.true_views.cam_from_world[:, 0], identity)
        torch.testing.assert_close(batch.views.cam_from_world[:, 0], identity)
        for index in range(2):
            anchor = tuples.depth[index, 0]
            depth = batch.depth[index, 0]
            assert torch.equal(depth, anchor) or torch.equal(depth, anchor.flip(-1))
            views = PosedViews(*(tensor[index] for tensor in batch.true_views))
            item = PosedImages(batch.images[index], views, batch.depth[index])
            assert agreeing_share(item, within=0.1) > 0.5
    assert counts == {2, 3, 4}


def test_processes_and_workers_share_a_step(written: Path) -> None:
    config = replace(tiny(written), batch_size=4)
    whole = list(room_loader(config, start=1, stop=4))
    parts = [list(room_loader(config, start=1, stop=4, part=Part(n, 2))) for n in (0, 1)]
    reading = replace(config, data=replace(config.data, workers=2))
    ahead = list(room_loader(reading, start=1, stop=4))
    late = list(room_loader(config, start=3, stop=4))
    for index, batch in enumerate(whole):
        halves = torch.cat([part[index].images for part in parts])
        assert torch.equal(halves, batch.images)
        assert torch.equal(ahead[index].images, batch.images)
    assert torch.equal(late[0].images, whole[2].images)
    assert torch.equal(late[0].depth, whole[2].depth)
    assert not torch.equal(whole[0].images, whole[1].images)


@pytest.mark.parametrize("workers", [0, 1])
def test_an_image_that_cannot_be_read_is_an_error_of_one_line(root: Path, workers: int) -> None:
    for file in (root / "scans").rglob("color/4.png"):
        overwrite(file, file.read_bytes()[:500])
    config = tiny(root)
    config = replace(config, data=replace(config.data, workers=workers))
    with pytest.raises(UserError, match=r"cannot be decoded.*4\.png: copy the file again"):
        list(room_loader(config, start=0, stop=4))


def test_validation_tuples_are_spread_over_the_split(written: Path) -> None:
    assert validation_data(tiny(written)) is None
    few = validation_data(tiny(written, validation="all", validation_tuples=3))
    assert few is not None
    frames = few.dataset
    assert isinstance(frames, ScanNetTuples)
    assert [frames.view_set(index)[0][:9] for index in few.indices] == [
        "scene0000",
        "scene0706",
        "scene0707",
    ]
    every = validation_data(tiny(written, validation="test"))
    assert every is not None and len(every) == 5


# Training.


def test_a_resumed_run_equals_an_unbroken_one(written: Path, tmp_path: Path) -> None:
    config = replace(tiny(written, validation="test", validation_tuples=2), steps=2)
    said: list[str] = []
    fit(config, tmp_path / "whole", Start(), log_every=1, report=said.append)
    fit(config, tmp_path / "broken", Start(), stop=1, log_every=1)
    fit(config, tmp_path / "broken", Start(resume=True), log_every=1)
    assert_same_state(tmp_path / "whole", tmp_path / "broken")
    assert logged(tmp_path / "whole") == logged(tmp_path / "broken")
    assert "--data.split train: 10 times 3 views" in said[0]
    assert "--data.validation test: 5 times 3 views" in said[1]
    lines = (tmp_path / "whole" / "log.jsonl").read_text().splitlines()
    (metrics,) = [json.loads(line)["validation"] for line in lines if "validation" in line]
    assert 0 < metrics["abs_rel"] < 10


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Run:
    """Run `deltas` with arguments, in this process."""
    return runner(monkeypatch, capfd)


SMALL = [
    *("--steps", 2, "--sizes", 48, 64, "--data.height", 48, "--data.width", 64),
    *("--batch-size", 2, "--num-keypoints", 48, "--data.workers", 0, "--encoder", "none"),
    *("--min-views", 3, "--max-views", 3, "--network.matcher.num-samples", 32),
]


def test_the_command_trains_and_its_weights_name_no_folder(
    run: Run, written: Path, tmp_path: Path
) -> None:
    split = written_list(tmp_path, "scene0000_00", "scene0706_01", name="mine.txt")
    skip = written_list(tmp_path, "scene0000_00 0", name="bad.txt")
    options = ["--data.split", split, "--data.skip", skip, "--data.gap", 2]
    options += ["--data.validation", split, "--data.validation-tuples", 2]
    out, cache = tmp_path / "run", tmp_path / "cache"
    frames = ["--data", "scannet", "--root", written, "--data.cache", cache]
    done = run("train", "--out", out, *frames, *options, *SMALL)
    assert done.code == 0, done.err
    said = " ".join(done.out.split())
    assert "--data.split mine.txt: 9 times 3 views 2 frames apart" in said
    assert len(list(cache.iterdir())) == 2
    recorded = json.loads((out / "config.json").read_text())["data"]["scannet"]
    assert recorded["root"] == str(written) and recorded["split"] == str(split)
    metadata = read_metadata(out / "weights.safetensors")
    assert metadata["data"] == "ScanNet, scenes of mine.txt"
    assert "ScanNet" in metadata["licence"]
    told = json.loads(metadata["train"])["data"]
    assert told["scannet"]["root"] is None and told["cache"] is None
    assert told["scannet"]["split"] == told["scannet"]["validation"] == "mine.txt"
    assert told["scannet"]["skip"] == "bad.txt" and told["scannet"]["gap"] == 2
    assert not [value for value in metadata.values() if "/" in value.replace("SVD/", "")]
    # Scenes may have moved; what is trained on may not change.
    moved = ["--data", "scannet", "--root", written / "scans" / ".."]
    assert run("train", "--out", out, "--resume", *moved).code == 0
    assert_one_line(run("train", "--out", out, "--resume", *moved, "--data.gap", 3), "gap 2, not 3")


def test_the_papers_network_trains_by_the_papers_command(
    run: Run, written: Path, tmp_path: Path
) -> None:
    small = ["--steps", 1, "--sizes", 48, 64, "--data.height", 48, "--data.width", 64]
    small += ["--batch-size", 2, "--num-keypoints", 48, "--data.workers", 0, "--data.gap", 2]
    small += ["--data.validation", "test", "--data.validation-tuples", 1]
    paper = ["--config", "deltas-vgg9", "--data", "scannet", "--root", written]
    done = run("train", "--out", tmp_path / "run", *paper, *small)
    assert done.code == 0, done.err
    (line, _) = (tmp_path / "run" / "log.jsonl").read_text().splitlines()
    assert np.isfinite(json.loads(line)["total"])


def test_the_papers_schedule_is_the_default() -> None:
    arguments = ["train", "--out", "x", "--config", "deltas-resnet50", "--data", "scannet"]
    command = cli._parse([*arguments, "--root", "somewhere"])
    assert isinstance(command, Train)
    paper = TRAIN_CONFIGS["deltas-resnet50"]
    scannet = ScanNetConfig(root="somewhere")
    data = replace(paper.data, source="scannet", scannet=scannet)
    assert command.config == replace(paper, data=data)
    assert (paper.steps, paper.batch_size, paper.sizes) == (100_000, 24, ((240, 320),))
    assert (data.height, data.width) == (240, 320)
    assert scannet.split == "train" and scannet.gap_of(paper.max_views) == 20


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--root", "{}/none"], ["there is no such folder", "none: name the folder"]),
        ([], ["where are the scenes?", "add --root DIR"]),
        (["--root", "{}", "--data.split", "{}/empty.txt"], ["names no scene", "empty.txt: write"]),
        (["--root", "{}", "--data.skip", "{}/all.txt"], ["no 3 views 2 frames", "2 scenes listed"]),
        (["--root", "{}", "--data.skip", "{}/no.txt"], ["skip list cannot be read", "no.txt: ch"]),
        (["--root", "{}", "--data.gap", "5"], ["no 3 views 5 frames apart", "--data.gap"]),
        (["--root", "{}", "--data.gap", "0"], ["gap must be at least 1"]),
        (["--root", "{}", "--data.baseline", "2", "1"], ["baseline must be 0 < low < high"]),
        (["--root", "{}", "--data.max-rotation", "0"], ["max_rotation must be within (0, 180]"]),
        (["--root", "{}", "--data.validation", "mine"], ["the split cannot be", "--data.valid"]),
        (["--data", "rooms", "--root", "{}"], ["need --data scannet"]),
    ],
)
def test_what_cannot_be_trained_on_is_refused_in_one_line(
    run: Run, root: Path, tmp_path: Path, options: list[str], words: list[str]
) -> None:
    written_list(root, "", name="empty.txt")
    written_list(root, "scene0000_00 *", "scene0706_01 *", name="all.txt")
    given = [option.format(root) for option in options]
    gap = [] if "--data.gap" in options or "rooms" in options else ["--data.gap", 2]
    chosen = [] if "--data" in options else ["--data", "scannet"]
    refused = run("train", "--out", tmp_path / "run", *chosen, *gap, *given, *SMALL)
    assert_one_line(refused, *words)
    assert not (tmp_path / "run").exists()


# Real scenes.


@pytest.mark.shared
def test_a_real_sample_of_scannet_is_read(shared_data: Path) -> None:
    config = ScanNetConfig(root=str(shared_data / "scannet_sample"), gap=1)
    tuples = opened(config, "test", image_size=(240, 320))
    assert view_sets(tuples) == [("scene0707_00", ViewSet(1, (0, 2)))]
    item = tuples[0]
    assert item.images.shape == (3, 3, 240, 320)
    assert 0.5 < float((item.depth > 0).float().mean()) <= 1
    # 1296 x 968 is not quite of the shape 4 to 3.
    assert float(item.views.K[0, 0, 0]) == pytest.approx(1165.723022 * 320 / 1296, abs=1e-3)
    assert float(item.views.K[0, 1, 1]) == pytest.approx(1165.738037 * 240 / 968, abs=1e-3)
    assert agreeing_share(item, within=0.05) > 0.9
    baselines = item.views.cam_from_world[1:, :3, 3].norm(dim=-1)
    assert ((baselines > 0.002) & (baselines < 0.03)).all()


@pytest.mark.shared
@pytest.mark.parametrize("tuples", ["gap", "baseline"])
def test_real_tuples_agree_on_the_scene(shared_data: Path, tmp_path: Path, tuples: str) -> None:
    # Depth of these two scenes is registered with the images.
    for name in ("hololens", "sevenscenes_reg"):
        (tmp_path / name).symlink_to(shared_data / name)
    config = ScanNetConfig(root=str(tmp_path), tuples=tuples, gap=4)  # type: ignore[arg-type]
    frames = opened(config, "all", image_size=(240, 320))
    assert len(frames) > 150
    shares = [agreeing_share(frames[index], within=0.05) for index in range(0, len(frames), 30)]
    assert np.mean(shares) > 0.8
