"""Training: six steps and a prediction, batches by number, resume and start from weights."""

import json
import shutil
import signal
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from run_fit import CONFIG as CONFIG_OF_FOUR
from run_fit import HELD_OUT, assert_same_state, logged, read_checkpoint, train

from deltas_geom import PosedViews, fundamental_between, in_image, project, unproject
from deltas_nets import load_model
from deltas_nets.captures.posed_images import PosedImages
from deltas_nets.config.schedule import rate_factor
from deltas_nets.datasets.augment import (
    Photometry,
    choose_views,
    disturb_poses,
    draw_pose_errors,
    mirror,
    resize,
)
from deltas_nets.errors import UserError
from deltas_nets.losses.targets import read_nearest
from deltas_nets.rooms import render_room
from deltas_nets.train import fit as fit_module
from deltas_nets.train.batches import Batch, BatchMaker
from deltas_nets.train.fit import Start, fit
from deltas_nets.train.loader import Part, StepSampler, room_loader
from deltas_nets.train.log import drop_later_entries
from deltas_nets.train.step import Stepper, StepResult

CONFIG = replace(CONFIG_OF_FOUR, batch_size=2, steps=6)


@pytest.fixture(autouse=True)
def _small_validation(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fit_module, "validation_rooms", lambda: HELD_OUT)


@pytest.fixture(scope="module")
def rooms() -> PosedImages:
    rooms: PosedImages = next(iter(room_loader(CONFIG, start=0, stop=1)))
    return rooms


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


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("unbroken")
    train(folder, CONFIG, Start())
    return folder


@pytest.fixture
def copy(unbroken: Path, tmp_path: Path) -> Path:
    """To go on with, or to spoil."""
    return Path(shutil.copytree(unbroken, tmp_path / "copy"))


def test_six_steps_then_a_prediction(unbroken: Path) -> None:
    model = load_model(unbroken / "weights.safetensors")
    room = HELD_OUT[0]
    with torch.no_grad():
        depth = model(room.images.float() / 255, room.views).depth
    assert depth.isfinite().all()
    assert (depth > 0).all()
    log = [json.loads(line) for line in (unbroken / "log.jsonl").read_text().splitlines()]
    assert log[-2]["step"] == 6
    assert "abs_rel" in log[-1]["validation"]


def test_a_resumed_run_equals_an_unbroken_one(tmp_path: Path, unbroken: Path) -> None:
    train(tmp_path, CONFIG, Start(), stop=2)
    train(tmp_path, CONFIG, Start(resume=True))
    assert_same_state(tmp_path, unbroken)
    assert logged(tmp_path) == logged(unbroken)


def test_a_run_whose_rooms_wait_in_memory_resumes_as_if_unbroken(tmp_path: Path) -> None:
    data = replace(CONFIG.data, num_rooms=40, replay=2, shelf=2)
    config = replace(CONFIG, data=data, steps=4)
    train(tmp_path / "whole", config, Start())
    train(tmp_path / "broken", config, Start(), stop=2)
    train(tmp_path / "broken", config, Start(resume=True))
    assert_same_state(tmp_path / "broken", tmp_path / "whole")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_run_told_to_stop_finishes_its_step_and_goes_on_later(
    tmp_path: Path, unbroken: Path, monkeypatch: pytest.MonkeyPatch, number: signal.Signals
) -> None:
    take, calls = Stepper.__call__, []

    def told_in_the_third(stepper: Stepper, batch: Batch, *, stop: bool) -> StepResult:
        calls.append(stop)
        if len(calls) == 3:
            signal.raise_signal(number)
        return take(stepper, batch, stop=stop)

    before = signal.getsignal(number)
    with monkeypatch.context() as patch:
        patch.setattr(Stepper, "__call__", told_in_the_third)
        with pytest.raises(KeyboardInterrupt):
            train(tmp_path, CONFIG, Start())
    assert signal.getsignal(number) == before
    assert (
        read_checkpoint(tmp_path)["step"] == 4
    )  # the next step's end is where all processes hear of it
    train(tmp_path, CONFIG, Start(resume=True))
    assert_same_state(tmp_path, unbroken)


def test_a_run_told_to_stop_where_it_validates_leaves_that_to_the_one_that_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    take, saved = Stepper.__call__, []

    def told(stepper: Stepper, batch: Batch, *, stop: bool) -> StepResult:
        return take(stepper, batch, stop=stop)._replace(stop=True)

    def validate(model: object) -> dict[str, float]:
        saved.append(read_checkpoint(tmp_path)["step"])
        return {}

    monkeypatch.setattr(fit_module, "validate", validate)
    with monkeypatch.context() as patch:
        patch.setattr(Stepper, "__call__", told)
        with pytest.raises(KeyboardInterrupt):
            fit(CONFIG, tmp_path, Start(), validate_every=1)
    assert read_checkpoint(tmp_path)["step"] == 1 and not saved
    fit(CONFIG, tmp_path, Start(resume=True), validate_every=1, stop=2)
    lines = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines if "validation" in line] == saved == [1, 2]


def test_a_finished_run_has_nothing_left_to_do(copy: Path) -> None:
    weights, log = copy / "weights.safetensors", copy / "log.jsonl"
    before = weights.read_bytes(), log.read_text()
    said: list[str] = []
    assert fit(CONFIG, copy, Start(resume=True), report=said.append) == weights
    assert (weights.read_bytes(), log.read_text()) == before


def test_a_run_killed_in_its_last_validation_makes_up_for_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Killed(BaseException):
        pass

    def kill(model: object) -> dict[str, float]:
        raise Killed

    with monkeypatch.context() as patch:
        patch.setattr(fit_module, "validate", kill)
        with pytest.raises(Killed):
            fit(CONFIG, tmp_path, Start(), stop=1)
    fit(CONFIG, tmp_path, Start(resume=True), stop=1)
    lines = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines if "validation" in line] == [1]


def poison(monkeypatch: pytest.MonkeyPatch, steps: set[int]) -> None:
    """Make the images of some steps NaN."""
    make = BatchMaker.__call__

    def poisoned(maker: BatchMaker, rooms: PosedImages, step: int) -> Batch:
        batch = make(maker, rooms, step)
        bad = batch.images * torch.nan if step in steps else batch.images
        return batch._replace(images=bad)

    monkeypatch.setattr(BatchMaker, "__call__", poisoned)


def test_a_step_without_a_usable_gradient_changes_nothing_and_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []
    train(tmp_path / "good", CONFIG, Start(), stop=1)
    poison(monkeypatch, {1, 2})
    train(tmp_path / "bad", CONFIG, Start(), stop=3, report=said.append)
    assert [entry["total"] for entry in logged(tmp_path / "bad")][1:] == ["nan", "nan"]
    assert said[-1].startswith("2 steps changed nothing; not finite: detector, smoothness, ")
    good, bad = (read_checkpoint(tmp_path / name) for name in ("good", "bad"))
    assert (good["step"], bad["step"]) == (1, 3)
    for part in ("model", "average"):  # the running statistics of batch norm among them
        for name, tensor in good[part].items():
            assert torch.equal(bad[part][name], tensor), f"{part} {name}"


def test_training_that_diverges_ends_and_tells_of_steps_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []
    monkeypatch.setattr(fit_module, "PATIENCE", 3)
    poison(monkeypatch, {0, 1, 3, 4, 5})
    with pytest.raises(UserError, match=r"in the 3 steps up to 6; not finite: dete.*lower --lear"):
        fit(CONFIG, tmp_path, Start(), report=said.append)
    assert said[-1].startswith("5 steps changed nothing; not finite: detector")


def test_frozen_batch_norm_keeps_its_statistics(tmp_path: Path) -> None:
    train(tmp_path, replace(CONFIG, freeze_batch_norm=True), Start(), stop=1)
    model = read_checkpoint(tmp_path)["model"]
    means = [tensor for name, tensor in model.items() if name.endswith("running_mean")]
    variances = [tensor for name, tensor in model.items() if name.endswith("running_var")]
    assert len(means) == len(variances) > 20
    assert not any(mean.any() for mean in means)
    assert all((variance == 1).all() for variance in variances)


def test_bfloat16_leaves_weights_in_full_precision(tmp_path: Path, unbroken: Path) -> None:
    train(tmp_path, replace(CONFIG, precision="bf16-mixed"), Start(), stop=1)
    full, half = logged(unbroken)[0], logged(tmp_path)[0]
    assert half["total"] != full["total"]
    assert half["total"] == pytest.approx(full["total"], rel=0.05)
    weights = read_checkpoint(tmp_path)["model"].values()
    kinds = {tensor.dtype for tensor in weights if tensor.is_floating_point()}
    assert kinds == {torch.float32}


def test_what_a_killed_run_logged_too_much_is_dropped(tmp_path: Path) -> None:
    file = tmp_path / "log.jsonl"
    lines = [json.dumps({"step": step, "total": 1.0}) for step in (20, 40, 60)]
    file.write_text("\n".join(lines) + '\n{"step": 80, "tot')
    drop_later_entries(file, 40)
    assert file.read_text().splitlines() == lines[:2]
    drop_later_entries(tmp_path / "none.jsonl", 40)
    assert not (tmp_path / "none.jsonl").exists()


def test_tensorboard_shows_every_step_once(tmp_path: Path) -> None:
    events = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    fit(CONFIG, tmp_path, Start(), stop=5, log_every=1, checkpoint_every=4)
    # As if it had been killed after step 5, the last checkpoint being that of step 4.
    torch.save({**read_checkpoint(tmp_path), "step": 4}, tmp_path / "checkpoint.pt")
    fit(CONFIG, tmp_path, Start(resume=True), log_every=1)
    found = events.EventAccumulator(str(tmp_path / "tensorboard"))
    found.Reload()
    tags = set(found.Tags()["scalars"])
    assert {"loss/total", "loss/posterior", "training/rate", "validation/abs_rel"} <= tags
    assert [scalar.step for scalar in found.Scalars("loss/total")] == list(range(1, 7))
    assert [entry["step"] for entry in logged(tmp_path)] == list(range(1, 7))


def test_without_tensorboard_there_is_the_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    fit(CONFIG, tmp_path, Start(), stop=1)
    assert [entry["step"] for entry in logged(tmp_path)] == [1]
    assert not (tmp_path / "tensorboard").exists()


def test_weights_alone_continue_the_schedule(tmp_path: Path) -> None:
    first = fit(CONFIG, tmp_path / "first", Start(), stop=3)
    second = fit(CONFIG, tmp_path / "second", Start(init=first, step=3))
    log = (tmp_path / "second" / "log.jsonl").read_text().splitlines()
    assert json.loads(log[-2])["step"] == 6
    assert load_model(second).config == CONFIG.network


def test_what_cannot_be_started_from_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="nothing to resume"):
        fit(CONFIG, tmp_path / "empty", Start(resume=True))
    with pytest.raises(UserError, match="no such weights"):
        fit(CONFIG, tmp_path / "empty", Start(init=tmp_path / "none.safetensors"))
    assert not (tmp_path / "empty").exists()


@pytest.mark.parametrize("other", [{}, [1], {"model": 1}, 7])
def test_another_file_of_torch_is_no_checkpoint(copy: Path, other: object) -> None:
    torch.save(other, copy / "checkpoint.pt")
    with pytest.raises(UserError, match=r"no checkpoint of a training.*checkpoint.pt: .*--init"):
        fit(CONFIG, copy, Start(resume=True))


@pytest.mark.parametrize("part", ["model", "average", "optimizer"])
@pytest.mark.parametrize("wrong", [None, {}, torch.zeros(1)])
def test_a_checkpoint_of_other_parts_is_refused(copy: Path, part: str, wrong: object) -> None:
    torch.save(read_checkpoint(copy) | {part: wrong}, copy / "checkpoint.pt")
    with pytest.raises(UserError, match=r"checkpoint of another version.*checkpoint.pt: "):
        fit(CONFIG, copy, Start(resume=True))


def test_a_checkpoint_of_a_network_of_before_is_an_error(copy: Path) -> None:
    file, content = copy / "checkpoint.pt", read_checkpoint(copy)
    del content["model"]["judge.correction.0.weight"]
    torch.save(content, file)
    with pytest.raises(UserError, match=r"another version .*judge.*--init .*weights.safetensors"):
        fit(CONFIG, copy, Start(resume=True))


def test_steps_see_every_room_once_an_epoch_and_continue_anywhere() -> None:
    whole = list(StepSampler(6, 2, seed=1, start=0, stop=6))
    for epoch in (whole[:3], whole[3:]):
        assert sorted(room for batch in epoch for room in batch) == list(range(6))
    assert whole[:3] != whole[3:]
    assert list(StepSampler(6, 2, seed=1, start=2, stop=5)) == whole[2:5]


def test_parts_of_a_step_are_the_whole_step() -> None:
    config = replace(CONFIG, batch_size=4)
    whole_rooms = next(iter(room_loader(config, start=3, stop=4)))
    whole = BatchMaker(config)(whole_rooms, 3)
    parts = []
    for half in (Part(0, 2), Part(1, 2)):
        rooms = next(iter(room_loader(config, start=3, stop=4, part=half)))
        parts.append(BatchMaker(config, half)(rooms, 3))
    assert torch.equal(torch.cat([part.images for part in parts]), whole.images)
    assert torch.equal(torch.cat([part.depth for part in parts]), whole.depth)
    assert torch.equal(torch.cat([part.shift for part in parts]), whole.shift)
    for name in ("views", "true_views"):
        for field in ("K", "cam_from_world"):
            pieces = [getattr(getattr(part, name), field) for part in parts]
            assert torch.equal(torch.cat(pieces), getattr(getattr(whole, name), field))
    for again, part in zip(whole.split(2), parts, strict=True):
        assert torch.equal(again.images, part.images)
        assert torch.equal(again.views.cam_from_world, part.views.cam_from_world)
    # Rooms of a step differ in what is drawn for them.
    assert len({float(shift) for shift in whole.shift[:, 0]}) == 4


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
    changed = choose_views(changed, torch.tensor([[2, 0]]))
    assert consistent_share(room) > 0.7
    assert consistent_share(first_of(changed)) > 0.7
    changed.views.check_values()


def test_a_mirrored_camera_sees_mirrored_points_at_mirrored_pixels(rooms: PosedImages) -> None:
    K = rooms.views.K.clone()
    K[..., 0, 1] = torch.tensor([7.0, -3.0, 20.0])  # skew, px
    skewed = rooms._replace(images=rooms.images / 255, views=rooms.views._replace(K=K))
    mirrored = mirror(skewed, torch.tensor([True, True]))
    # In front of all views of the first room, which stand a metre or less from view 0.
    points = torch.tensor([[-0.5, 0.4, 3.0], [0.6, -0.5, 4.0], [0.1, 0.3, 5.0]])
    world = skewed.views.cam_from_world[0, 0].inverse()
    points = points @ world[:3, :3].T + world[:3, 3]
    seen = project(first_of(skewed).views, points).pixels
    reflected = project(first_of(mirrored).views, points * torch.tensor([-1.0, 1, 1])).pixels
    expected = torch.stack([skewed.images.shape[-1] - 1 - seen[..., 0], seen[..., 1]], dim=-1)
    torch.testing.assert_close(reflected, expected, rtol=0, atol=1e-2)  # px


def test_mirroring_twice_changes_nothing(rooms: PosedImages) -> None:
    floats = rooms._replace(images=rooms.images.float() / 255)
    both = torch.tensor([True, True])
    twice = mirror(mirror(floats, both), both)
    assert torch.equal(twice.images, floats.images)
    torch.testing.assert_close(twice.views.K, floats.views.K)
    torch.testing.assert_close(twice.views.cam_from_world, floats.views.cam_from_world)


def test_tracking_errors_leave_the_anchor_and_stay_rigid(rooms: PosedImages) -> None:
    random = torch.Generator().manual_seed(0)
    errors = torch.stack([draw_pose_errors(3, (0.01, 0.01), random) for _ in range(2)])
    noisy = disturb_poses(rooms.views, errors)
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
    rates = [rate_factor(step, 1000, warmup=100) for step in range(1000)]
    assert rates.index(max(rates)) in range(90, 130)
    assert rates[-1] < 0.011
    assert rates[0] < 0.02
