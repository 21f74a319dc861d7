"""A file is one idea, and an idea can be read at once."""

from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
MOST = 300
"""Lines."""


@pytest.mark.parametrize("package", ["deltas_geom", "deltas_nets"])
def test_no_file_is_longer_than_can_be_read_at_once(package: str) -> None:
    lengths = {
        str(path.relative_to(ROOT)): len(path.read_text(encoding="utf-8").splitlines())
        for path in (ROOT / package).rglob("*.py")
    }
    assert {name: lines for name, lines in lengths.items() if lines > MOST} == {}
    assert max(lengths.values()) > MOST // 2, "the files of the package were found"
