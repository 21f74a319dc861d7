"""Training: ten steps and a prediction, batches by number, resume and start from weights."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from deltas_geom import PosedViews, fundamental_between, in_image, project, unproject
from deltas_nets import load_model
from deltas_nets.config import DataConfig, DetectorConfig, MatcherConfig, NetworkConfig, TrainConfig
from deltas_nets.data.augment import Photometry, choose_views, disturb_poses, mirror, resize
from deltas_nets.data.posed_images import PosedImages
from deltas_nets.data.synthetic import Rooms, render_room
from deltas_nets.errors import UserError
from deltas_nets.targets import read_nearest
from deltas_nets.train import fit as fit_module
from deltas_nets.train.batches import BatchMaker, StepSampler, room_loader
from deltas_nets.train.fit import Start, fit, learning_rate_factor

CONFIG = TrainConfig(
    network=NetworkConfig(
        detector=DetectorConfig(num_keypoints=48), matcher=MatcherConfig(num_samples=32)
    ),
    data=DataConfig(num_rooms=4, num_views=3, height=48, width=64, workers=0),
    sizes=((48, 64),),
    steps=10,
    batch_size=2,
    warmup=2,
    max_views=3,
    num_keypoints=48,
)


@pytest.fixture(autouse=True)
def _small_validation(monkeypatch: pytest.MonkeyPatch) -> None:
    few = Rooms(1, num_views=2, image_size=(48, 64))
    monkeypatch.setattr(fit_module, "validation_rooms", lambda: few)


@pytest.fixture(scope="module")
def rooms() -> PosedImages:
    return next(iter(room_loader(CONFIG, start=0, stop=1)))


def with_batch(room: PosedImages) -> PosedImages:
    views = PosedViews(*(tensor[None] for tensor in room.views))
    return PosedImages(room.images[None], views, room.depth[None])


def first_of(batch: PosedImages) -> PosedImages:
    views = PosedViews(*(tensor[0] for tensor in batch.views))
    return PosedImages(batch.images[0], views, batch.depth[0])


def consistent_share(room: PosedImages) -> float:
    """Share of the anchor's pixels whose depth agrees in view 1, of those that are in it."""
    size = height, width = room.depth.shape[-2], room.depth.shape[-1]
    columns, rows = torch.arange(4.0, width - 4, 5), torch.arange(4.0, height - 4, 5)
    pixels = torch.cartesian_prod(columns, rows)
    depth = read_nearest(room.depth[:1], pixels[None])
    points = unproject(room.views.select(0), pixels[None], depth)[0]
    there = project(room.views.select(1), points)
    inside = in_image(there.pixels[0], image_size=size)
    surface = read_nearest(room.depth[1:2], there.pixels)[0]
    agrees = (there.depth[0] / surface - 1).abs() < 0.05
    return float(agrees[inside].float().mean())


def test_ten_steps_then_a_prediction(tmp_path: Path) -> None:
    said: list[str] = []
    weights = fit(CONFIG, tmp_path / "run", Start(), report=said.append)
    model = load_model(weights)
    room = render_room(0, num_views=2, image_size=(48, 64))
    with torch.no_grad():
        depth = model(room.images.float() / 255, room.views).depth
    assert depth.isfinite().all()
    assert (depth > 0).all()
    log = [json.loads(line) for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines()]
    assert log[-2]["step"] == 10
    assert "abs_rel" in log[-1]["validation"]
    assert "held-out rooms Abs Rel" in said[-1]


def test_a_resumed_run_equals_an_unbroken_one(tmp_path: Path) -> None:
    fit(CONFIG, tmp_path / "whole", Start())
    half = replace(CONFIG)
    fit(half, tmp_path / "broken", Start(), stop=5)
    fit(half, tmp_path / "broken", Start(resume=True))
    one = load_model(tmp_path / "whole" / "weights.safetensors").state_dict()
    other = load_model(tmp_path / "broken" / "weights.safetensors").state_dict()
    for name, tensor in one.items():
        torch.testing.assert_close(other[name], tensor, rtol=1e-4, atol=1e-5)


def test_a_run_stopped_by_hand_loses_no_step(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    step, calls = fit_module._step, []

    def stops_at_the_fourth(*arguments: object) -> object:
        calls.append(1)
        if len(calls) == 4:
            raise KeyboardInterrupt
        return step(*arguments)  # type: ignore[arg-type]

    with monkeypatch.context() as patch:
        patch.setattr(fit_module, "_step", stops_at_the_fourth)
        with pytest.raises(KeyboardInterrupt):
            fit(CONFIG, tmp_path / "run", Start())
    content = torch.load(tmp_path / "run" / "checkpoint.pt", weights_only=True)
    assert content["step"] == 3
    fit(CONFIG, tmp_path / "run", Start(resume=True))


def test_weights_alone_continue_the_schedule(tmp_path: Path) -> None:
    first = fit(CONFIG, tmp_path / "first", Start(), stop=6)
    second = fit(CONFIG, tmp_path / "second", Start(init=first, step=6))
    log = (tmp_path / "second" / "log.jsonl").read_text().splitlines()
    assert json.loads(log[-2])["step"] == 10
    assert load_model(second).config == CONFIG.network


def test_what_cannot_be_started_from_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no checkpoint to resume"):
        fit(CONFIG, tmp_path / "empty", Start(resume=True))
    with pytest.raises(UserError, match="no such weights"):
        fit(CONFIG, tmp_path / "empty", Start(init=tmp_path / "none.safetensors"))
    assert not (tmp_path / "empty").exists()


def test_a_damaged_checkpoint_is_an_error(tmp_path: Path) -> None:
    fit(CONFIG, tmp_path / "run", Start(), stop=1)
    file = tmp_path / "run" / "checkpoint.pt"
    file.write_bytes(file.read_bytes()[:1000])
    with pytest.raises(UserError, match=r"checkpoint is damaged .*checkpoint.pt"):
        fit(CONFIG, tmp_path / "run", Start(resume=True))


def test_steps_see_every_room_once_an_epoch_and_continue_anywhere() -> None:
    whole = list(StepSampler(6, 2, seed=1, start=0, stop=6))
    for epoch in (whole[:3], whole[3:]):
        assert sorted(room for batch in epoch for room in batch) == list(range(6))
    assert whole[:3] != whole[3:]
    assert list(StepSampler(6, 2, seed=1, start=2, stop=5)) == whole[2:5]


def test_a_step_is_a_function_of_its_number(rooms: PosedImages) -> None:
    maker = BatchMaker(CONFIG)
    state = torch.get_rng_state()
    first, again, other = maker(rooms, 3), maker(rooms, 3), maker(rooms, 4)
    assert torch.equal(first.images, again.images)
    assert torch.equal(first.views.cam_from_world, again.views.cam_from_world)
    assert first.images.shape != other.images.shape or not torch.equal(first.images, other.images)
    assert torch.equal(torch.get_rng_state(), state)


def test_mirrored_resized_and_reordered_rooms_stay_consistent() -> None:
    room = render_room(11, num_views=3, image_size=(96, 128))
    batch = with_batch(room._replace(images=room.images.float() / 255))
    changed = resize(mirror(batch, torch.tensor([True])), (72, 96))
    changed = choose_views(changed, 2, torch.Generator().manual_seed(0))
    assert consistent_share(room) > 0.7
    assert consistent_share(first_of(changed)) > 0.7
    changed.views.check_values()


def test_mirroring_twice_changes_nothing(rooms: PosedImages) -> None:
    floats = rooms._replace(images=rooms.images.float() / 255)
    both = torch.tensor([True, True])
    twice = mirror(mirror(floats, both), both)
    assert torch.equal(twice.images, floats.images)
    torch.testing.assert_close(twice.views.K, floats.views.K)
    torch.testing.assert_close(twice.views.cam_from_world, floats.views.cam_from_world)


def test_tracking_errors_leave_the_anchor_and_stay_rigid(rooms: PosedImages) -> None:
    noisy = disturb_poses(rooms.views, (0.01, 0.01), torch.Generator().manual_seed(0))
    noisy.check_values()
    assert torch.equal(noisy.cam_from_world[:, 0], rooms.views.cam_from_world[:, 0])
    change = fundamental_between(noisy) - fundamental_between(rooms.views)
    assert change.abs().max() > 0


def test_photometry_keeps_range_and_differs_between_views() -> None:
    images = torch.full((2, 3, 3, 16, 24), 0.5)
    changed = Photometry()(images, seed=1)
    assert changed.shape == images.shape
    assert ((changed >= 0) & (changed <= 1)).all()
    assert (changed[0, 0].mean() - changed[0, 1].mean()).abs() > 1e-3


def test_the_learning_rate_rises_then_falls_to_a_hundredth() -> None:
    config = replace(CONFIG, steps=1000, warmup=100)
    rates = [learning_rate_factor(step, config) for step in range(1000)]
    assert rates.index(max(rates)) in range(90, 130)
    assert rates[-1] < 0.011
    assert rates[0] < 0.02
