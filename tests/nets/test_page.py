"""The page beside depth maps: what it says is what the files say, and it stays small."""

import base64
import json
import os
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import MakeCapture
from PIL import Image
from run_command import Run, assert_one_line
from small_maps import mesh_of, write_maps

from deltas_nets.captures.opening import open_capture
from deltas_nets.captures.scaled import scaled
from deltas_nets.config import DetectorConfig, MatcherConfig, NetworkConfig
from deltas_nets.errors import UserError
from deltas_nets.evaluate.capture import evaluate_files
from deltas_nets.network.deltas import Deltas
from deltas_nets.outputs.products import OWN_UNIT, OutputOptions
from deltas_nets.outputs.summary import recorded_view_sets
from deltas_nets.page import write
from deltas_nets.page.budget import Chosen
from deltas_nets.page.colours import ERROR
from deltas_nets.page.maps import open_maps
from deltas_nets.page.scene import camera_of, layers_of
from deltas_nets.page.write import write_page
from deltas_nets.weights_file import save_weights

ODD = "a & b <script>alert(1)<!--</script> \u2028'\""
"""An id that no page may take for its own words; a file may be called so."""


@pytest.fixture
def filled(make_capture: MakeCapture, tmp_path: Path) -> tuple[Path, Path]:
    """A capture of four frames and its maps."""
    capture = make_capture()
    return capture, write_maps(capture, tmp_path / "maps")


def page_of(capture: Path, folder: Path) -> write.Page:
    return write_page(open_maps(open_capture(capture), folder))


def data_of(folder: Path) -> dict[str, Any]:
    """What the page was given."""
    text = (folder / "index.html").read_text(encoding="utf-8")
    (data,) = re.findall(r'<script type="application/json" id="data">(.*?)</script>', text, re.S)
    found: dict[str, Any] = json.loads(data)
    return found


# What is shown


def test_a_camera_sees_what_its_outline_holds(make_capture: MakeCapture) -> None:
    frame = open_capture(make_capture()).frame("1")
    camera = camera_of(frame)
    left, top, right, bottom = camera.slopes
    corners = np.array([[left, top, 1], [right, bottom, 1]])
    pixels = (corners @ frame.K.T)[:, :2]
    np.testing.assert_allclose(pixels, [[-0.5, -0.5], [63.5, 47.5]], atol=1e-9)
    np.testing.assert_allclose(camera.world_from_cam @ frame.cam_from_world, np.eye(4), atol=1e-9)


def test_the_page_holds_every_map_and_needs_nothing_else(filled: tuple[Path, Path]) -> None:
    capture, folder = filled
    (folder / "preview").mkdir()
    (folder / "preview" / ".1.jpg.0a1b2c3d.deltas-tmp").write_bytes(b"half")
    page = page_of(capture, folder)
    assert sorted(os.listdir(folder / "preview")) == ["0.jpg", "1.jpg", "2.jpg", "3.jpg"]
    assert (page.maps, page.shown) == (4, 4) and page.size == page.path.stat().st_size
    text = page.path.read_text(encoding="utf-8")
    assert not re.search(r"https?:|//cdn|@import|url\(|<link|\bsrc=", text)
    data = data_of(folder)
    assert [frame["id"] for frame in data["frames"]] == ["0", "1", "2", "3"]
    assert list(data["kinds"]) == ["image", "depth", "confidence", "error", "truth"]
    assert all(frame["pictures"].keys() == data["kinds"].keys() for frame in data["frames"])
    assert data["verdict"]["line"].startswith("mean confidence 0.60") and not data["notes"]
    assert [camera["frame"] for camera in data["scene"]["cameras"]] == [0, 1, 2, 3]
    with Image.open(folder / "preview" / "2.jpg") as preview:
        red, _, blue = np.asarray(preview)[24, 0]
        assert red > blue + 50  # near
        red, _, blue = np.asarray(preview)[24, 63]
        assert blue > red  # far
    with Image.open(folder / "contact_sheet.jpg") as sheet:
        assert np.asarray(sheet).std() > 20


def test_errors_are_those_of_evaluate(filled: tuple[Path, Path]) -> None:
    capture, folder = filled
    page_of(capture, folder)
    facts = {name: value for name, value, _ in data_of(folder)["facts"]}
    scores = evaluate_files(folder, open_capture(capture), recorded_view_sets(folder))
    assert facts["Abs Rel"] == f"{scores.dense.abs_rel:.3f}" == "0.102"
    assert facts["δ < 1.25"] == f"{scores.dense.delta1:.3f}"


def test_sensor_depth_that_is_damaged_leaves_out_the_errors_of_its_frame_alone(
    filled: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    capture, folder = filled
    damaged = capture / "depth" / "2.png"
    damaged.write_bytes(damaged.read_bytes()[:-30])
    assert page_of(capture, folder).shown == 4
    frames = {frame["id"]: frame["pictures"].keys() for frame in data_of(folder)["frames"]}
    assert [id for id, pictures in frames.items() if "error" not in pictures] == ["2"]
    said = capsys.readouterr().err
    what = "the page is without errors of 1 frame: the sensor depth cannot be decoded"
    assert said.count("warning") == 1 and what in said and str(damaged) in said


def test_points_of_the_maps_are_shown_where_they_are(filled: tuple[Path, Path]) -> None:
    capture, folder = filled
    (layer,) = layers_of(open_maps(open_capture(capture), folder))
    # The slanted plane z = 2 to 3 before the cameras at x = 0 to 0.45.
    assert 2.0 <= layer.surface.xyz[:, 2].min() < layer.surface.xyz[:, 2].max() <= 3.0
    assert layer.surface.xyz[:, 0].max() == pytest.approx(0.45 + 1.5, abs=0.05)
    fused = folder.parent / "fused"
    mesh_of(fused)
    (mesh,) = layers_of(open_maps(open_capture(capture), folder, fused))
    assert mesh.name == "mesh" and mesh.surface.faces is not None


def test_the_scene_on_the_page_is_in_the_world(filled: tuple[Path, Path]) -> None:
    capture, folder = filled
    page_of(capture, folder)
    scene = data_of(folder)["scene"]
    pose = np.array(scene["cameras"][1]["pose"]).reshape(3, 4)
    origin = np.array([0.15, 0, 0]) - pose[:, 3]  # where frame 1 stands
    (layer,) = scene["layers"]
    steps = np.frombuffer(base64.b64decode(layer["xyz"]), "<u2").reshape(-1, 3) / 65535
    shown = origin + np.array(layer["low"]) + steps * np.array(layer["span"])
    (real,) = layers_of(open_maps(open_capture(capture), folder))
    np.testing.assert_allclose(shown, real.surface.xyz, atol=1e-4)  # m


def test_maps_know_the_scale_that_they_were_made_with(
    make_capture: MakeCapture, tmp_path: Path
) -> None:
    capture = make_capture()
    folder = write_maps(scaled(scaled(open_capture(capture), 4), 0.5), tmp_path / "maps")
    maps = open_maps(open_capture(capture), folder)
    assert maps.capture.frame("3").cam_from_world[0, 3] == pytest.approx(-2 * 0.45)  # m
    assert open_maps(maps.capture, folder).capture is maps.capture
    other = open_maps(scaled(open_capture(capture), 8), folder).capture
    assert other.fingerprint() == maps.capture.fingerprint()


def test_unsure_points_are_left_out(filled: tuple[Path, Path]) -> None:
    capture, folder = filled
    half = np.zeros((48, 64), np.uint8)
    half[:, :32] = 255
    for file in (folder / "confidence").iterdir():
        Image.fromarray(half).save(file)
    (layer,) = layers_of(open_maps(open_capture(capture), folder))
    assert layer.surface.xyz[:, 2].max() < 2.52  # m: what is right of the middle is farther


def test_a_page_of_many_maps_stays_small(
    filled: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    capture, folder = filled
    whole = page_of(capture, folder).size
    monkeypatch.setattr(write, "MOST_BYTES", whole - 8000)
    page = page_of(capture, folder)
    assert page.size <= whole - 8000 and page.shown < 4
    data = data_of(folder)
    assert f"{page.shown} of 4 maps" in page.line and f"{page.shown} of 4" in data["notes"][0]
    assert len(data["scene"]["cameras"]) == 4 and len(list((folder / "preview").iterdir())) == 4


def test_a_page_that_was_misjudged_leaves_frames_out(
    filled: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    capture, folder = filled
    monkeypatch.setattr(write, "MOST_BYTES", page_of(capture, folder).size - 8000)
    monkeypatch.setattr(write, "choose", lambda ids, *_: Chosen(tuple(ids), 640))
    page = page_of(capture, folder)
    assert page.size <= write.MOST_BYTES and page.shown == 2


def test_a_capture_without_metres_sensor_or_confidence(
    make_capture: MakeCapture, tmp_path: Path
) -> None:
    capture = make_capture(depth_size=None)
    folder = tmp_path / "maps"
    write_maps(capture, folder, options=OutputOptions(confidence=False, unit=OWN_UNIT))
    page_of(capture, folder)
    data = data_of(folder)
    assert list(data["kinds"]) == ["image", "depth"]
    assert data["scales"]["depth"]["unit"] == "units" and "no metres" in data["notes"][0]


def test_one_frame_and_a_map_without_depth(make_capture: MakeCapture, tmp_path: Path) -> None:
    capture = make_capture(1)
    folder = write_maps(capture, tmp_path / "maps", depth=np.zeros)
    assert page_of(capture, folder).shown == 1
    data = data_of(folder)
    assert data["scene"]["layers"] == []
    assert "nan" not in data["frames"][0]["facts"].values()


def test_ids_are_not_taken_for_the_pages_own_words(
    make_capture: MakeCapture, tmp_path: Path
) -> None:
    capture = make_capture()
    folder = write_maps(capture, tmp_path / "maps")
    maps = open_maps(open_capture(capture), folder)
    frame = write.shown_frame(write.pictures_of(maps, "0", maps.depth("0"), ERROR, (0.5, 10)))
    page = write.html_of(maps, [frame._replace(id=ODD)], [], ERROR, (0.5, 10))
    (folder / "index.html").write_bytes(page)
    assert data_of(folder)["frames"][0]["id"] == ODD


def test_depth_ends_with_a_page_unless_told_otherwise(
    run: Run, make_capture: MakeCapture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = NetworkConfig(
        detector=DetectorConfig(num_keypoints=48), matcher=MatcherConfig(num_samples=32)
    )
    save_weights(tmp_path / "small.safetensors", Deltas(config), {"step": "0"})
    command = ["depth", make_capture(2), "--weights", tmp_path / "small.safetensors", "--out"]
    without = run(*command, tmp_path / "without", "--no-page")
    assert without.code == 0 and not (tmp_path / "without" / "index.html").exists()
    shown = run(*command, tmp_path / "with")
    assert f"look at {tmp_path / 'with' / 'index.html'}" in shown.out
    assert len(data_of(tmp_path / "with")["frames"]) == 2

    def full(*_: object, **__: object) -> None:
        raise UserError("no space", "disk", "make some")

    monkeypatch.setattr(write, "write_page", full)
    hindered = run(*command, tmp_path / "hindered")
    assert hindered.code == 0 and "no space" in hindered.warnings[-1]


def test_the_verdict_and_the_scores_say_what_they_rest_on(filled: tuple[Path, Path]) -> None:
    capture, folder = filled
    file = folder / "summary.json"
    summary = json.loads(file.read_text())
    summary["settings"]["sensor_depth"] = {"from": "sensor"}
    for record in summary["frames"].values():
        record["network_confidence"] = 0.2  # before maps heard each other
    file.write_text(json.dumps(summary))
    page_of(capture, folder)
    data = data_of(folder)
    assert data["verdict"]["line"].startswith("mean confidence 0.20")
    assert len(data["notes"]) == 1 and "they are scored against" in data["notes"][0]
    for record in summary["frames"].values():
        record["measured_factor"] = 5.04
    file.write_text(json.dumps(summary))
    page_of(capture, folder)
    assert "5.04 times as far" in data_of(folder)["verdict"]["line"]


# What is wrong


def test_missing_maps_are_told(filled: tuple[Path, Path], run: Run) -> None:
    capture, folder = filled
    (folder / "depth" / "1.png").unlink()
    result = run("page", capture, folder)
    assert result.code == 0 and result.warnings == ["1 of 4 maps are missing: 1"]
    assert "1 map missing" in data_of(folder)["notes"][0]


@pytest.mark.parametrize("name", ["depth/2.png", "confidence/2.png", "points/2.ply"])
@pytest.mark.parametrize("content", [b"", b"no picture", -30])
def test_a_damaged_file_is_named_and_the_page_stays(
    filled: tuple[Path, Path], run: Run, name: str, content: bytes | int
) -> None:
    capture, folder = filled
    (folder / "index.html").write_text("as it was")
    file = folder / name
    file.write_bytes(content if isinstance(content, bytes) else file.read_bytes()[:content])
    assert_one_line(run("page", capture, folder), name, "remove it")
    assert (folder / "index.html").read_text() == "as it was"


def test_folders_that_are_none_of_ours(
    filled: tuple[Path, Path], run: Run, make_capture: MakeCapture, tmp_path: Path
) -> None:
    capture, folder = filled
    assert_one_line(run("page", capture, tmp_path / "nowhere"), "summary.json", "run it first")
    other = make_capture(path=tmp_path / "other", step=0.2)
    assert_one_line(run("page", other, folder), "other cameras", "the capture that they were made")
    assert_one_line(run("page", capture, folder, "--fused", tmp_path), "no mesh.ply", "deltas fuse")
    shutil.rmtree(folder / "depth")
    assert_one_line(run("page", capture, folder), "no depth map", "deltas depth first")


def test_a_damaged_archive_is_named(make_capture: MakeCapture, tmp_path: Path, run: Run) -> None:
    capture = make_capture()
    write_maps(capture, tmp_path / "maps", options=OutputOptions(depth_format="npz"))
    assert run("page", capture, tmp_path / "maps").code == 0
    file = tmp_path / "maps" / "depth" / "3.npz"
    for content in (file.read_bytes()[:-30], b"PK", b""):
        file.write_bytes(content)
        assert_one_line(run("page", capture, tmp_path / "maps"), "depth/3.npz")


@pytest.mark.parametrize(
    "frames", [{}, {"0": 3, "1": {"confidence": "high", "keypoints": 9}, "2": {"sources": 7}}]
)
def test_a_summary_of_another_version_says_less(
    filled: tuple[Path, Path], frames: dict[str, Any]
) -> None:
    capture, folder = filled
    file = folder / "summary.json"
    settings = json.loads(file.read_text())["settings"]
    kept = {"view_sets": settings["view_sets"]}
    file.write_text(json.dumps({"writer": "deltas depth", "settings": kept, "frames": frames}))
    assert page_of(capture, folder).shown == 4
    assert data_of(folder)["verdict"]["line"] == "nothing to judge by"
