"""Memory that does not suffice ends a command in a line, not in a traceback."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from run_command import Run, assert_one_line

from deltas_nets.commands.memory import lacking_memory
from deltas_nets.train import fit

GPU = "CUDA out of memory. Tried to allocate 2.50 GiB. GPU 0 has a total capacity of 23.6 GiB"


def of_torch() -> None:
    torch.empty(2**60, dtype=torch.uint8)


def of_numpy() -> None:
    np.empty(2**60, dtype=np.uint8)


def of_a_gpu() -> None:
    raise torch.OutOfMemoryError(GPU)


@pytest.mark.parametrize(
    ("asks", "size"), [(of_torch, r"1\.15e\+09 GB"), (of_numpy, "1 EiB"), (of_a_gpu, r"2\.5 GiB")]
)
def test_errors_of_memory_are_known(asks: Callable[[], None], size: str) -> None:
    with pytest.raises((MemoryError, RuntimeError)) as caught:
        asks()
    said = lacking_memory(caught.value) or ""
    assert re.search(f"not enough memory for {size} at once", said)


@pytest.mark.parametrize(
    "error", [RuntimeError("shapes do not match"), KeyError("memory"), ValueError("allocate")]
)
def test_others_are_not(error: Exception) -> None:
    assert lacking_memory(error) is None


def test_a_command_says_what_needs_less(
    run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def full(*_: object, **__: object) -> None:
        of_a_gpu()

    monkeypatch.setattr(fit, "fit", full)
    asked = ("train", "--out", tmp_path / "run", "--encoder", "none")
    said = "not enough memory for 2.5 GiB at once, deltas train: raise --accumulate"
    assert_one_line(run(*asked), said)
    with pytest.raises(torch.OutOfMemoryError):
        run(*asked, "--debug")
