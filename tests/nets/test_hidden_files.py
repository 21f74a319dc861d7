"""Files that systems hide beside those of a capture are no part of it."""

from pathlib import Path

import pytest
from written_captures import NUM, WRITERS, make_scene
from written_data_sets import DATA_SETS

from deltas_nets.captures.opening import open_capture

ALL = {**WRITERS, **DATA_SETS}


@pytest.mark.parametrize("layout", ALL)
def test_what_macos_leaves_beside_each_file_is_not_read(layout: str, tmp_path: Path) -> None:
    path = ALL[layout](tmp_path / "capture", make_scene()).path
    for file in list((tmp_path / "capture").rglob("*")):
        if file.is_file():
            (file.parent / f"._{file.name}").write_bytes(b"\0\5\x16\7\0\2\0\0Mac OS X")
            (file.parent / ".DS_Store").write_bytes(b"\0\0\0\1Bud1")
    capture = open_capture(path.parent if path.is_file() else path)
    assert len(capture.frames) == NUM and not capture.lost
