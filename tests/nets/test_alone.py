"""One run at a time writes a folder, and one that was killed holds nobody up."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from run_command import assert_one_line, runner

from deltas_nets.errors import UserError
from deltas_nets.outputs.alone import LOCK, Written, _began, alone

Process = subprocess.Popen[bytes]


@pytest.fixture
def other() -> Iterator[Process]:
    """Another process, which lives."""
    process = subprocess.Popen(["sleep", "60"])
    yield process
    process.kill()
    process.wait()


def left_by(process: Process, written: Written, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The file of another process that writes."""
    with monkeypatch.context() as patch:
        patch.setattr(os, "getpid", lambda: process.pid)
        with alone(written):
            (file,) = (file for file in written.folder.iterdir() if LOCK.fullmatch(file.name))
    file.touch()
    return file


def test_a_living_run_is_not_written_into(
    tmp_path: Path, other: Process, monkeypatch: pytest.MonkeyPatch
) -> None:
    left_by(other, Written(tmp_path, "train"), monkeypatch)
    with pytest.raises(UserError, match=rf"another run is writing here \(process {other.pid}\)"):
        alone(Written(tmp_path, "train")).__enter__()
    assert len(list(tmp_path.iterdir())) == 1
    with alone(Written(tmp_path, "depth")):  # other things
        pass


def test_a_killed_run_holds_nobody_up(
    tmp_path: Path, other: Process, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = left_by(other, Written(tmp_path, "train"), monkeypatch)
    other.send_signal(signal.SIGKILL)
    os.waitid(os.P_PID, other.pid, os.WEXITED | os.WNOWAIT)  # a zombie, whose number is still taken
    with alone(Written(tmp_path, "train")):
        assert not file.exists()
    assert not list(tmp_path.iterdir())


def begun(file: Path, when: str) -> None:
    """Make a lock say that its process began at another time."""
    held = LOCK.fullmatch(file.name)
    assert held is not None
    file.rename(file.with_name(file.name.replace(f"~{held['began']}~", f"~{when}~")))


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="nobody knows when others began")
def test_another_process_with_the_number_of_a_killed_one_holds_nobody_up(
    tmp_path: Path, other: Process, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun(left_by(other, Written(tmp_path, "train"), monkeypatch), "1")
    with alone(Written(tmp_path, "train")):
        pass
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="nobody knows when others began")
def test_a_living_process_of_which_nobody_knew_when_it_began_holds(
    tmp_path: Path, other: Process, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun(left_by(other, Written(tmp_path, "train"), monkeypatch), "")
    with pytest.raises(UserError, match="another run"):
        alone(Written(tmp_path, "train")).__enter__()


@pytest.mark.skipif(not Path("/bin/sleep").exists(), reason="a program to give a name")
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="nobody knows when others began")
def test_brackets_in_the_name_of_a_program_are_no_end_of_it(tmp_path: Path) -> None:
    program = tmp_path / "a) Z 1"
    program.symlink_to("/bin/sleep")
    odd, plain = (subprocess.Popen([name, "60"]) for name in (program, "/bin/sleep"))
    try:
        began = [_began(process.pid) for process in (odd, plain)]
        assert None not in began and abs(int(began[0] or 0) - int(began[1] or 0)) < 1000  # ticks
    finally:
        for process in (odd, plain):
            process.kill()
            process.wait()


def test_a_run_of_another_machine_is_a_warning(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / ".train~7~8~elsewhere.example.org.deltas-lock").touch()
    with alone(Written(tmp_path, "train")):
        pass
    assert "elsewhere.example.org, process 7" in capsys.readouterr().err


def test_shards_are_beside_each_other_and_not_beside_a_whole_run(
    tmp_path: Path, other: Process, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = left_by(other, Written(tmp_path, "depth", "1/2"), monkeypatch)
    with alone(Written(tmp_path, "depth", "2/2")):
        pass
    for part in ("", "1/2"):
        with pytest.raises(UserError, match="another run"):
            alone(Written(tmp_path, "depth", part)).__enter__()
    file.unlink()
    left_by(other, Written(tmp_path, "depth"), monkeypatch)
    with pytest.raises(UserError, match="another run"):
        alone(Written(tmp_path, "depth", "1/2")).__enter__()


def test_a_folder_of_nothing_else_is_gone_afterwards(tmp_path: Path) -> None:
    with alone(Written(tmp_path / "a" / "b", "train")):
        assert (tmp_path / "a" / "b").is_dir()
    assert not list(tmp_path.iterdir())


def test_where_no_file_can_be_made_nothing_is_held(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with alone(Written(tmp_path / "file", "train")):
        pass
    assert (tmp_path / "file").is_file()


@pytest.mark.skipif(sys.platform == "win32", reason="an open file stays")
@pytest.mark.parametrize(
    ("command", "what", "part"),
    [
        ("train --out OUT --steps 1", "train", ""),
        ("train --out OUT --resume", "train", ""),
        ("recipe night --out OUT", "train", ""),
        ("demo --out OUT", "depth", ""),
        ("depth CAPTURE --out OUT", "depth", "1/2"),
        ("fuse CAPTURE sensor --out OUT", "fuse", ""),
        ("page CAPTURE OUT", "page", ""),
        ("ablate points CAPTURE --out OUT", "series", "points"),
        ("robustness order CAPTURE --out OUT", "series", "order"),
        ("redraw --out OUT/w.safetensors", "weights", "w.safetensors"),
        (
            "distill --teacher disk --teacher-weights t.pth --out OUT/w.safetensors",
            "weights",
            "w.safetensors",
        ),
    ],
)
def test_every_command_that_fills_a_folder_asks(
    tmp_path: Path,
    other: Process,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    command: str,
    what: str,
    part: str,
) -> None:
    from deltas_nets.config import TrainConfig, to_dict
    from deltas_nets.outputs.atomic_files import write_json

    out = tmp_path / "OUT"
    (tmp_path / "CAPTURE").mkdir()
    write_json(out / "config.json", to_dict(TrainConfig()))
    left_by(other, Written(out, what, part), monkeypatch)
    words = command.replace("OUT", str(out)).replace("CAPTURE", str(tmp_path / "CAPTURE"))
    said = runner(monkeypatch, capfd)(*words.split())
    assert_one_line(said, f"another run is writing here (process {other.pid}), {out}")
