"""Which file stands for a number."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from deltas_nets.captures.readers.numbered import numbered_files


def test_nanoseconds_are_numbers_and_what_no_integer_holds_is_none(tmp_path: Path) -> None:
    for stem in ("1700000000123456789", "9223372036854775808", 40 * "0" + "5", 200 * "9"):
        (tmp_path / f"{stem}.jpg").touch()
    assert list(numbered_files(tmp_path, (".jpg",))) == [5, 1700000000123456789]


@pytest.mark.parametrize("backwards", [False, True])
def test_of_two_files_of_one_number_the_choice_is_not_the_file_systems(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, backwards: bool
) -> None:
    for name in ("7.jpg", "007.jpg", "07.png", "9.jpg", "x.jpg"):
        (tmp_path / name).touch()
    listed = sorted(tmp_path.iterdir(), reverse=backwards)

    def iterdir(_: Path) -> Iterator[Path]:
        return iter(listed)

    monkeypatch.setattr(Path, "iterdir", iterdir)
    found = numbered_files(tmp_path, (".jpg", ".png"))
    assert found == {7: tmp_path / "007.jpg", 9: tmp_path / "9.jpg"}
