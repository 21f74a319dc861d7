"""Tuples of ScanNet's frames as items and as batches, of written scenes and of real ones."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from small_scannet import SCANNET, SIZE, agreeing_share, opened, overwrite, tiny, view_sets

from deltas_geom import PosedViews
from deltas_nets.captures.opening import open_capture
from deltas_nets.captures.posed_images import PosedImages
from deltas_nets.captures.view_sets import ViewSet
from deltas_nets.captures.work_size import depth_at_image, load_views
from deltas_nets.config.scannet import ScanNetConfig
from deltas_nets.datasets.scannet import ScanNetViewSets
from deltas_nets.errors import UserError
from deltas_nets.train.batches import BatchMaker
from deltas_nets.train.data_sets import validation_data
from deltas_nets.train.loader import Part, room_loader


def test_an_item_is_the_frames_at_the_training_size(scannet_root: Path) -> None:
    tuples = opened(replace(SCANNET, root=str(scannet_root)))
    item = tuples[5]
    name, (anchor, sources) = tuples.view_set(5)
    capture = open_capture(scannet_root / "scans" / name)
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


def test_views_of_an_item_agree_on_the_scene_at_any_size(scannet_root: Path) -> None:
    def share(size: tuple[int, int]) -> float:
        tuples = opened(replace(SCANNET, root=str(scannet_root)), image_size=size)
        return float(np.mean([agreeing_share(tuples[index]) for index in range(5)]))

    as_rendered = share((96, 128))
    assert as_rendered > 0.98
    for size in ((48, 64), (40, 64), (64, 56)):
        assert share(size) > as_rendered - 0.05


def test_unknown_depth_is_zero(scannet_copy: Path) -> None:
    file = scannet_copy / "scans" / "scene0000_00" / "depth" / "2.png"
    millimetres = np.full((96, 128), 2000, dtype=np.uint16)
    millimetres[:48], millimetres[48:, :64] = 0, 65535
    file.unlink()
    Image.fromarray(millimetres).save(file)
    depth = opened(replace(SCANNET, root=str(scannet_copy)))[0].depth[0]
    assert (depth[:24] == 0).all() and (depth[24:, :32] == 0).all()
    assert (depth[24:, 32:] == 2).all()


def test_depth_at_the_work_size_is_read_at_the_same_ray(scannet_root: Path) -> None:
    frame = open_capture(scannet_root / "scans" / "scene0000_00").frame(0)
    assert np.array_equal(depth_at_image(frame), depth_at_image(frame, work_size=(96, 128)))
    full, third = depth_at_image(frame), depth_at_image(frame, work_size=(32, 42))
    rows = np.floor((np.arange(32) + 0.5) * 3).astype(int)
    columns = np.floor((np.arange(42) + 0.5) * 128 / 42 - 1e-6).astype(int)
    assert np.array_equal(third, full[rows[:, None], columns])


def test_batches_keep_the_anchor_and_know_its_depth(scannet_root: Path) -> None:
    config = replace(tiny(scannet_root), min_views=2, max_views=4, pose_noise=(0.01, 0.01))
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


def test_processes_and_workers_share_a_step(scannet_root: Path) -> None:
    config = replace(tiny(scannet_root), batch_size=4)
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
def test_an_image_that_cannot_be_read_is_an_error_of_one_line(
    scannet_copy: Path, workers: int
) -> None:
    for file in (scannet_copy / "scans").rglob("color/4.png"):
        overwrite(file, file.read_bytes()[:500])
    config = tiny(scannet_copy)
    config = replace(config, data=replace(config.data, workers=workers))
    with pytest.raises(UserError, match=r"cannot be decoded.*4\.png: copy the file again"):
        list(room_loader(config, start=0, stop=4))


def test_validation_tuples_are_spread_over_the_split(scannet_root: Path) -> None:
    assert validation_data(tiny(scannet_root)) is None
    few = validation_data(tiny(scannet_root, validation="all", validation_tuples=3))
    assert few is not None
    frames = few.dataset
    assert isinstance(frames, ScanNetViewSets)
    assert [frames.view_set(index)[0][:9] for index in few.indices] == [
        "scene0000",
        "scene0706",
        "scene0707",
    ]
    every = validation_data(tiny(scannet_root, validation="test"))
    assert every is not None and len(every) == 5


@pytest.mark.shared
def test_a_real_sample_of_scannet_is_read(shared_data: Path) -> None:
    config = ScanNetConfig(root=str(shared_data / "scannet_sample"), gap=1)
    tuples = opened(config, "test", image_size=(240, 320))
    assert view_sets(tuples) == [("scene0707_00", ViewSet("1", ("0", "2")))]
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
