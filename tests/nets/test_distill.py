"""Distillation of the detector: the command, what it records, and where it computes."""

import dataclasses
import json
import re
from collections import Counter
from pathlib import Path
from typing import Any, get_args, get_type_hints

import pytest
import torch
import torch.nn.functional as F
from hypothesis import given
from hypothesis import strategies as st
from run_command import Run, assert_one_line
from safetensors.torch import load_file, save_file
from stand_in_device import DEVICE, on_device, one_device
from torch import Tensor, nn

from deltas_nets.config import CONFIGS
from deltas_nets.distill import pictures
from deltas_nets.distill import training as distill_module
from deltas_nets.distill.lessons import prepare
from deltas_nets.distill.superpoint import SuperPoint
from deltas_nets.distill.teachers import LICENCES, TEACHERS
from deltas_nets.distill.training import (
    DistillConfig,
    Learned,
    distill,
    record_of,
    train_detector,
)
from deltas_nets.errors import UserError
from deltas_nets.network.deltas import Deltas
from deltas_nets.weights_file import load_model, read_metadata, save_weights, weights_file

STEPS, PICTURES, LOOKS, ADAPTATION = 3, 2, 2, 2


@pytest.fixture(autouse=True)
def small_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """An eighth of the pixels: tests/nets/test_teachers.py distils at the size of use."""
    for module in (distill_module, pictures):
        monkeypatch.setattr(module, "IMAGE_SIZE", (64, 96))


@pytest.fixture(scope="module")
def teacher_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A SuperPoint of random weights, of a size that keeps signals alive."""
    torch.manual_seed(0)
    network = SuperPoint(batch_norm=True)
    for module in network.modules():
        if isinstance(module, nn.Conv2d):
            nn.init.kaiming_normal_(module.weight)
    file = tmp_path_factory.mktemp("teacher") / "open.safetensors"
    save_file(network.state_dict(), file)
    return file


def small(teacher_file: Path, out: Path, **changes: Any) -> DistillConfig:
    """Seconds of work, on photographs alone: rooms would have to be rendered."""
    config = DistillConfig(
        teacher="superpoint",
        teacher_weights=teacher_file,
        out=out,
        steps=STEPS,
        batch_size=2,
        num_images=PICTURES,
        looks=LOOKS,
        adaptation=ADAPTATION,
        picture_share=1.0,
        gain=10.0,
    )
    return dataclasses.replace(config, **changes)


def command(teacher_file: Path, out: Path) -> tuple[object, ...]:
    """The same on the command line."""
    config = small(teacher_file, out)
    names = ("teacher", "teacher_weights", "out", "steps", "batch_size", "num_images")
    names += ("looks", "adaptation", "picture_share", "gain")
    options = ((f"--{name.replace('_', '-')}", getattr(config, name)) for name in names)
    return ("distill", *(word for option in options for word in option))


def untrained(fine_width: int) -> Deltas:
    """deltas-small with a branch of this width in its detector, or none."""
    config = CONFIGS["deltas-small"]
    detector = dataclasses.replace(config.detector, fine_width=fine_width)
    torch.manual_seed(0)
    return Deltas(dataclasses.replace(config, detector=detector))


# What is recorded


@given(taught=st.lists(st.sampled_from(tuple(TEACHERS)), min_size=1, max_size=6))
def test_a_teacher_is_named_once_and_the_last_one_last(taught: list[Any]) -> None:
    record = {"origin": "encoder from EfficientNet-Lite0 (Apache-2.0)", "step": "7"}
    for teacher in taught:
        config = DistillConfig(teacher, Path("w.pth"), Path("out.safetensors"))
        record = record_of(config, record, torch.tensor(0.5))
    first, *named = record["origin"].split("; ")
    assert first == "encoder from EfficientNet-Lite0 (Apache-2.0)" and record["step"] == "7"
    assert sorted(named) == sorted(f"detector distilled from {teacher}" for teacher in set(taught))
    assert named[-1] == f"detector distilled from {taught[-1]}"
    assert record["detector_teacher"] == taught[-1] and record["detector_loss"] == "0.5000"
    licences = record["detector_teacher_licence"].split("; ")
    assert sorted(licences) == sorted({LICENCES[teacher] for teacher in taught})


def test_what_was_repeated_before_is_said_once() -> None:
    twice = "x; detector distilled from aliked; detector distilled from aliked"
    config = DistillConfig("aliked", Path("w.pth"), Path("out.safetensors"))
    record = record_of(config, {"origin": twice}, torch.tensor(0.5))
    assert record["origin"] == "x; detector distilled from aliked"


def test_the_config_offers_the_teachers_there_are() -> None:
    assert get_args(get_type_hints(DistillConfig)["teacher"]) == tuple(TEACHERS)


def test_the_loss_that_is_recorded_is_that_of_the_end(
    teacher_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    losses: list[float] = []
    real = F.cross_entropy

    def spy(logits: Tensor, target: Tensor) -> Tensor:
        loss = real(logits, target)
        losses.append(float(loss.detach()))
        return loss

    monkeypatch.setattr(F, "cross_entropy", spy)
    monkeypatch.setattr(distill_module, "RECENT", 2)
    out = distill(small(teacher_file, tmp_path / "a.safetensors", steps=20))
    recorded = float(read_metadata(out)["detector_loss"])
    assert len(losses) == 20 and recorded == pytest.approx(sum(losses[-2:]) / 2, abs=1e-4)
    assert recorded < 0.8 * losses[0]  # two pictures are soon learned by heart


def test_every_picture_and_every_step_is_reported(teacher_file: Path, tmp_path: Path) -> None:
    said: list[str] = []
    distill(small(teacher_file, tmp_path / "a.safetensors"), report=said.append)
    pictures = [f"picture {number + 1} of {PICTURES} labelled" for number in range(PICTURES)]
    assert said == [*pictures, *(f"step {number + 1} of {STEPS}" for number in range(STEPS))]


# Where it computes


@pytest.mark.parametrize(("labels", "fine_width"), [("soft", 16), ("hard", 0)])
def test_lessons_and_training_stay_on_the_device(
    labels: str, fine_width: int, teacher_file: Path
) -> None:
    config = small(teacher_file, Path("x"), labels=labels, fine_width=fine_width)
    model = untrained(fine_width).to(DEVICE)
    teacher = SuperPoint(batch_norm=True).eval().to(DEVICE)
    with one_device() as copies:
        lessons = prepare(model.encoder, teacher, config)  # type: ignore[arg-type]
    assert on_device(lessons) and lessons.scores.shape[0] == PICTURES * LOOKS
    # The picture, what the student sees of it, and two homographies for each further side.
    assert len(copies) <= PICTURES * (1 + LOOKS + 2 * (ADAPTATION - 1))
    with one_device() as copies:
        learned = train_detector(model, lessons, config)
    assert on_device((learned, model.state_dict()))
    # Which pictures, once; the table of the detector's evenly spread points in every step.
    assert Counter(copies) <= Counter({"aten::_to_copy": 1 + STEPS})


@pytest.mark.parametrize("fine_width", [0, 16])
def test_teacher_and_student_are_moved_to_the_device(
    fine_width: int, teacher_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    start = tmp_path / "start.safetensors"
    save_weights(start, untrained(fine_width), {})
    saved: list[Deltas] = []
    # Files hold values, and the stand-in has none.
    monkeypatch.setattr(distill_module, "check_learned", lambda *_: None)
    monkeypatch.setattr(distill_module, "record_of", lambda *_: {})
    monkeypatch.setattr(distill_module, "save_weights", lambda _, model, __: saved.append(model))
    config = small(teacher_file, tmp_path / "a.safetensors", init=str(start))
    with one_device():
        distill(config, device=DEVICE)
    (model,) = saved
    assert on_device(model.state_dict()) and model.config.detector.fine_width == 16


@pytest.mark.parametrize("last", [2.5, torch.inf, torch.nan])
def test_a_training_that_diverged_writes_nothing(
    last: float, teacher_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    learned = Learned(torch.tensor(1.0), torch.tensor(last))
    monkeypatch.setattr(distill_module, "train_detector", lambda *_, **__: learned)
    config = small(teacher_file, tmp_path / "a.safetensors")
    with pytest.raises(UserError, match="diverged"):
        distill(config)
    assert not config.out.exists()


def test_the_calibration_of_other_points_is_gone(teacher_file: Path, tmp_path: Path) -> None:
    assert "calibration" in read_metadata(weights_file("deltas-small"))
    out = distill(small(teacher_file, tmp_path / "a.safetensors"))
    record, said = read_metadata(out), torch.tensor([-3.0])
    assert "calibration" not in record
    assert torch.equal(load_model(out).calibration(said, 3), said)
    settings = json.loads(record["detector_config"])
    assert settings["looks"] == LOOKS and str(tmp_path) not in record["detector_config"]


@pytest.mark.parametrize(
    ("share", "said"), [(0.0, "rooms"), (1.0, "photographs"), (0.3, "rooms.*photographs")]
)
def test_only_pictures_that_were_used_are_named(share: float, said: str) -> None:
    config = DistillConfig("aliked", Path("w"), Path("o.safetensors"), picture_share=share)
    data = record_of(config, {}, torch.tensor(0.5))["detector_data"]
    assert re.search(said, data)
    assert ("rooms" in data) == (share < 1) and ("photographs" in data) == (share > 0)


# The command


def test_the_command_writes_what_the_library_does(
    run: Run, teacher_file: Path, tmp_path: Path
) -> None:
    out = tmp_path / "new" / "a.safetensors"
    told = run(*command(teacher_file, out), "--device", "cpu")
    assert (told.code, told.err) == (0, "")
    metadata = read_metadata(out)
    assert f"weights in {out}, loss {metadata['detector_loss']} at the end" in told.out
    assert metadata["detector_teacher"] == "superpoint"
    other = distill(small(teacher_file, tmp_path / "b.safetensors"))
    weights = load_file(other)
    assert all(torch.equal(weights[name], value) for name, value in load_file(out).items())
    assert read_metadata(other) == metadata


def test_what_exists_is_replaced_only_when_told_to(
    run: Run, teacher_file: Path, tmp_path: Path
) -> None:
    out = tmp_path / "a.safetensors"
    out.write_text("mine")
    told = run(*command(teacher_file, out))
    assert_one_line(told, "the file exists", str(out), "--overwrite")
    with pytest.raises(UserError, match="the file exists"):
        distill(small(teacher_file, out))
    assert out.read_text() == "mine"
    told = run(*command(teacher_file, out), "--overwrite", "--device", "cpu")
    assert told.code == 0, told.err
    origin = read_metadata(out)["origin"]
    # From what was just distilled: it is where it was, and its teacher is told once.
    told = run(*command(teacher_file, out), "--overwrite", "--init", out, "--device", "cpu")
    assert told.code == 0, told.err
    assert read_metadata(out)["origin"] == origin and origin.count("superpoint") == 1


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (("--teacher", "sift"), "--teacher takes "),
        (("--teacher-weights", "none.pth"), "no such weights, none.pth"),
        (("--init", "none"), "no such weights, none"),
        (("--out", "x.pth"), "weights are .safetensors, x.pth"),
        (("--steps", 0), "deltas: steps must be at least 1, got 0"),
        (("--learning-rate", "nan"), "deltas: learning_rate must be finite, got nan"),
        (("--picture-share", 2), "deltas: picture_share must be within [0, 1], got 2.0"),
        (("--seed", -1), "deltas: seed must be within"),
        (("--steps", "many"), "deltas: --steps takes a whole number, got many"),
        (("--device", "abacus"), "cannot compute there"),
        (("--cache", "/proc/rooms"), "cannot be written"),
    ],
)
def test_the_command_refuses_in_one_line_before_it_works(
    run: Run,
    teacher_file: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    wrong: tuple[object, ...],
    said: str,
) -> None:
    monkeypatch.setattr(distill_module, "prepare", lambda *_, **__: pytest.fail("it works"))
    assert_one_line(run(*command(teacher_file, tmp_path / "a.safetensors"), *wrong), said)
    assert not list(tmp_path.iterdir())


def test_places_that_cannot_be_written_are_named(
    run: Run, teacher_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(distill_module, "prepare", lambda *_, **__: pytest.fail("it works"))
    folder, file, out = tmp_path / "dir.safetensors", tmp_path / "file", tmp_path / "a.safetensors"
    folder.mkdir()
    file.write_text("mine")
    told = run(*command(teacher_file, folder), "--overwrite")
    assert_one_line(told, "this is a folder", str(folder), "--out")
    assert_one_line(run(*command(teacher_file, file / "a.safetensors")), "this is a file")
    assert_one_line(run(*command(teacher_file, out), "--cache", file), "--cache", str(file))
    assert_one_line(run(*command(teacher_file, Path("/proc/a.safetensors"))), "/proc")
    assert file.read_text() == "mine" and not out.exists()


def test_debug_shows_where_an_error_comes_from(run: Run, teacher_file: Path) -> None:
    with pytest.raises(UserError, match=r"weights are \.safetensors"):
        run(*command(teacher_file, Path("x.pth")), "--debug")
