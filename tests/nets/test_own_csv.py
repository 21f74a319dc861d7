"""frames.csv as people make it: by hand, in spreadsheets and by programs."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from posed_captures import image_of

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.opening import open_capture
from deltas_nets.captures.readers.own_csv import read_csv
from deltas_nets.errors import UserError

POSE = "1 0 0 0.5 0 1 0 0 0 0 1 2"
TABLE = f"""# units: metres
image,fx,fy,cx,cy,world_from_cam
images/a.png,9,9.5,3.5,2.5,{POSE}
images/b.png,9,9.5,3.5,2.5,{POSE}
"""


def capture_of(folder: Path, text: str, encoding: str = "utf-8") -> Capture:
    for name in ("a", "b"):
        (folder / "images").mkdir(exist_ok=True)
        shutil.copy(image_of((6, 8)), folder / "images" / f"{name}.png")
    (folder / "frames.csv").write_bytes(text.encode(encoding))
    return open_capture(folder)


def error_of(folder: Path, text: str) -> UserError:
    with pytest.raises(UserError) as error:
        capture_of(folder, text)
    return error.value


@pytest.mark.parametrize(
    "text",
    [
        TABLE.replace("# units: metres", "# units:,metres,,,,"),
        TABLE.replace("# units: metres", "#,units: metres,,,,"),
        TABLE.replace("# units: metres", '"# units: metres"\n"# ours, of today"'),
        TABLE.replace("# units: metres", "  # units: metres\n# author: me"),
        TABLE.replace("2.5,1", "2.5,,,,1").replace("cy,w", "cy,depth,lens,id,w"),
        TABLE.replace(f"{POSE}\n", f"{POSE},,\n"),
        TABLE.replace(POSE, f'"[{POSE.replace(" ", ", ")}]"'),
        TABLE.replace(POSE, f'"{POSE.replace(" ", chr(10))}"'),
        "SEP=;\n" + TABLE.replace(",", ";"),
    ],
    ids=["cells", "hash", "quoted", "indented", "empty", "filled", "lists", "lines", "sep"],
)
def test_a_table_as_programs_write_it_says_the_same(tmp_path: Path, text: str) -> None:
    expected = capture_of(tmp_path, TABLE)
    found = capture_of(tmp_path, text)
    assert found.metric and found.fingerprint() == expected.fingerprint()


def test_two_bytes_a_character_are_read(tmp_path: Path) -> None:
    expected = capture_of(tmp_path, TABLE).fingerprint()
    assert capture_of(tmp_path, TABLE.replace(",", "\t"), "utf-16").fingerprint() == expected
    with pytest.raises(UserError) as error:
        capture_of(tmp_path, "# Büro\n" + TABLE, "latin-1")
    assert "UTF-8" in error.value.remedy


def test_json_of_two_bytes_a_character_is_read(tmp_path: Path) -> None:
    said = read_csv_of(tmp_path, TABLE)
    capture_of(tmp_path, TABLE)
    (tmp_path / "frames.csv").unlink()
    (tmp_path / "frames.json").write_bytes(json.dumps(said).encode("utf-16"))
    assert len(open_capture(tmp_path).frames) == 2


def read_csv_of(folder: Path, text: str) -> dict[str, object]:
    (folder / "frames.csv").write_text(text, encoding="utf-8")
    return read_csv(folder / "frames.csv")


@pytest.mark.parametrize(
    ("old", "new", "what", "remedy"),
    [
        ("# units", "units", "line 1 names no column", "begin comments with #"),
        ("image,fx,fy,cx,cy,world_from_cam\n", "", "line 2 names no column", "image,fx,fy"),
        (",", "|", "line 2 names no column", "image,fx,fy"),
        ("9.5,3.5", "9,5,3,5", "line 3 has 8 cells", "semicolons"),
        ("images/b.png,9,", "images/b.png,", "line 4 has 5 cells", "may be empty"),
        ("images/a.png", '"images/a.png', "line 3 goes on to line 4: a quote", "close it"),
        ("9,9.5", "O9,9.5", "line 3 has a fx in which 'O9'", "write a number"),
        ("2.5,1 0", "2.5,1 \u22120", "in which '\u22120' is no number", "spaces between"),
        ("9.5,3.5", '"9,5",3.5', "write 0.5, not 0,5", "write a number"),
        ("cy,world", "camera,world", "no place for a camera", "frames.json"),
        ("0 1 2\n", "0 1\n", "of 11 numbers, not 12 or 16", ""),
        ("# units", "# pixel_centers: halves\n# units", "'pixel_centers'", "pixel_centres"),
    ],
)
def test_what_is_wrong_in_a_table_is_named_with_its_line(
    tmp_path: Path, old: str, new: str, what: str, remedy: str
) -> None:
    error = error_of(tmp_path, TABLE.replace(old, new))
    assert what in error.what and remedy in error.remedy
    assert error.where == tmp_path / "frames.csv"


def test_an_image_may_begin_with_the_mark_of_comments(tmp_path: Path) -> None:
    said = read_csv_of(tmp_path, TABLE.replace("images/a.png", '"#1.png"'))
    frames = said["frames"]
    assert isinstance(frames, list) and [frame["image"] for frame in frames][:1] == ["#1.png"]


def test_of_two_files_that_say_what_frames_are_one_is_named_as_not_read(tmp_path: Path) -> None:
    capture_of(tmp_path, TABLE)
    (tmp_path / "frames.json").write_text(json.dumps(read_csv(tmp_path / "frames.csv")))
    assert any("frames.csv is not read" in doubt for doubt in open_capture(tmp_path).doubts)
    assert not open_capture(tmp_path / "frames.csv").doubts


def test_points_may_be_of_a_spreadsheet_with_decimal_commas(tmp_path: Path) -> None:
    stated = TABLE.replace("# units", "# points: points.csv\n# units")
    (tmp_path / "points.csv").write_text("x;y;z\n0,5;2;3\n")
    points = capture_of(tmp_path, stated).points
    assert points is not None and points.xyz.tolist() == [[0.5, 2, 3]]
    (tmp_path / "points.csv").write_text("x y z\n0.5 2 3\n")
    error = error_of(tmp_path, stated)
    assert "'x y z'" in error.what and "x,y,z" in error.remedy


def test_a_rotation_of_few_digits_is_told_from_what_is_none(tmp_path: Path) -> None:
    turned = "0.87 -0.5 0 0 0.5 0.87 0 0 0 0 1 0"
    assert "digits" in error_of(tmp_path, TABLE.replace(POSE, turned)).remedy
    sheared = "0.87 -0.3 0 0 0.5 0.87 0 0 0 0 1 0"
    assert "shear" in error_of(tmp_path, TABLE.replace(POSE, sheared)).remedy


@given(
    pose=st.lists(st.floats(-1e6, 1e6), min_size=12, max_size=12),
    mark=st.sampled_from(";\t,"),
    end=st.sampled_from(["\n", "\r\n", "\r"]),
    quoted=st.booleans(),
    bracket=st.booleans(),
)
def test_numbers_are_the_same_however_the_table_is_written(
    tmp_path_factory: pytest.TempPathFactory,
    pose: list[float],
    mark: str,
    end: str,
    quoted: bool,
    bracket: bool,
) -> None:
    numbers = str(pose) if bracket else " ".join(map(repr, pose))
    cells = ["images/a.png", "9.25", numbers]
    if mark != ",":
        cells[1:] = [cell.replace(", ", " ").replace(".", ",") for cell in cells[1:]]
    if quoted or bracket:
        cells = [f'"{cell}"' for cell in cells]
    lines = [mark.join(["image", "fx", "world_from_cam"]), mark.join(cells)]
    said = read_csv_of(tmp_path_factory.mktemp("table"), end.join(["# units: m", *lines, ""]))
    assert said["units"] == "m"
    (frame,) = said["frames"] if isinstance(said["frames"], list) else ()
    assert frame["fx"] == 9.25 and np.array_equal(frame["world_from_cam"], pose)
