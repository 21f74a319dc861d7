"""Files that hold no weights, or not all of them, given wherever a file of torch is read."""

import io
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import nn

from deltas_nets.distill.teachers import load_teacher
from deltas_nets.errors import UserError
from deltas_nets.network.lite.efficientnet import EfficientNetLite0
from deltas_nets.network.torch_file import read_state
from deltas_nets.train.average import RunningAverage
from deltas_nets.train.checkpoint import RunState, load_run


def written(content: object, *, zipped: bool = True) -> bytes:
    file = io.BytesIO()
    torch.save(content, file, _use_new_zipfile_serialization=zipped)
    return file.getvalue()


MANY = {"a": torch.zeros(10_000)}
WRONG = {
    "empty": b"",
    "text": b"text, and more of it\n",
    "e": b"e",  # each letter means something else to a pickle
    "i": b"i am no file of weights",
    "page": b"<!DOCTYPE html><html></html>",
    "zip": b"PK\x03\x04" + bytes(100),
    "zeros": bytes(1000),
    "half": written(MANY)[:20_000],
    "half of the old kind": written(MANY, zipped=False)[:20_000],
    "first bytes": written(MANY)[:100],
    "code": written(nn.ReLU()),
    "number": written(7),
    "list": written([MANY]),
    "other weights": written(MANY),
    "no tensors": written({"conv1a.weight": 3}),
}


def resumed(file: Path) -> object:
    file.rename(file.with_name("checkpoint.pt"))
    model = EfficientNetLite0()  # it never gets as far as the network
    average = RunningAverage(model, 0.9)
    optimizer = torch.optim.SGD(model.parameters())
    return load_run(file.parent, RunState(model, average, optimizer, 0))  # type: ignore[arg-type]


READERS: dict[str, Callable[[Path], object]] = {
    "encoder": lambda file: EfficientNetLite0().load_pretrained(file),
    "checkpoint": resumed,
    "teacher": lambda file: load_teacher("superpoint", file),
}


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("wrong", WRONG)
def test_a_wrong_file_is_refused_in_a_line(tmp_path: Path, reader: str, wrong: str) -> None:
    file = tmp_path / "file.pt"
    file.write_bytes(WRONG[wrong])
    with pytest.raises(UserError) as caught:
        READERS[reader](file)
    assert str(tmp_path) in str(caught.value)
    assert len(caught.value.what) < 200
    assert "weights_only" not in str(caught.value)


@pytest.mark.parametrize("reader", READERS)
def test_a_folder_is_refused_in_a_line(tmp_path: Path, reader: str) -> None:
    (tmp_path / "file.pt").mkdir()
    with pytest.raises(UserError, match="Is a directory"):
        READERS[reader](tmp_path / "file.pt")


def test_weights_are_found_where_authors_keep_them(tmp_path: Path) -> None:
    torch.save({"epoch": 3, "state_dict": MANY | {"note": "x"}}, tmp_path / "file.pt")
    state = read_state(tmp_path / "file.pt")
    assert state.keys() == MANY.keys() and torch.equal(state["a"], MANY["a"])


@pytest.mark.parametrize("kind", [torch.float64, torch.bfloat16, torch.float8_e4m3fn], ids=str)
@pytest.mark.parametrize("number", [torch.inf, -torch.inf, torch.nan])
def test_weights_that_are_not_finite_are_refused(
    number: float, kind: torch.dtype, tmp_path: Path
) -> None:
    if kind.itemsize == 1:
        number = torch.nan  # it has no infinity
    torch.save(MANY | {"b": torch.tensor([0.0, number, 1.0]).to(kind)}, tmp_path / "file.pt")
    with pytest.raises(UserError, match=r"the weights are not finite \(b\), .*file.pt"):
        read_state(tmp_path / "file.pt")
