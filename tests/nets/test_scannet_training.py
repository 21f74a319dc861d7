"""Training on scenes in ScanNet's layout, and the command that does it."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from run_command import Run, assert_one_line
from run_fit import assert_same_state, logged
from small_scannet import tiny, written_list

from deltas_nets import cli
from deltas_nets.commands.command_line import parse
from deltas_nets.commands.train import Train
from deltas_nets.config import TRAIN_CONFIGS
from deltas_nets.config.scannet import ScanNetConfig
from deltas_nets.train.fit import Start, fit
from deltas_nets.weights_file import read_metadata


def test_a_resumed_run_equals_an_unbroken_one(scannet_root: Path, tmp_path: Path) -> None:
    config = replace(tiny(scannet_root, validation="test", validation_tuples=2), steps=2)
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


SMALL = [
    *("--steps", 2, "--sizes", 48, 64, "--data.height", 48, "--data.width", 64),
    *("--batch-size", 2, "--num-keypoints", 48, "--data.workers", 0, "--encoder", "none"),
    *("--min-views", 3, "--max-views", 3, "--network.matcher.num-samples", 32),
]


def test_the_command_trains_and_its_weights_name_no_folder(
    run: Run, scannet_root: Path, tmp_path: Path
) -> None:
    split = written_list(tmp_path, "scene0000_00", "scene0706_01", name="mine.txt")
    skip = written_list(tmp_path, "scene0000_00 0", name="bad.txt")
    options = ["--data.split", split, "--data.skip", skip, "--data.gap", 2]
    options += ["--data.validation", split, "--data.validation-tuples", 2]
    out, cache = tmp_path / "run", tmp_path / "cache"
    frames = ["--data", "scannet", "--root", scannet_root, "--data.cache", cache]
    done = run("train", "--out", out, *frames, *options, *SMALL)
    assert done.code == 0, done.err
    said = " ".join(done.out.split())
    assert "--data.split mine.txt: 9 times 3 views 2 frames apart" in said
    assert len(list(cache.iterdir())) == 2
    recorded = json.loads((out / "config.json").read_text())["data"]["scannet"]
    assert recorded["root"] == str(scannet_root) and recorded["split"] == str(split)
    metadata = read_metadata(out / "weights.safetensors")
    assert metadata["data"] == "ScanNet, scenes of mine.txt"
    assert "ScanNet" in metadata["licence"]
    told = json.loads(metadata["train"])["data"]
    assert told["scannet"]["root"] is None and told["cache"] is None
    assert told["scannet"]["split"] == told["scannet"]["validation"] == "mine.txt"
    assert told["scannet"]["skip"] == "bad.txt" and told["scannet"]["gap"] == 2
    assert not [value for value in metadata.values() if "/" in value.replace("SVD/", "")]
    # Scenes may have moved; what is trained on may not change.
    moved = ["--data", "scannet", "--root", scannet_root / "scans" / ".."]
    assert run("train", "--out", out, "--resume", *moved).code == 0
    assert_one_line(run("train", "--out", out, "--resume", *moved, "--data.gap", 3), "gap 2, not 3")


def test_the_papers_network_trains_by_the_papers_command(
    run: Run, scannet_root: Path, tmp_path: Path
) -> None:
    small = ["--steps", 1, "--sizes", 48, 64, "--data.height", 48, "--data.width", 64]
    small += ["--batch-size", 2, "--num-keypoints", 48, "--data.workers", 0, "--data.gap", 2]
    small += ["--data.validation", "test", "--data.validation-tuples", 1]
    paper = ["--config", "deltas-vgg9", "--data", "scannet", "--root", scannet_root]
    done = run("train", "--out", tmp_path / "run", *paper, *small)
    assert done.code == 0, done.err
    (line, _) = (tmp_path / "run" / "log.jsonl").read_text().splitlines()
    assert np.isfinite(json.loads(line)["total"])


def test_the_papers_schedule_is_the_default() -> None:
    arguments = ["train", "--out", "x", "--config", "deltas-resnet50", "--data", "scannet"]
    command = parse([*arguments, "--root", "somewhere"], cli.COMMANDS)
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
    run: Run, scannet_copy: Path, tmp_path: Path, options: list[str], words: list[str]
) -> None:
    written_list(scannet_copy, "", name="empty.txt")
    written_list(scannet_copy, "scene0000_00 *", "scene0706_01 *", name="all.txt")
    given = [option.format(scannet_copy) for option in options]
    gap = [] if "--data.gap" in options or "rooms" in options else ["--data.gap", 2]
    chosen = [] if "--data" in options else ["--data", "scannet"]
    refused = run("train", "--out", tmp_path / "run", *chosen, *gap, *given, *SMALL)
    assert_one_line(refused, *words)
    assert not (tmp_path / "run").exists()
