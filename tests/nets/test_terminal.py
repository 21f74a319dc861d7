"""Standard output that is no terminal: a pipe that somebody reads, or nobody any more."""

import io
import resource
import subprocess
import sys
import time
from pathlib import Path

import pytest
from rich.table import Table

from deltas_nets import terminal
from deltas_nets.config import TrainConfig
from deltas_nets.train.log import FolderLog


def test_progress_is_a_line_now_and_then(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    with terminal.progress("depth", 12) as report:
        for _ in range(12):
            now[0] += 4.0  # s
            report("7")
    assert capsys.readouterr().out.splitlines() == [f"depth: {n} of 12" for n in (3, 6, 9, 12)]


def test_training_tells_so_too(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    with FolderLog(tmp_path, TrainConfig(steps=20), step=8, report=print) as log:
        for step in (9, 10, 11, 12):
            now[0] += 6.0  # s
            if step == 11:
                log.losses(step, {"total": 1.25}, rate=1e-4, seconds=6.0)
            log.progress(step)
    told = ["training: 10 of 20", "training: 12 of 20, loss 1.250"]
    assert capsys.readouterr().out.splitlines() == told


def test_what_is_quick_tells_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    with terminal.progress("depth", 3) as report:
        report("7")
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize("name", ["room[left]", "odd[/x]", ":smile:"])
def test_names_are_shown_as_they_are(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    class Screen(io.StringIO):
        def isatty(self) -> bool:
            return True

    monkeypatch.setattr(sys, "stdout", Screen())
    table = Table(name, title=name)
    table.add_row(name)
    terminal.table_console().print(table)
    with terminal.progress(name, 1) as report:
        report("7")
    assert sys.stdout.getvalue().count(name) >= 4  # type: ignore[attr-defined]


def test_all_tables_are_printed_so() -> None:
    package = Path(terminal.__file__).parent
    users = [file for file in package.rglob("*.py") if "Console(" in file.read_text("utf-8")]
    assert users == [package / "terminal.py"]


@pytest.mark.parametrize("command", ["train", "depth"])
def test_a_reader_that_has_seen_enough_is_no_error(command: str) -> None:
    code = f"import sys; sys.argv = ['deltas', '{command}', '--help']; "
    code += "from deltas_nets.cli import main; main()"
    reading = subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    assert reading.stdout is not None and reading.stderr is not None
    reading.stdout.close()
    assert reading.stderr.read() == b""
    assert reading.wait() == terminal.READER_GONE
    reading.stderr.close()


def test_another_broken_pipe_is_an_error_as_before(capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(BrokenPipeError), terminal.silent_without_reader():
        raise BrokenPipeError


def test_help_comes_at_once() -> None:
    code = "import sys; from deltas_nets import cli; sys.argv = ['deltas', '--help']\n"
    code += "try: cli.main()\n"
    code += "finally: sys.exit(bool({'torch', 'numpy', 'PIL'} & set(sys.modules)))"
    before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
    run = subprocess.run([sys.executable, "-c", code], check=False, stdout=subprocess.DEVNULL)
    assert run.returncode == 0
    # A fifth of a second here; torch alone takes two.
    assert resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before < 1
