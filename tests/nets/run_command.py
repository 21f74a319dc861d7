"""The `deltas` command in the tests' own process."""

import sys
from collections.abc import Callable

import pytest

from deltas_nets import cli

Run = Callable[..., "Result"]


class Result:
    """What a command left behind."""

    def __init__(self, code: int, out: str, err: str) -> None:
        self.code, self.out, self.err = code, out, err

    @property
    def warnings(self) -> list[str]:
        """What it warned of, but for bad maps: the networks of tests are not trained."""
        lines = [line.removeprefix("deltas: warning: ") for line in self.err.splitlines()]
        return [line for line in lines if not line.startswith(("mean confidence", "points of"))]


def runner(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Run:
    """A function that runs `deltas` with arguments."""

    def run(*arguments: object) -> Result:
        monkeypatch.setattr(sys, "argv", ["deltas", *map(str, arguments)])
        code = 0
        try:
            cli.main()
        except SystemExit as stopped:
            code = int(stopped.code or 0)
        captured = capfd.readouterr()
        return Result(code, captured.out, captured.err)

    return run


def assert_one_line(result: Result, *parts: str) -> None:
    """The command refused, in one line that holds these parts."""
    assert result.code == 2
    assert result.err.startswith("deltas: ")
    assert result.err.count("\n") == 1
    for part in parts:
        assert part in result.err, result.err
