"""Files that are whole whenever they exist, also after a power cut."""

import os
import stat
from pathlib import Path
from typing import IO

import pytest

from deltas_nets.errors import UserError
from deltas_nets.outputs.atomic_files import write_atomically, write_json


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
