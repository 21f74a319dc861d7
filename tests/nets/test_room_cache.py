"""The cache of rendered rooms, after whatever happened to its files."""

import os
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from run_fit import CONFIG
from safetensors.torch import load_file, save_file

from deltas_nets.outputs.atomic_files import ABANDONED, remove_abandoned
from deltas_nets.rooms import Rooms
from deltas_nets.train.data_sets import training_data


def cut(file: Path) -> None:
    file.write_bytes(file.read_bytes()[:-100])


def without_depth(file: Path) -> None:
    kept = load_file(file)
    del kept["depth"]
    save_file(kept, file)


@pytest.mark.parametrize(
    "damage", [cut, without_depth, lambda file: file.write_text("text"), lambda f: f.write_text("")]
)
def test_a_damaged_room_is_rendered_again(tmp_path: Path, damage: Callable[[Path], object]) -> None:
    rooms = Rooms(1, seed=5, num_views=2, image_size=(48, 64), cache_dir=tmp_path)
    first = rooms[0]
    (file,) = tmp_path.iterdir()
    whole = file.read_bytes()
    damage(file)
    assert torch.equal(rooms[0].depth, first.depth)
    assert file.read_bytes() == whole and list(tmp_path.iterdir()) == [file]


def test_a_room_is_on_the_disk_before_it_gets_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    events: list[str] = []
    sync, rename = os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda opened: (events.append("sync"), sync(opened)))
    monkeypatch.setattr(os, "replace", lambda *names: (events.append("name"), rename(*names)))
    _ = Rooms(1, seed=5, num_views=2, image_size=(48, 64), cache_dir=tmp_path)[0]
    assert events[:2] == ["sync", "name"]


def test_what_killed_processes_left_in_a_cache_goes_when_training_starts(tmp_path: Path) -> None:
    old, young = tmp_path / ".a.1.deltas-tmp", tmp_path / ".b.2.deltas-tmp"
    for file in (old, young, tmp_path / "mine"):
        file.touch()
    long_ago = time.time() - ABANDONED - 60
    for file in (old, tmp_path / "mine"):
        os.utime(file, (long_ago, long_ago))
    training_data(replace(CONFIG, data=replace(CONFIG.data, cache=str(tmp_path))))
    # Another process may be writing the young one.
    assert sorted(tmp_path.iterdir()) == [young, tmp_path / "mine"]
    remove_abandoned(tmp_path / "none")
