"""The command `deltas check`: what it prints, its exit status, its JSON, its mended captures."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from room_capture import write_scene
from run_command import Run, assert_one_line

from deltas_nets.captures.opening import open_capture
from deltas_nets.check import words
from deltas_nets.check.words import report_lines
from deltas_nets.rooms import render_room

Change = Callable[[Path], None]
K_FILE = Path("intrinsic", "intrinsic_color.txt")


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Seven frames of a room; never written to."""
    folder = tmp_path_factory.mktemp("room") / "capture"
    write_scene(folder, render_room(5, num_views=7, image_size=(144, 192)))
    return folder


@pytest.fixture
def copy(room: Path, tmp_path: Path) -> Path:
    """A copy to break: text is copied, images are links."""
    folder = tmp_path / "capture"
    for file in room.rglob("*.*"):
        target = folder / file.relative_to(room)
        target.parent.mkdir(parents=True, exist_ok=True)
        if file.suffix == ".txt":
            target.write_bytes(file.read_bytes())
        else:
            target.symlink_to(file)
    return folder


def _poses(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    def plant(folder: Path) -> None:
        for file in (folder / "pose").iterdir():
            np.savetxt(file, change(np.loadtxt(file)), fmt="%.9f")

    return plant


def _K(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    def plant(folder: Path) -> None:
        np.savetxt(folder / K_FILE, change(np.loadtxt(folder / K_FILE)), fmt="%.9f")

    return plant


def _no_pose(folder: Path) -> None:
    (folder / "pose" / "3.txt").write_text("-inf " * 16)


WRITTEN: dict[str, tuple[Change, str]] = {
    "OpenGL": (_poses(lambda pose: pose @ np.diag([1.0, -1, -1, 1])), "opengl_axes"),
    "K transposed": (_K(np.transpose), "k_transposed"),
    "a lost pose": (_no_pose, "poses_lost"),
    "K halved": (_K(lambda K: np.diag([0.5, 0.5, 1]) @ K), "k_of_other_size"),
    "x and y swapped": (_K(lambda K: K[[1, 0, 2]][:, [1, 0, 2]]), "sides_swapped"),
}
SLOW = ("K halved", "x and y swapped")


def test_a_capture_that_is_well_has_no_finding(run: Run, room: Path, tmp_path: Path) -> None:
    result = run("check", room, "--json", tmp_path / "told.json")
    assert (result.code, result.err) == (0, "")
    assert "no finding" in result.out and "7 of 7 frames looked at" in result.out
    told = json.loads((tmp_path / "told.json").read_text())
    assert told["findings"] == [] and told["figures"]["residual"] < 0.5


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow if n in SLOW else ()) for n in WRITTEN]
)
def test_a_fault_is_named_and_mended_by_the_command_that_is_told(
    name: str, run: Run, copy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plant, cause = WRITTEN[name]
    plant(copy)
    report, out = tmp_path / "told.json", tmp_path / "mended"

    def printed(*told: Any) -> list[str]:
        """The reader of what is printed may have had enough of it."""
        assert report.is_file() and out.is_dir()
        return report_lines(*told)

    monkeypatch.setattr(words, "report_lines", printed)
    result = run("check", copy, "--json", report, "--mend", out)
    assert result.code == 1
    (found,) = json.loads(report.read_text())["findings"]
    assert found["cause"] == cause and found["evidence"] and found["cure"]
    assert f"deltas check {copy} --mend OUT" in " ".join(result.out.split())
    assert open_capture(out).layout != "" and run("check", out).code == 0


def test_a_place_that_is_taken_is_told_before_anything_is_matched(
    run: Run, copy: Path, tmp_path: Path
) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("mine")
    told = run("check", copy, "--mend", tmp_path / "mine")
    assert told.code == 2 and "not empty" in told.err and "matching" not in told.out


NO_POSES: dict[str, tuple[Callable[[np.ndarray], np.ndarray], str]] = {
    "mirrored": (lambda pose: pose @ np.diag([1.0, 1, -1, 1]), "poses_mirror"),
    "scaled": (lambda pose: pose @ np.diag([2.5, 2.5, 2.5, 1]), "poses_scale"),
    "transposed": (np.transpose, "poses_transposed"),
    "sheared": (lambda pose: pose @ (np.eye(4) + np.eye(4, k=1) * 0.1), "refused"),
}


@pytest.mark.parametrize("name", NO_POSES)
def test_matrices_that_are_no_poses_are_told_as_such(
    name: str, run: Run, copy: Path, tmp_path: Path
) -> None:
    change, cause = NO_POSES[name]
    _poses(change)(copy)
    result = run("check", copy, "--json", tmp_path / "told.json", "--mend", tmp_path / "mended")
    (found,) = json.loads((tmp_path / "told.json").read_text())["findings"]
    assert result.code == 1 and found["cause"] == cause and "pose" in found["evidence"]
    assert "is not written" in result.out and not (tmp_path / "mended").exists()


def test_nothing_is_written_where_nothing_is_found(run: Run, room: Path, tmp_path: Path) -> None:
    result = run("check", room, "--mend", tmp_path / "mended")
    assert result.code == 0 and "nothing to mend" in result.out
    assert not (tmp_path / "mended").exists()


def test_a_capture_that_nothing_mends_is_one_finding(run: Run, copy: Path, tmp_path: Path) -> None:
    (copy / K_FILE).write_text("no matrix")
    result = run("check", copy, "--json", tmp_path / "told.json", "--mend", tmp_path / "mended")
    (found,) = json.loads((tmp_path / "told.json").read_text())["findings"]
    assert result.code == 1 and found["cause"] == "refused" and str(K_FILE) in found["evidence"]
    assert not (tmp_path / "mended").exists()


def test_what_is_not_there_cannot_be_checked(run: Run, tmp_path: Path) -> None:
    assert_one_line(run("check", tmp_path / "nowhere"), "does not exist")
