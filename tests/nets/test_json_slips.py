"""What people write for JSON by hand, and what they are told."""

from pathlib import Path

import pytest

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.frames import Frames
from deltas_nets.captures.opening import open_capture
from deltas_nets.captures.view_sets import read_view_sets
from deltas_nets.errors import UserError

SLIPS = {
    '{"a": 1,}': "a comma before a closing bracket",
    '{"a": [1,\n]}': "a comma before a closing bracket",
    '{"a": 1, // metres\n"b": 2}': "a comment",
    '{"a": 1 /* metres */}': "a comment",
    '# by hand\n{"a": 1}': "a comment",
    "{'a': 1}": "quotes of another kind",
    "{\u201ca\u201d: 1}": "quotes of another kind",
    '{"a": None}': "a word of Python",
    '{"a": inf}': "something that is no number",
    '{"a": 0,5}': "a decimal comma",
    '{"a": .5}': "write 0.5",
    '{"a": 1.}': "ends with its point",
    '{"a": 007}': "begins with 0",
    '{"a": "C:\\x"}': "a single backslash",
    "{a: 1}": "a name without quotes",
    '{"a": [1, ,2]}': "a comma with nothing before it",
    '{"a": 1}\n{"b": 2}': "something behind the end",
    '{"a": "1}': "closing quote is missing",
    '{"a": 1\n"b": 2}': "a comma or a closing bracket is missing",
    '{"a": [1, 2': "the file ends too early",
    '{"a": ?}': "Expecting value",
}


def read(file: Path) -> object:
    if file.name == "sets.json":
        return read_view_sets(file, Capture(file.parent, Frames.of([], file.parent), {}))
    return open_capture(file)


@pytest.mark.parametrize("bom", ["", "\ufeff"])
@pytest.mark.parametrize("text", SLIPS)
def test_a_slip_is_told_in_words_with_its_line_whoever_reads_it(
    tmp_path: Path, text: str, bom: str
) -> None:
    found = []
    for name in ("frames.json", "transforms.json", "sets.json"):
        file = tmp_path / name
        file.write_text(bom + text, encoding="utf-8")
        with pytest.raises(UserError, match=r"line \d+, column \d+: ") as error:
            read(file)
        assert SLIPS[text] in str(error.value) and error.value.where == file
        assert not error.value.remedy.endswith(" it"), "the file's name stands before: delete it?"
        found.append(error.value.what.rpartition("(")[2])
    assert len(set(found)) == 1
