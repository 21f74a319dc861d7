"""Training whose detector learns from a teacher instead of Shi-Tomasi corners."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from hypothesis import given
from hypothesis import strategies as st
from run_command import Run, assert_one_line
from run_fit import (
    CONFIG,
    HELD_OUT,
    assert_same_state,
    finish,
    launch,
    logged,
    read_checkpoint,
    train,
)
from safetensors.torch import save_file
from torch import Tensor, nn

from deltas_nets.config import CONFIGS, TrainConfig
from deltas_nets.distill import superpoint
from deltas_nets.distill.labels import hard_labels, soft_labels
from deltas_nets.distill.superpoint import SuperPoint, load_superpoint
from deltas_nets.distill.supervision import TeacherLabels
from deltas_nets.distill.teachers import load_teacher
from deltas_nets.errors import UserError
from deltas_nets.losses.losses import training_losses
from deltas_nets.losses.points import cell_entropy
from deltas_nets.network.deltas import Deltas
from deltas_nets.network.lite.detector import detector_heatmap
from deltas_nets.train import fit
from deltas_nets.train import start as start_module
from deltas_nets.train import step as step_module
from deltas_nets.train.batches import Batch, BatchMaker
from deltas_nets.train.fit import Start
from deltas_nets.train.loader import room_loader
from deltas_nets.train.step import Objective
from deltas_nets.weights_file import read_metadata

TAUGHT = replace(CONFIG, steps=2, teacher="superpoint")
ODD = (52, 68)  # rows and columns beyond the last whole cell


def random_superpoint(*, batch_norm: bool) -> SuperPoint:
    """Weights of a size that keeps signals alive: what it says depends on what it sees."""
    torch.manual_seed(0)
    network = SuperPoint(batch_norm=batch_norm)
    for module in network.modules():
        if isinstance(module, nn.Conv2d):
            nn.init.kaiming_normal_(module.weight)
    return network.eval()


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A SuperPoint of random weights in both published layouts."""
    folder = tmp_path_factory.mktemp("teacher")
    save_file(random_superpoint(batch_norm=True).state_dict(), folder / "open.safetensors")
    plain = random_superpoint(batch_norm=False).state_dict()
    original = {
        old + kind: plain[new + kind]
        for old, new in superpoint._ORIGINAL.items()
        for kind in ("weight", "bias")
    }
    torch.save(original, folder / "original.pth")
    return {"open": folder / "open.safetensors", "original": folder / "original.pth"}


def first_batch(config: TrainConfig) -> Batch:
    return BatchMaker(config)(next(iter(room_loader(config, start=0, stop=1))), 0)


def test_two_steps_with_a_teacher(
    tmp_path: Path, files: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    loaded, before = [], []

    def load(name: str, file: Path) -> nn.Module:
        loaded.append(load_teacher(name, file))
        before.append({key: tensor.clone() for key, tensor in loaded[0].state_dict().items()})
        return loaded[0]

    monkeypatch.setattr(start_module, "load_teacher", load)
    train(tmp_path / "run", TAUGHT, Start(teacher=files["original"]))
    train(tmp_path / "corners", replace(TAUGHT, teacher=None), Start(), stop=1)
    taught, corners = logged(tmp_path / "run"), logged(tmp_path / "corners")
    assert [entry["step"] for entry in taught] == [1, 2]
    assert taught[0]["detector"] != corners[0]["detector"]
    assert taught[0]["depth"] == corners[0]["depth"]  # nothing else is taught
    # It is as it was, and in no file; its name is, its place on this machine is not.
    for name, tensor in loaded[0].state_dict().items():
        assert torch.equal(tensor, before[0][name]), name
    content = read_checkpoint(tmp_path / "run")
    assert content["model"].keys() == Deltas(CONFIG.network).state_dict().keys()
    text = (tmp_path / "run" / "config.json").read_text()
    assert json.loads(text)["teacher"] == "superpoint"
    metadata = read_metadata(tmp_path / "run" / "weights.safetensors")
    assert metadata["detector_teacher"] == "superpoint"
    assert "non-commercial" in metadata["detector_teacher_licence"]
    assert files["original"].name not in text + json.dumps(metadata)


def test_a_resumed_run_with_a_teacher_equals_an_unbroken_one(
    tmp_path: Path, files: dict[str, Path]
) -> None:
    train(tmp_path / "whole", TAUGHT, Start(teacher=files["open"]))
    train(tmp_path / "broken", TAUGHT, Start(teacher=files["open"]), stop=1)
    train(tmp_path / "broken", TAUGHT, Start(resume=True, teacher=files["open"]))
    assert_same_state(tmp_path / "broken", tmp_path / "whole")


@pytest.mark.slow
def test_two_processes_learn_from_a_teacher_as_one_does(
    tmp_path: Path, files: dict[str, Path]
) -> None:
    config = replace(TAUGHT, freeze_batch_norm=True)
    finish(launch(tmp_path / "two", config, f"teacher={files['open']}", processes=2))
    train(tmp_path / "one", config, Start(teacher=files["open"]))
    for entry, expected in zip(logged(tmp_path / "two"), logged(tmp_path / "one"), strict=True):
        assert entry == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize(
    ("layout", "size", "passes"), [("open", (48, 64), 1), ("original", ODD, 2)]
)
def test_labels_are_the_teachers_of_the_anchors_in_their_own_light(
    tmp_path: Path,
    files: dict[str, Path],
    monkeypatch: pytest.MonkeyPatch,
    layout: str,
    size: tuple[int, int],
    passes: int,
) -> None:
    config = replace(TAUGHT, sizes=(size,), accumulate=passes)
    seen: list[Tensor] = []

    def spy(*arguments: object, labels: Tensor, **more: object) -> object:
        seen.append(labels)
        return training_losses(*arguments, labels=labels, **more)  # type: ignore[arg-type]

    monkeypatch.setattr(step_module, "training_losses", spy)
    train(tmp_path / "run", config, Start(teacher=files[layout]), stop=1)
    with monkeypatch.context() as patch:
        patch.setattr(
            "deltas_nets.datasets.augment.Photometry.forward",
            lambda _, images, seed, **place: images,
        )
        anchors = first_batch(config).images[:, 0]
    teacher = load_superpoint(files[layout])
    expected = soft_labels(teacher(anchors))
    in_other_light = soft_labels(teacher(first_batch(config).images[:, 0]))
    assert (in_other_light - expected).abs().max() > 0.01  # else there is nothing to see
    assert expected.shape[-2:] == (-(-size[0] // 8), -(-size[1] // 8))
    assert expected[:, :64].sum() > 0.1  # some points
    torch.testing.assert_close(torch.cat(seen[-passes:]), expected)


def test_no_gradient_reaches_the_teacher(files: dict[str, Path]) -> None:
    teacher = load_superpoint(files["open"])
    teacher.train().requires_grad_(True)  # as someone might hand it over
    labels = TeacherLabels(teacher)(torch.rand(1, 3, 16, 16, requires_grad=True))
    assert not labels.requires_grad
    assert not any(parameter.requires_grad for parameter in teacher.parameters())
    assert not teacher.training
    objective = Objective(Deltas(CONFIG.network), TAUGHT)
    batch = first_batch(TAUGHT)
    batch = batch._replace(labels=TeacherLabels(teacher)(batch.anchors))
    objective(batch).total.backward()
    assert all(parameter.grad is None for parameter in teacher.parameters())
    assert all(parameter.grad is not None for parameter in objective.model.detector.parameters())


@pytest.mark.parametrize("network", ["deltas-small", "deltas-vgg9"])
@pytest.mark.parametrize("taught", [False, True])
def test_images_of_any_size_train_every_network(
    files: dict[str, Path], network: str, taught: bool
) -> None:
    config = replace(CONFIG, network=CONFIGS[network], sizes=(ODD,), batch_size=1)
    batch = first_batch(config)
    if taught:
        batch = batch._replace(labels=TeacherLabels(load_superpoint(files["open"]))(batch.anchors))
    losses = Objective(Deltas(config.network), config)(batch)
    assert 0 < losses.terms["detector"] < torch.inf


@given(st.integers(8, 39), st.integers(8, 39), st.booleans(), st.data())
def test_the_head_learns_the_pixel_that_the_label_means(
    height: int, width: int, rounded_up: bool, data: st.DataObject
) -> None:
    """Whether a head has cells for what is left over or not, a point is where it is."""
    rows, columns = (-(-side // 8) if rounded_up else side // 8 for side in (height, width))
    x = data.draw(st.integers(0, min(width, 8 * columns) - 1))
    y = data.draw(st.integers(0, min(height, 8 * rows) - 1))
    scores = torch.zeros(1, 1, height, width)
    scores[0, 0, y, x] = 1.0
    logits = torch.zeros(1, 65, rows, columns, requires_grad=True)
    for labels in (hard_labels(scores), soft_labels(scores, blur=0)):
        (gradient,) = torch.autograd.grad(cell_entropy(logits, labels), logits)
        better = (-100 * gradient).detach()  # one step down
        heatmap = detector_heatmap(better, image_size=(height, width))[0, 0]
        assert divmod(int(heatmap.argmax()), heatmap.shape[1]) == (y, x)


def test_cells_that_a_head_lacks_are_left_out() -> None:
    random = torch.Generator().manual_seed(0)
    labels = torch.randint(65, (2, 7, 9), generator=random)
    logits = torch.randn(2, 65, 6, 8, generator=random)
    by_hand = [
        -logits[b, :, r, c].log_softmax(dim=0)[labels[b, r, c]]
        for b in range(2)
        for r in range(6)
        for c in range(8)
    ]
    torch.testing.assert_close(cell_entropy(logits, labels), torch.stack(by_hand).mean())
    soft = F.one_hot(labels, 65).movedim(-1, 1).float()
    torch.testing.assert_close(cell_entropy(logits, soft), cell_entropy(logits, labels))


def test_what_cannot_teach_is_refused_before_anything_is_written(
    tmp_path: Path, files: dict[str, Path]
) -> None:
    out = tmp_path / "run"
    (tmp_path / "other.pth").write_bytes(b"text")
    unknown = replace(CONFIG, teacher="nobody")  # type: ignore[arg-type]
    cases = [
        (TAUGHT, None, "no weights for superpoint"),
        (replace(CONFIG, teacher=None), files["open"], "whose weights are these"),
        (TAUGHT, tmp_path / "none.pth", "no such weights"),
        (TAUGHT, tmp_path / "other.pth", r"other\.pth"),
        (replace(CONFIG, teacher="disk"), files["open"], "not weights of DISK"),
        (unknown, files["open"], "no such teacher.*nobody.*superpoint, aliked, disk, xfeat"),
    ]
    for config, file, message in cases:
        with pytest.raises(UserError, match=message):
            train(out, config, Start(teacher=file))
    assert not out.exists()


def test_the_command_takes_a_teacher(
    run: Run, tmp_path: Path, files: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fit, "validation_rooms", lambda: HELD_OUT)
    out = tmp_path / "run"
    tiny = ["--data.num-rooms", 2, "--data.num-views", 2, "--max-views", 2, "--data.height", 48]
    tiny += ["--data.width", 64, "--data.workers", 0, "--sizes", 48, 64, "--batch-size", 1]
    tiny += ["--num-keypoints", 48, "--network.matcher.num-samples", 32, "--encoder", "none"]
    command = ["train", "--out", out, *tiny, "--steps", 1, "--validate-every", 1]
    assert_one_line(run(*command, "--teacher", "nobody"), "nobody", "see deltas train --help")
    assert_one_line(run(*command, "--teacher", "superpoint"), "add --teacher-weights FILE")
    weights = ["--teacher-weights", files["original"]]
    assert_one_line(run(*command, *weights), "whose weights", "add --teacher NAME")
    assert not out.exists()
    assert run(*command, "--teacher", "superpoint", *weights).code == 0
    assert json.loads((out / "config.json").read_text())["teacher"] == "superpoint"
    assert_one_line(run("train", "--out", out, "--resume"), "no weights for superpoint")
    assert run("train", "--out", out, "--resume", *weights).code == 0
