"""Every file that a command is to write is looked at before the work that it is for."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest
from run_command import Run, assert_one_line

from deltas_nets.errors import UserError
from deltas_nets.outputs.atomic_files import check_file, write_json

COMMANDS = (
    "evaluate --rooms 1 --json",
    "evaluate --rooms 1 --csv",
    "cost deltas-small --json",
    "check CAPTURE --json",
    "detectors CAPTURE --detectors orb --json",
    "redraw --out w.safetensors --log",
    "redraw --overwrite --out",
    "calibrate --overwrite --out",
    "calibrate --out",
    "export --overwrite --out",
)


@pytest.mark.parametrize("command", COMMANDS)
def test_a_folder_is_refused_at_once(
    run: Run,
    make_capture: Callable[..., Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    command: str,
) -> None:
    def worked(*_: object, **__: object) -> None:
        raise AssertionError("the work was begun")

    for work in ("predict.predictor.load_predictor", "weights_file.load_model"):
        monkeypatch.setattr(f"deltas_nets.{work}", worked)
    capture, suffix = make_capture(), ".onnx" if "export" in command else ".safetensors"
    folder = tmp_path / f"folder{suffix}"
    folder.mkdir()
    words = [str(capture) if word == "CAPTURE" else word for word in command.split()]
    monkeypatch.chdir(tmp_path)
    assert_one_line(run(*words, folder), "this is a folder, not a file", folder.name)
    assert not list(folder.iterdir())


def test_what_can_be_written_is_left_as_it_is(tmp_path: Path) -> None:
    (tmp_path / "old").write_text("old")
    for name in ("old", "new", "deeper/new"):
        check_file(tmp_path / name)
    assert [path.name for path in tmp_path.iterdir()] == ["old"]
    with pytest.raises(UserError, match=r"folder, not a file.*: name it"):
        check_file(tmp_path, remedy="name it")


def test_devices_and_pipes_are_not_replaced(tmp_path: Path) -> None:
    pipe, link, out = tmp_path / "pipe", tmp_path / "link", tmp_path / "stdout"
    os.mkfifo(pipe)
    link.symlink_to(pipe)
    out.symlink_to("/proc/self/fd/1")  # what /dev/stdout is, wherever that leads
    before = {path: path.lstat().st_ino for path in (pipe, link, out)}
    for path in before:
        for write in (check_file, lambda path: write_json(path, {})):
            with pytest.raises(UserError, match="a device or a pipe"):
                write(path)
    assert {path: path.lstat().st_ino for path in tmp_path.iterdir()} == before
