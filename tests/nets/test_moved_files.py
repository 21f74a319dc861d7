"""Files that are not where a capture says: what is found, and what must not be taken for them."""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from small_capture import write_capture

from deltas_nets.captures.opening import open_capture
from deltas_nets.captures.readers.files import FileFinder
from deltas_nets.outputs.atomic_files import write_json
from deltas_nets.outputs.beside import FUSE_SUMMARY, FUSE_WRITER, PREVIEWS
from deltas_nets.outputs.summary import SUMMARY, WRITER

TWO_CAMERAS = tuple(f"cam{camera}/{index}.jpg" for camera in range(2) for index in range(3))


def put(folder: Path, *names: str) -> Path:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"")
    return folder


def found(folder: Path, names: Sequence[str]) -> list[str | None]:
    """Where each of a capture's names leads, below its folder."""
    finder = FileFinder(folder, [folder / "images"], names=names)
    files = [finder.find(name) for name in names]
    return [None if file is None else file.relative_to(folder).as_posix() for file in files]


@given(
    prefix=st.sampled_from(["", "D:\\scans\\a\\images\\", "/home/b/images/", "photos/"]),
    there=st.sets(st.sampled_from(TWO_CAMERAS)),
    order=st.permutations(TWO_CAMERAS),
)
def test_no_file_stands_for_two_names(
    tmp_path_factory: pytest.TempPathFactory, prefix: str, there: set[str], order: list[str]
) -> None:
    folder = put(tmp_path_factory.mktemp("it"), *(f"images/{name}" for name in sorted(there)))
    names = [prefix + name.replace("/", "\\" if "\\" in prefix else "/") for name in order]
    files = [file for file in found(folder, names) if file is not None]
    assert len(set(files)) == len(files)
    expected = {name: f"images/{name}" for name in order if name in there}
    told = dict(zip(order, found(folder, names), strict=True))
    assert all(told[name] == file for name, file in expected.items())


@pytest.mark.parametrize("kept", [3, 5], ids=["the same frames", "more than are named"])
@pytest.mark.parametrize("prefix", ["", "/data/images/"])
def test_another_cameras_photos_are_not_those_of_a_missing_folder(
    tmp_path: Path, prefix: str, kept: int
) -> None:
    put(tmp_path, *(f"images/cam0/{index}.jpg" for index in range(kept)))
    names = [prefix + f"cam{camera}/{index}.jpg" for index in range(2, 5) for camera in (1, 0)]
    there = [f"images/cam0/{index}.jpg" if index < kept else None for index in range(2, 5)]
    assert found(tmp_path, names) == [each for file in there for each in (None, file)]


def test_maps_of_another_cameras_depth_are_not_taken(tmp_path: Path) -> None:
    put(tmp_path, "a/0.jpg", "b/0.jpg", "depth/a/0.png")
    for name in "ab":
        Image.new("RGB", (8, 6)).save(tmp_path / name / "0.jpg")
    frames = [
        {"file_path": f"{name}/0.jpg", "depth_file_path": f"depth/{name}/0.png"}
        | {"transform_matrix": np.eye(4).tolist()}
        for name in "ab"
    ]
    camera = {"fl_x": 9.0, "fl_y": 9.0, "cx": 4.0, "cy": 3.0, "w": 8, "h": 6}
    (tmp_path / "transforms.json").write_text(json.dumps(camera | {"frames": frames}))
    depths = [frame.depth_path for frame in open_capture(tmp_path).frames.values()]
    assert depths == [tmp_path / "depth/a/0.png", None]


@pytest.mark.parametrize("named", ["images/{}.jpg", "C:\\it\\rgb\\{}.jpg", "/home/it/rgb/{}.jpg"])
def test_a_folder_that_was_renamed_is_found(tmp_path: Path, named: str) -> None:
    put(tmp_path, "photos/0.jpg", "photos/1.jpg")
    assert found(tmp_path, [named.format(0), named.format(1)]) == ["photos/0.jpg", "photos/1.jpg"]


@pytest.mark.parametrize(
    ("record", "writer"), [(SUMMARY, WRITER), (FUSE_SUMMARY, FUSE_WRITER), (SUMMARY, "else")]
)
def test_what_our_commands_wrote_into_the_capture_is_no_photo(
    tmp_path: Path, record: str, writer: str
) -> None:
    put(tmp_path, "photos/0.jpg", "maps/pictures/0.jpg", "maps/pictures/1.jpg")
    write_json(tmp_path / "maps" / record, {"writer": writer, "status": "running"})
    ours = writer != "else"
    expected = ["photos/0.jpg", None] if ours else [None, "maps/pictures/1.jpg"]
    assert found(tmp_path, ["images/0.jpg", "images/1.jpg"]) == expected


def test_previews_in_the_captures_own_folder_are_no_photos(tmp_path: Path) -> None:
    put(tmp_path, "photos/0.jpg", f"{PREVIEWS}/0.jpg", f"{PREVIEWS}/1.jpg")
    assert found(tmp_path, ["images/0.jpg", "images/1.jpg"]) == ["photos/0.jpg", None]


def test_a_link_that_leads_nowhere_is_a_missing_image(tmp_path: Path) -> None:
    put(tmp_path, "images/0.jpg")
    (tmp_path / "images" / "1.jpg").symlink_to(tmp_path / "nowhere.jpg")
    assert found(tmp_path, ["images/0.jpg", "images/1.jpg"]) == ["images/0.jpg", None]


def test_a_link_that_leads_nowhere_is_no_frame_of_scannets_either(tmp_path: Path) -> None:
    image = write_capture(tmp_path / "it") / "color" / "3.jpg"
    image.unlink()
    image.symlink_to(tmp_path / "nowhere.jpg")
    assert list(open_capture(tmp_path / "it").frames) == ["0", "1", "2"]


def test_a_link_that_leads_nowhere_hides_no_image_elsewhere(tmp_path: Path) -> None:
    put(tmp_path, "photos/1.jpg")
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "1.jpg").symlink_to(tmp_path / "nowhere.jpg")
    assert found(tmp_path, ["images/1.jpg"]) == ["photos/1.jpg"]
