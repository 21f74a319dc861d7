"""Files that are whole whenever they exist, also after a power cut."""

import os
import stat
from pathlib import Path
from typing import IO

import pytest
import torch

from deltas_nets.config import TrainConfig
from deltas_nets.errors import UserError
from deltas_nets.outputs.atomic_files import write_atomically, write_json
from deltas_nets.train.log import FolderLog


def test_the_content_is_on_the_disk_before_its_name_and_the_name_at_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, events = tmp_path / "new" / "a.bin", []
    sync, rename = os.fsync, os.replace

    def synced(descriptor: int) -> None:
        opened = os.fstat(descriptor)
        if os.path.samestat(opened, path.parent.stat()):
            events.append("folder")
        else:
            events.append(f"file of {opened.st_size} bytes")
        sync(descriptor)

    def renamed(old: Path, new: Path) -> None:
        events.append(f"renamed to {new.name}")
        rename(old, new)

    monkeypatch.setattr(os, "fsync", synced)
    monkeypatch.setattr(os, "replace", renamed)
    write_atomically(path, lambda file: file.write(b"x" * 10))
    assert events == ["file of 10 bytes", "renamed to a.bin", "folder"]


def test_a_name_may_be_as_long_as_names_can_be(tmp_path: Path) -> None:
    write_json(tmp_path / ("é" * 125 + ".json"), {"a": 1})
    assert [len(os.fsencode(file.name)) for file in tmp_path.iterdir()] == [255]


def test_a_folder_that_cannot_be_synced_is_none_the_worse(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sync, folders = os.fsync, []

    def files_only(descriptor: int) -> None:
        if stat.S_ISDIR(os.fstat(descriptor).st_mode):
            folders.append(descriptor)
            raise OSError(22, "Invalid argument")  # as some network file systems answer
        sync(descriptor)

    monkeypatch.setattr(os, "fsync", files_only)
    write_json(tmp_path / "a.json", {"a": 1})
    assert (tmp_path / "a.json").read_text() == '{\n  "a": 1\n}\n'
    assert len(folders) == 1
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fstat(folders[0])  # closed


@pytest.mark.parametrize("when", ["write", "fsync", "replace"])
def test_a_write_that_fails_leaves_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, when: str
) -> None:
    path = tmp_path / "a.bin"
    path.write_bytes(b"old")

    def fails(*_: object) -> None:
        raise OSError(28, "No space left on device")

    def write(file: IO[bytes]) -> None:
        file.write(b"new")
        if when == "write":
            fails()

    if when != "write":
        monkeypatch.setattr(os, when, fails)
    with pytest.raises(UserError, match="No space left"):
        write_atomically(path, write)
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["a.bin"]


class Full:
    """A file on a disk that has place for its beginning."""

    def __init__(self) -> None:
        self.written = 0

    def write(self, content: bytes) -> int:
        self.written += len(content)
        if self.written > 2000:
            raise OSError(28, "No space left on device")
        return len(content)

    def flush(self) -> None:
        """Nothing is kept back."""


def test_a_full_disk_is_told_as_what_it_is_where_torch_speaks_of_positions(tmp_path: Path) -> None:
    content = {"weight": torch.zeros(1000)}
    with pytest.raises(UserError, match=r"No space left on device.*a\.pt"):
        write_atomically(tmp_path / "a.pt", lambda _: torch.save(content, Full()))  # type: ignore[arg-type]
    assert not list(tmp_path.iterdir())


def test_a_refusal_of_before_is_not_taken_for_this_ones(tmp_path: Path) -> None:
    def wrong(_: IO[bytes]) -> None:
        raise ValueError("a bug")

    try:
        raise OSError(28, "No space left on device")
    except OSError:
        with pytest.raises(ValueError, match="a bug"):
            write_atomically(tmp_path / "a.pt", wrong)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")
def test_a_log_on_a_full_disk_ends_in_a_line(tmp_path: Path) -> None:
    log = FolderLog(tmp_path, TrainConfig(), step=0, report=print)
    log._file.close()
    log._file = Path("/dev/full").open("a", encoding="utf-8")  # noqa: SIM115
    with log, pytest.raises(UserError, match=r"No space left on device.*log\.jsonl"):
        log.validation(1, {"abs_rel": 0.5})
