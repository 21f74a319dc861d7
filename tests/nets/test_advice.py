"""What is advised works as it is printed: in a shell, with the names that captures have."""

import json
import shlex
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from PIL import Image

from deltas_nets.captures.opening import open_capture
from deltas_nets.captures.readers import tum
from deltas_nets.check.finding import Fault, Finding
from deltas_nets.check.verdict import Checked
from deltas_nets.check.words import report_lines
from deltas_nets.commands import depth_telling, train
from deltas_nets.commands.check import Check
from deltas_nets.commands.command_line import parse
from deltas_nets.commands.convert import Convert
from deltas_nets.commands.recipe import Recipe
from deltas_nets.commands.train import Train
from deltas_nets.errors import UserError

POSE = [[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
INTRINSICS = "517.3 516.5 318.6 255.3"


def checked(cure: str) -> Checked:
    mended = Finding(Fault.POSES_INVERTED, "seen", (), cure, "error", lambda capture: capture)
    return Checked.of_refused([mended])


def test_the_command_that_mends_is_one_line_for_a_shell_with_what_opens_the_capture() -> None:
    capture = "my phone's video" + "/long" * 20
    lines = list(report_lines(checked("invert each pose"), Path(capture), INTRINSICS))
    (line,) = (line for line in lines if "deltas check" in line)
    words = shlex.split(line.strip().removeprefix("or:"))
    assert words == ["deltas", "check", capture, "--intrinsics", INTRINSICS, "--mend", "OUT"]
    given = parse([*words[1:-1], "mended"], (Check, Convert))
    assert isinstance(given, Check)
    assert (given.capture, given.intrinsics) == (Path(capture), INTRINSICS)


def test_a_cure_that_holds_a_command_is_not_broken() -> None:
    cure = "colmap automatic_reconstructor " + "--image_path 'my photos' " * 9 + "finds the poses"
    assert any(line.endswith(cure) for line in report_lines(checked(cure), Path("scan")))


def test_a_page_that_could_not_be_written_is_asked_for_by_a_whole_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(*_: object) -> None:
        raise UserError("the disk is full", tmp_path, "make room")

    monkeypatch.setattr(depth_telling, "_write", full)
    monkeypatch.setattr("deltas_nets.outputs.beside.range_of_page", lambda _: (1.0, 2.0))
    monkeypatch.setattr("deltas_nets.page.maps.has_fused", lambda _: True)
    complete = {"status": "complete"}
    monkeypatch.setattr("deltas_nets.outputs.summary.read_summary", lambda _: complete)
    capture: Any = SimpleNamespace(path=Path("my scan"))
    depth_telling.show(capture, tmp_path, (1, 2))
    assert f"; deltas page 'my scan' {tmp_path} goes on" in capsys.readouterr().err
    depth_telling.show_fused(capture, Path("my maps"), Path("my mesh"))
    told = capsys.readouterr().err
    assert "; deltas page 'my scan' 'my maps' --fused 'my mesh' goes on" in told


def test_the_capture_around_a_folder_is_named_as_a_shell_takes_it(tmp_path: Path) -> None:
    scan = tmp_path / "my scan"
    (scan / "images").mkdir(parents=True)
    (scan / "images" / "1.jpg").touch()
    (scan / "frames.json").write_text("{}")
    with pytest.raises(UserError) as error:
        open_capture(scan / "images")
    assert error.value.remedy == f"name '{scan}'"


@pytest.mark.parametrize("word", ["~/maps", "--mend=~/maps", "--json=~/maps"])
def test_a_tilde_that_the_shell_left_is_the_home(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, word: str
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("USERPROFILE", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    asked = ["check", word] if word.startswith("~") else ["check", "scan", word]
    given = parse(asked, (Check, Convert))
    assert isinstance(given, Check)
    assert tmp_path / "maps" in (given.capture, given.mend, given.json)
    (tmp_path / "~").mkdir()  # one that is really called so
    given = parse(asked, (Check, Convert))
    assert isinstance(given, Check)
    assert Path("~/maps") in (given.capture, given.mend, given.json)


@pytest.mark.parametrize(
    ("values", "told"),
    [
        ({"fx": "9"}, "without quotes"),
        ({"cam_from_world": [[str(each) for each in row] for row in POSE]}, "without quotes"),
        ({"cam_from_world": [0, 0, 0, 0, 0, 0, 1]}, "rotation as a matrix"),
        ({"cam_from_world": [10, 20, 30, 0, 0, 0]}, "rotation as a matrix"),
        ({"fx": "wide"}, "docs/captures.md"),
    ],
)
def test_slips_of_a_file_by_hand_are_told_with_their_cure(
    tmp_path: Path, values: dict[str, Any], told: str
) -> None:
    frame = {"image": "1.png", "fx": 9, "fy": 9, "cx": 3, "cy": 2, "cam_from_world": POSE}
    said = {"units": "metres", "frames": [frame | values]}
    (tmp_path / "frames.json").write_text(json.dumps(said))
    (tmp_path / "1.png").touch()
    with pytest.raises(UserError) as error:
        open_capture(tmp_path)
    assert told in error.value.remedy


def test_poses_in_nanoseconds_or_of_another_clock_are_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "1.png").touch()
    (tmp_path / "rgb.txt").write_text("1305031453.35 1.png\n")
    monkeypatch.setattr(tum, "size_of_first", lambda _: (480, 640))
    monkeypatch.setattr(tum, "_camera", lambda *_: (tum.Intrinsics.parse(INTRINSICS), ""))
    for stamp in ("1305031453350000000", "0.5"):
        (tmp_path / "groundtruth.txt").write_text(f"{stamp} 0 0 0 0 0 0 1\n")
        with pytest.raises(UserError, match=r"images of 1305031453\.35 to") as error:
            tum.read(tmp_path)
        assert "seconds of one clock" in error.value.remedy


def test_photos_that_were_renamed_are_told(tmp_path: Path) -> None:
    frame = {"image": "images/1.png", "fx": 9, "fy": 9, "cx": 3, "cy": 2, "cam_from_world": POSE}
    (tmp_path / "frames.json").write_text(json.dumps({"units": "metres", "frames": [frame]}))
    (tmp_path / "images").mkdir()
    with pytest.raises(UserError, match=r"missing are those of 1, .*frames\.json: put it"):
        open_capture(tmp_path)
    (tmp_path / "images" / "frame_0001.png").touch()
    with pytest.raises(UserError, match=r"other names \(frame_0001\.png\)") as error:
        open_capture(tmp_path)
    assert error.value.remedy.endswith("or give the photos the names that the capture has")


def test_an_image_that_is_turned_is_told_to_be(tmp_path: Path) -> None:
    frames = [
        {"image": name, "fx": 9, "fy": 9, "cx": 3, "cy": 2, "cam_from_world": POSE}
        for name in ("1.png", "2.png")
    ]
    cameras = {"units": "metres", "width": 8, "height": 6, "frames": frames}
    (tmp_path / "frames.json").write_text(json.dumps(cameras))
    Image.new("RGB", (8, 6)).save(tmp_path / "1.png")
    Image.new("RGB", (6, 8)).save(tmp_path / "2.png")
    with pytest.raises(UserError, match="rotated by 90 degrees") as error:
        open_capture(tmp_path).frames["2"].read_image()
    assert error.value.remedy.startswith("rotate it back")


@pytest.mark.parametrize(
    ("arguments", "advised"),
    [(["train", "--out", "x"], "--encoder none"), (["recipe", "night", "--out", "x"], "--init")],
)
def test_a_package_that_is_missing_is_told_with_an_option_that_the_command_has(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], advised: str
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(train, "find_spec", lambda _: None)
    command = parse(arguments, (Train, Recipe))
    with pytest.raises(UserError, match="encoder is not installed") as error:
        command.run()
    words = error.value.remedy.partition("or use ")[2].split()
    assert words[0] == advised.split()[0]
    parse([*arguments, *words], (Train, Recipe))  # it is one of its options
