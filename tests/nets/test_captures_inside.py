"""A folder that is none itself: the only capture in it is opened, of several all are named."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from small_capture import write_capture

from deltas_nets.captures.opening import open_capture
from deltas_nets.captures.readers import colmap_folder
from deltas_nets.captures.saving import save_capture
from deltas_nets.errors import UserError


def _with(folder: Path, **kinds: str) -> None:
    """Captures of formats, by the names of their folders."""
    for name, to in kinds.items():
        capture = open_capture(write_capture(folder.parent / "read" / name, num_frames=2))
        save_capture(capture, folder / name, to)


@pytest.mark.parametrize(
    "kinds",
    [
        {"a": "own", "b": "transforms"},
        {"a": "own", "b": "colmap"},
        {"a": "own", "b": "scannet", "c": "colmap-bin"},
    ],
)
def test_captures_of_any_format_are_counted_and_named(
    tmp_path: Path, kinds: dict[str, str]
) -> None:
    _with(tmp_path / "all", **kinds)
    with pytest.raises(UserError) as error:
        open_capture(tmp_path / "all")
    assert ", ".join(kinds) in error.value.what and error.value.where == tmp_path / "all"
    assert str(tmp_path / "all" / "a") in error.value.remedy


def test_a_capture_may_hold_others(tmp_path: Path) -> None:
    _with(tmp_path, whole="colmap")
    _with(tmp_path / "whole", nerf="transforms", mine="own")
    assert open_capture(tmp_path / "whole").layout == "COLMAP text"


@pytest.mark.parametrize("to", ["own", "transforms", "colmap", "scannet"])
def test_the_only_capture_of_a_folder_is_opened(tmp_path: Path, to: str) -> None:
    _with(tmp_path / "download", scan=to)
    (tmp_path / "download" / "readme.txt").write_text("thanks")
    (tmp_path / "download" / "previews").mkdir()
    outer, inner = (open_capture(tmp_path / "download" / part) for part in ("", "scan"))
    assert outer.layout == inner.layout and list(outer.frames) == list(inner.frames)


@pytest.mark.parametrize("to", ["own", "colmap"])
@pytest.mark.parametrize("shut", ["shut", "a/shut"])
def test_a_folder_that_may_not_be_read_hides_no_capture_beside_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, to: str, shut: str
) -> None:
    _with(tmp_path / "made", scan=to)
    (tmp_path / "download" / shut).mkdir(parents=True)
    (tmp_path / "made").rename(tmp_path / "download" / "b")

    def refusing(really: Callable[..., Any]) -> Callable[..., Any]:
        def asked(path: str | Path = ".") -> Any:
            if Path(path) == tmp_path / "download" / shut:
                raise PermissionError(13, "Permission denied", str(path))
            return really(path)

        return asked

    for name in ("scandir", "listdir"):
        monkeypatch.setattr(os, name, refusing(getattr(os, name)))
    assert len(open_capture(tmp_path / "download").frames) == 2


def test_of_very_many_folders_some_are_looked_into(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for number in range(40):
        (tmp_path / str(number) / "inside").mkdir(parents=True)
    looked: list[Path] = []
    monkeypatch.setattr(colmap_folder, "FOLDERS_LIMIT", 5)
    monkeypatch.setattr(colmap_folder, "_is_model", looked.append)
    assert not colmap_folder.has_model(tmp_path)
    assert len(looked) == 1 + 2 * 5


def test_it_may_lie_three_folders_down_and_no_deeper(tmp_path: Path) -> None:
    _with(tmp_path / "made", scan="own")
    (tmp_path / "a" / "b").mkdir(parents=True)
    (tmp_path / "made").rename(tmp_path / "a" / "b" / "c")
    for outer in ("a/b/c", "a/b", "a"):
        assert open_capture(tmp_path / outer).path == tmp_path / "a/b/c/scan"
    (tmp_path / "read").rename(tmp_path / "a" / "b" / ".read")
    with pytest.raises(UserError):
        open_capture(tmp_path)


def test_several_are_named_from_the_folder(tmp_path: Path) -> None:
    _with(tmp_path / "made", one="own", two="transforms")
    (tmp_path / "a").mkdir()
    (tmp_path / "made").rename(tmp_path / "a" / "b")
    with pytest.raises(UserError, match=r"2 captures \(b/one, b/two\)"):
        open_capture(tmp_path / "a")


def test_a_path_that_is_nearly_right_is_named(tmp_path: Path) -> None:
    _with(tmp_path, kitchen="own")
    with pytest.raises(UserError) as error:
        open_capture(tmp_path / "kitchn")
    assert error.value.remedy == f"did you mean {tmp_path / 'kitchen'}?"
