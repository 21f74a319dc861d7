"""`deltas recipe`: parts one after the other, each from the weights of the one before."""

import json
import sys
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest
import torch
from run_command import Run, assert_one_line, runner
from run_fit import CONFIG as CONFIG_OF_FOUR
from run_fit import HELD_OUT, logged
from safetensors.torch import save_file
from torch import Tensor

from deltas_nets.config import to_dict
from deltas_nets.config.recipes import FEWEST_ROOMS, RECIPES, Part, Recipe
from deltas_nets.errors import UserError
from deltas_nets.train import fit as fit_module
from deltas_nets.train import recipe as recipe_module
from deltas_nets.train.checkpoint import load_config
from deltas_nets.train.recipe import RECORD, Beginning, begin, run_parts
from deltas_nets.train.start import Start
from deltas_nets.weights_file import load_model, read_metadata, weights_file

CONFIG = replace(CONFIG_OF_FOUR, batch_size=2)
SMALL = Recipe(
    (
        Part("1-first", replace(CONFIG, steps=1)),
        Part("2-second", replace(CONFIG, steps=2, seed=1, learning_rate=1e-9)),
    ),
    calibration_rooms=FEWEST_ROOMS,
    calibration_size=(48, 64),
    redraw_steps=1,
    redraw_rooms=1,
    redraw_sizes=((48, 64),),
)
FIRST, SECOND = (part.name for part in SMALL.parts)


@pytest.fixture(scope="module", autouse=True)
def _small_validation() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr(fit_module, "validation_rooms", lambda: HELD_OUT)
        yield


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which the recipe was run without a break."""
    folder = tmp_path_factory.mktemp("whole")
    assert run_parts(SMALL, folder, report=silently) == folder / SECOND / "weights.safetensors"
    return folder


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Run:
    monkeypatch.setitem(RECIPES, "night", SMALL)
    return runner(monkeypatch, capfd)


def silently(message: str) -> None:
    pass


def weights_of(folder: Path, part: str) -> dict[str, Tensor]:
    return load_model(folder / part / "weights.safetensors").state_dict()


def test_a_part_starts_from_the_weights_of_the_one_before(whole: Path) -> None:
    before, after = weights_of(whole, FIRST), weights_of(whole, SECOND)
    moved = max(
        float((after[name] - before[name]).abs().max())
        for name in after
        if name.endswith("weight") and "running" not in name
    )
    assert 0 < moved < 1e-6, "the second part, whose rate is next to nothing, began elsewhere"
    for part in SMALL.parts:
        assert load_config(whole / part.name) == part.config
        assert logged(whole / part.name)[-1]["step"] == part.config.steps


def test_a_recipe_that_was_stopped_gives_the_same_weights(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    original = recipe_module.fit

    def stopped(config, folder, start, **more):  # type: ignore[no-untyped-def]
        original(config, folder, start, stop=1 if folder.name == SECOND else None, **more)
        if folder.name == SECOND:
            raise KeyboardInterrupt
        return folder / "weights.safetensors"

    monkeypatch.setattr(recipe_module, "fit", stopped)
    with pytest.raises(KeyboardInterrupt):
        run_parts(SMALL, tmp_path, report=silently)
    monkeypatch.setattr(recipe_module, "fit", original)
    run_parts(SMALL, tmp_path, report=silently)
    for part in (FIRST, SECOND):
        now, wanted = weights_of(tmp_path, part), weights_of(whole, part)
        assert all(torch.equal(now[name], wanted[name]) for name in wanted)


def test_another_recipe_in_the_folder_is_refused_before_anything_is_trained(
    whole: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = SMALL._replace(
        parts=(SMALL.parts[0], SMALL.parts[1]._replace(config=replace(CONFIG, steps=7)))
    )
    monkeypatch.setattr(recipe_module, "fit", lambda *_, **__: pytest.fail("it trained"))
    with pytest.raises(UserError, match="steps 2, not 7"):
        run_parts(other, whole, report=silently)


def test_the_command_trains_and_calibrates(tmp_path: Path, run: Run) -> None:
    out = tmp_path / "run"
    result = run("recipe", "night", "--out", out, "--workers", 0)
    assert result.code == 0, result.err
    assert "part 1 of 2: 1-first, 1 steps" in result.out
    assert result.out.splitlines()[-1] == f"finished weights in {out / 'weights.safetensors'}"
    record = read_metadata(out / "weights.safetensors")
    assert record["step"] == "2" and record["seed"] == "1"
    assert "EfficientNet-Lite0" in record["origin"] and "rooms" in record["calibration"]
    made = json.loads(record["recipe"])
    assert [part["steps"] for part in made["parts"]] == [1, 2]
    assert (made["recipe"], made["effort"], made["init"]) == ("night", 1.0, None)
    said, model = torch.tensor([-3.0]), load_model(out / "weights.safetensors")
    assert not torch.equal(model.calibration(said, 3), said)
    assert model.redraw is not None and record["redraw_step"] == "1"
    assert not (out / "redrawn.safetensors").exists()
    assert_one_line(run("recipe", "night", "--out", out, "--workers", 0), "finished", "weights")


def test_the_command_goes_on_from_weights(
    tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    starts: list[Start] = []

    def spied(config, folder, start, **_):  # type: ignore[no-untyped-def]
        starts.append(start)
        raise KeyboardInterrupt

    monkeypatch.setattr(recipe_module, "fit", spied)
    out = tmp_path / "run"
    stopped = run("recipe", "night", "--out", out, "--init", "deltas-small")
    assert (stopped.code, stopped.err) == (130, "deltas: stopped; the same command goes on\n")
    assert starts == [Start(init=weights_file("deltas-small"))]
    other = run("recipe", "night", "--out", out)
    assert_one_line(other, "begun with deltas-small.safetensors", "--init", "recipe.json")


def test_what_differs_from_the_run_to_go_on_with_is_named(tmp_path: Path) -> None:
    teacher, another = tmp_path / "teacher.pth", tmp_path / "another.pth"
    teacher.write_bytes(b"1")
    another.write_bytes(b"2")
    out, first = tmp_path / "run", Beginning("night", 0.5, None, teacher)
    for _ in range(2):
        begin(out, first)
    moved = teacher.rename(tmp_path / "moved").rename(tmp_path / "teacher.pth")
    begin(out, first._replace(teacher=moved))
    for other, said in (
        (first._replace(name="hour"), "night"),
        (first._replace(effort=1.0), "with 0.5: effort"),
        (first._replace(init=another), "without it: init"),
        (first._replace(teacher=None), "with teacher.pth"),
        (first._replace(teacher=another), "with teacher.pth"),
    ):
        with pytest.raises(UserError, match=said):
            begin(out, other)
    (out / RECORD).write_text("{")
    with pytest.raises(UserError, match="not readable"):
        begin(out, first)


@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a machine without a GPU")
def test_what_needs_a_gpu_says_so_where_there_is_none(tmp_path: Path, run: Run) -> None:
    assert_one_line(run("recipe", "hour", "--out", tmp_path / "run"), "GPU", "use night")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--effort", "0"], "--effort"),
        (["--effort", "-1"], "--effort"),
        (["--workers", "-1"], "--workers"),
        (["--teacher-weights", "missing.pth"], "missing.pth"),
        (["--init", "missing.safetensors"], "missing.safetensors"),
    ],
)
def test_nonsense_is_refused_before_anything_is_written(
    tmp_path: Path, run: Run, arguments: list[str], said: str
) -> None:
    out = tmp_path / "run"
    assert_one_line(run("recipe", "night", "--out", out, "--workers", 0, *arguments), said)
    assert not out.exists() or not any(out.iterdir())


@pytest.mark.parametrize(
    "command", [("train", "--encoder", "none"), ("recipe", "night", "--init", "deltas-small")]
)
def test_without_the_extra_of_training_nothing_is_written(
    tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch, command: tuple[str, ...]
) -> None:
    monkeypatch.setitem(sys.modules, "lightning_fabric", None)
    said = run(*command, "--out", tmp_path / "run")
    assert_one_line(said, "lightning_fabric", 'pip install "deltas-depth[train]"')
    assert list(tmp_path.iterdir()) == []


def test_files_of_another_kind_are_refused_before_the_folder_remembers_them(
    tmp_path: Path, run: Run
) -> None:
    wrong = tmp_path / "wrong.safetensors"
    save_file({"weight": torch.zeros(1)}, wrong)
    for option in ("--teacher-weights", "--init"):
        out = tmp_path / option
        assert_one_line(run("recipe", "night", "--out", out, option, wrong), "wrong.safetensors")
        assert not (out / RECORD).exists()


@pytest.mark.parametrize("name", RECIPES)
def test_scaled_taught_and_with_workers_change_nothing_else(name: str) -> None:
    recipe = RECIPES[name]  # type: ignore[index]
    changed = recipe.scaled(0.01).taught_by("aliked").with_workers(0)
    assert FEWEST_ROOMS <= changed.calibration_rooms < recipe.calibration_rooms
    for before, after in zip(recipe.parts, changed.parts, strict=True):
        assert 1 <= after.config.steps < before.config.steps
        wanted = to_dict(before.config)
        wanted |= {"steps": after.config.steps, "teacher": "aliked"}
        wanted["data"] |= {"workers": 0}
        assert to_dict(after.config) == wanted


def test_no_recipe_trains_on_rooms_that_are_held_out_or_on_a_part_s_rooms_again() -> None:
    for recipe in RECIPES.values():
        used = [
            range(part.config.data.seed, part.config.data.seed + part.config.data.num_rooms)
            for part in recipe.parts
        ]
        assert all(rooms.start >= 1000 for rooms in used)  # the seeds below are held out
        assert all(a.stop <= b.start for a, b in pairwise(used))


def test_a_recipe_begins_in_no_folder_of_other_things(tmp_path: Path) -> None:
    (tmp_path / "color").mkdir()
    with pytest.raises(UserError, match="holds something else"):
        begin(tmp_path, Beginning("night", 1.0, None, None))
    assert [file.name for file in tmp_path.iterdir()] == ["color"]
