"""Stored results come back as they were, and say nothing of where files lie."""

import json
import math
import shlex
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from deltas_nets.errors import UserError
from deltas_nets.evaluate.record import Record, command_line, read_record, write_record

values = st.none() | st.booleans() | st.integers() | st.text(max_size=8) | st.floats(width=32)
rows = st.lists(st.dictionaries(st.text(min_size=1, max_size=5), values, max_size=4), max_size=3)


@given(rows=rows)
def test_a_record_comes_back_with_null_for_what_is_no_number(
    rows: list[dict[str, object]], tmp_path_factory: pytest.TempPathFactory
) -> None:
    file = tmp_path_factory.getbasetemp() / "record.json"
    record = Record("depth", {"views": 3}, "deltas evaluate", [{"name": "rooms"}], {}, rows)
    write_record(file, record)
    read = read_record(file)
    assert read.protocol == record.protocol and read.machine == record.machine
    for was, found in zip(rows, read.rows, strict=True):
        for name, value in was.items():
            lost = isinstance(value, float) and not math.isfinite(value)
            assert found[name] == (None if lost else value)


def test_a_row_is_flat() -> None:
    with pytest.raises(ValueError, match="abs_rel of a row must be a plain value"):
        Record("depth", rows=[{"abs_rel": [0.1]}])


def test_the_command_names_no_folder_of_the_machine() -> None:
    said = command_line(["/a/b/deltas", "detectors", "/data/walk", "sift=/x/y.pth", "runs/w.pth"])
    assert said == "deltas detectors walk sift=y.pth runs/w.pth"


def test_the_command_of_a_module_names_the_module() -> None:
    said = command_line(["/a/site-packages/deltas_nets/__main__.py", "evaluate", "walk"])
    assert said == "python -m deltas_nets evaluate walk"


def test_a_shell_reads_the_command_as_it_was_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    given = ["evaluate", "captures/the walk", "--json", "results/walk.json"]
    absolute = [given[0], str(tmp_path / given[1]), given[2], f"{tmp_path}/./{given[3]}"]
    for written in (given, absolute):
        assert shlex.split(command_line([".venv/bin/deltas", *written])) == ["deltas", *given]


def test_what_stands_beside_a_table_has_null_for_what_is_no_number(tmp_path: Path) -> None:
    beside = {"scenes": {"walk": [{"ause": math.nan}, (math.inf, 1.5)]}}
    write_record(tmp_path / "record.json", Record("depth"), beside=beside)
    read = json.loads((tmp_path / "record.json").read_text())
    assert read["scenes"] == {"walk": [{"ause": None}, [None, 1.5]]}


@pytest.mark.parametrize(
    ("content", "what"),
    [
        (None, "no such results"),
        ("{", "results cannot be read"),
        ("[]", "not a file of results"),
        ('{"writer": "deltas record", "format": 99}', "results of another version"),
        ('{"writer": "deltas record", "format": 1}', "results without table"),
    ],
)
def test_what_is_no_record_is_refused(content: str | None, what: str, tmp_path: Path) -> None:
    file = tmp_path / "record.json"
    if content is not None:
        file.write_text(content)
    with pytest.raises(UserError, match=what):
        read_record(file)


def test_rows_that_are_no_rows_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "record.json"
    write_record(file, Record("depth"))
    file.write_text(json.dumps(json.loads(file.read_text()) | {"rows": [3]}))
    with pytest.raises(UserError, match="results cannot be read"):
        read_record(file)
