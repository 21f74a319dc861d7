"""`deltas fuse`: what it writes, how it goes on, what it refuses."""

import json
import re
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import small_maps
import torch
from conftest import MakeCapture
from fused_scenes import write_maps
from PIL import Image
from run_command import Run, assert_one_line
from small_capture import write_capture

from deltas_nets.captures.frames import Frames
from deltas_nets.captures.opening import open_capture
from deltas_nets.captures.saving import save_capture
from deltas_nets.commands.fuse import fuse_maps
from deltas_nets.errors import UserError
from deltas_nets.fuse import FuseConfig
from deltas_nets.fuse.fusing import fuse_capture
from deltas_nets.fuse.left_out import LeftOut, cure
from deltas_nets.fuse.sizes import _up, check_memory, look_at
from deltas_nets.fuse.sources import depth_source
from deltas_nets.outputs.beside import FUSE_STATE, FUSE_SUMMARY
from deltas_nets.outputs.depth_formats import read_depth_map
from deltas_nets.outputs.products import OutputOptions

FEW = ("--neighbours", "2")


@pytest.fixture
def maps(make_capture: MakeCapture, tmp_path: Path) -> tuple[Path, Path]:
    """A capture, and the folder of its maps."""
    path = make_capture()
    write_maps(tmp_path / "maps", path)
    return path, tmp_path / "maps"


def vertices_of(path: Path) -> np.ndarray:
    """As many numbers as the header says, float, with three bytes of colour."""
    header, _, body = path.read_bytes().partition(b"end_header\n")
    count = int(header.split(b"element vertex ")[1].split()[0])
    normals = 3 if b"nx" in header else 0
    kind = np.dtype([("xyz", "<f4", 3), ("normal", "<f4", normals), ("rgb", "u1", 3)])
    return np.frombuffer(body, kind, count)["xyz"]


def test_maps_become_a_cloud_and_a_mesh(maps: tuple[Path, Path], tmp_path: Path, run: Run) -> None:
    result = run("fuse", *maps, "--out", tmp_path / "out", "--voxel", 0.05)
    assert result.code == 0, result.err
    summary = json.loads((tmp_path / "out" / FUSE_SUMMARY).read_text())
    assert summary["status"] == "complete"
    assert not (tmp_path / "out" / FUSE_STATE).exists()
    for name, count in (("cloud", "points"), ("mesh", "vertices")):
        points = vertices_of(tmp_path / "out" / f"{name}.ply")
        assert len(points) == summary[count] > 100
        assert abs(points[:, 2] - 2.5).max() < 1e-3
    again = run("fuse", *maps, "--out", tmp_path / "out", "--voxel", 0.05)
    assert "kept from an earlier run" in again.out


def test_sensor_depth_has_no_need_of_maps(
    make_capture: MakeCapture, tmp_path: Path, run: Run
) -> None:
    result = run("fuse", make_capture(), "sensor", "--out", tmp_path / "out", "--cloud")
    assert result.code == 0, result.err
    assert sorted(file.name for file in (tmp_path / "out").iterdir()) == ["cloud.ply", FUSE_SUMMARY]
    assert abs(vertices_of(tmp_path / "out" / "cloud.ply")[:, 2] - 2.5).max() < 1e-3


@pytest.mark.parametrize("suffix", [".png", ".npy"])
def test_a_scale_is_that_of_poses_and_depth_files(
    make_capture: MakeCapture, tmp_path: Path, run: Run, suffix: str
) -> None:
    capture = open_capture(make_capture())
    frames = []
    for frame in capture.frames.values():
        file = tmp_path / f"{frame.id}.npy"
        np.save(file, frame.read_depth())
        frames.append(replace(frame, depth_path=file) if suffix == ".npy" else frame)
    known = replace(capture, frames=Frames.of(frames, capture.frames.folder), metric=False)
    save_capture(known, tmp_path / "own")
    result = run(
        "fuse", tmp_path / "own", "sensor", "--scale", 2, "--out", tmp_path / "out", "--cloud"
    )
    assert result.code == 0, result.err
    points = vertices_of(tmp_path / "out" / "cloud.ply")
    assert abs(points[:, 2] - 5).max() < 1e-3
    assert (points[:, 0].min() + points[:, 0].max()) / 2 == pytest.approx(0.45, abs=0.05)


def test_a_depth_camera_aside_is_put_where_it_stands(make_capture: MakeCapture) -> None:
    capture = open_capture(make_capture(depth_size=(24, 32)))
    view = depth_source(capture, Path("sensor")).view("1")
    assert view.image_size == (24, 32)
    points = view.points().reshape(-1, 3).double() @ view.world_from_cam[:3, :3].T
    assert abs(points[:, 2] - 2.5).max() < 1e-5
    assert view.colors.float().std() > 10


def test_a_stopped_run_goes_on_and_ends_the_same(maps: tuple[Path, Path], tmp_path: Path) -> None:
    capture, folder = maps
    source = depth_source(open_capture(capture), folder)
    config = FuseConfig(voxel=0.05, neighbours=2)
    fuse_capture(source, tmp_path / "whole", config)
    added: list[str] = []

    def stop(id: str) -> None:
        added.append(id)
        if len(added) == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fuse_capture(source, tmp_path / "stopped", config, report=stop)
    assert (tmp_path / "stopped" / FUSE_STATE).exists()
    fuse_capture(source, tmp_path / "stopped", config, report=added.append)
    assert added == [*source.ids[:2], *source.ids]
    for name in ("cloud.ply", "mesh.ply"):
        whole, stopped = (vertices_of(tmp_path / out / name) for out in ("whole", "stopped"))
        np.testing.assert_allclose(stopped, whole, atol=1e-5)


def test_a_state_that_is_cut_is_begun_anew(maps: tuple[Path, Path], tmp_path: Path) -> None:
    source = depth_source(open_capture(maps[0]), maps[1])
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / FUSE_STATE).write_bytes(b"\x10")
    fused = fuse_capture(source, tmp_path / "out", FuseConfig(voxel=0.05, neighbours=2))
    assert fused.counts["points"] > 100


def test_maps_of_another_capture_are_refused(
    maps: tuple[Path, Path], tmp_path: Path, run: Run
) -> None:
    other = write_capture(tmp_path / "other", 4, step=0.2)
    assert_one_line(
        run("fuse", other, maps[1], "--out", tmp_path / "out"), "other cameras", "other"
    )
    assert not (tmp_path / "out").exists()


def test_maps_know_their_scale_whatever_is_said(
    maps: tuple[Path, Path], tmp_path: Path, run: Run
) -> None:
    result = run("fuse", *maps, "--scale", 0.3, "--out", tmp_path / "out", "--cloud")
    assert result.code == 0, result.err
    assert abs(vertices_of(tmp_path / "out" / "cloud.ply")[:, 2] - 2.5).max() < 1e-3


def test_a_folder_without_maps_is_refused(
    maps: tuple[Path, Path], tmp_path: Path, run: Run
) -> None:
    assert_one_line(run("fuse", maps[0], tmp_path, "--out", tmp_path / "out"), "no depth maps")


@pytest.mark.parametrize("kind", ["depth", "confidence"])
def test_a_corrupt_map_is_named_before_anything_is_written(
    maps: tuple[Path, Path], tmp_path: Path, run: Run, kind: str
) -> None:
    file = maps[1] / kind / "2.png"
    file.write_bytes(file.read_bytes()[:-30])
    assert_one_line(
        run("fuse", *maps, "--out", tmp_path / "out"), f"{kind}/2.png", "no whole PNG", "remove it"
    )
    assert not (tmp_path / "out").exists()


def test_voxels_too_fine_are_refused_with_those_that_fit(
    maps: tuple[Path, Path], tmp_path: Path, run: Run
) -> None:
    result = run("fuse", *maps, "--out", tmp_path / "out", "--voxel", 1e-6, "--memory", 0.1)
    assert_one_line(result, "voxels of 1e-06", "GB", "use 0.0")
    assert not (tmp_path / "out").exists()
    (fitting,) = re.findall(r"use (\S+) or more", result.err)
    source = depth_source(open_capture(maps[0]), maps[1])
    check_memory(look_at(source, float(fitting)), 0.1)


def test_voxels_of_a_cloud_that_cannot_be_counted_are_refused(
    maps: tuple[Path, Path], tmp_path: Path, run: Run
) -> None:
    asked = ("fuse", *maps, "--out", tmp_path / "out", "--cloud", "--voxel")
    result = run(*asked, 1e-6)
    assert_one_line(result, "voxels of 1e-06", "too fine")
    assert not (tmp_path / "out").exists()
    (fitting,) = re.findall(r"use (\S+) or more", result.err)
    assert run(*asked, fitting).code == 0
    assert abs(vertices_of(tmp_path / "out" / "cloud.ply")[:, 2] - 2.5).max() < 1e-3


def test_unsure_maps_get_voxels_of_a_fiftieth_of_their_depth(maps: tuple[Path, Path]) -> None:
    for file in (maps[1] / "confidence").glob("*.png"):
        Image.fromarray(np.full_like(np.array(Image.open(file)), 30)).save(file)
    sizes = look_at(depth_source(open_capture(maps[0]), maps[1], min_confidence=0), None)
    assert sizes.voxel == pytest.approx(0.02 * sizes.depth, rel=0.03)


@pytest.mark.parametrize("value", [0.0151, 0.0199, 0.02, 0.1, 0.99, 3.01, 1e-6])
def test_what_is_advised_is_rounded_up(value: float) -> None:
    assert value <= float(_up(value)) < 1.1 * value


def test_maps_that_contradict_leave_nothing_and_say_so(
    make_capture: MakeCapture, tmp_path: Path, run: Run
) -> None:
    path = make_capture()
    write_maps(tmp_path / "maps", path)
    for id in range(4):
        depth = np.full((48, 64), 1000 * (id + 1), dtype=np.uint16)
        Image.fromarray(depth).save(tmp_path / "maps" / "depth" / f"{id}.png")
    arguments = ("fuse", path, tmp_path / "maps", "--out", tmp_path / "out")
    assert_one_line(run(*arguments), "no depth is left", "--no-consistency")
    assert run(*arguments, "--no-consistency").code == 0  # what failed holds no folder


def test_advice_never_names_what_was_given(maps: tuple[Path, Path]) -> None:
    sizes = look_at(depth_source(open_capture(maps[0]), maps[1]), 0.05)
    coarse = sizes._replace(voxel=100)
    config = FuseConfig()
    assert "--voxel 0.03" in cure(LeftOut(0.1, 0.5), coarse, config)
    assert "--no-consistency" in cure(LeftOut(0, 1), coarse, config)
    assert "--least 1" in cure(LeftOut(0, 1), sizes, FuseConfig(least=3))
    assert "--min-confidence 0" in cure(LeftOut(0.9, 0.1), sizes, config)
    assert "--" not in cure(LeftOut(0, 0), sizes, config)


def test_voxels_as_large_as_the_scene_are_named(
    maps: tuple[Path, Path], tmp_path: Path, run: Run
) -> None:
    arguments = ("fuse", *maps, "--out", tmp_path / "out", "--no-consistency", "--voxel")
    assert_one_line(run(*arguments, 100, "--mesh"), "voxels of 100", "--voxel 0.03 shows more")
    few = run(*arguments, 0.3)
    assert few.code == 0 and "little was made" in few.warnings[0] and "--voxel" in few.warnings[0]
    assert few.warnings[0].endswith(f"with --overwrite in {tmp_path / 'out'}")


def test_maps_that_can_never_agree_are_refused(
    maps: tuple[Path, Path], tmp_path: Path, run: Run
) -> None:
    arguments = ("fuse", *maps, "--out", tmp_path / "out", "--least")
    assert_one_line(run(*arguments, 20), "--least 20 of 8", "--neighbours")
    assert_one_line(run(*arguments, 4), "each of 4 maps", "--least 4", "lower it")
    assert not (tmp_path / "out").exists()


def test_what_is_left_out_is_told(maps: tuple[Path, Path], tmp_path: Path, run: Run) -> None:
    """A half that is unsure; a quarter that one map has elsewhere, and edges that one sees."""
    for id in range(4):
        half = np.full((48, 64), 230, dtype=np.uint8)
        half[:24] = 20
        Image.fromarray(half).save(maps[1] / "confidence" / f"{id}.png")
    file = maps[1] / "depth" / "2.png"
    steps = np.array(Image.open(file))
    steps[36:] = 1000
    Image.fromarray(steps).save(file)
    result = run("fuse", *maps, "--out", tmp_path / "out", "--voxel", 0.05)
    assert "50% is less sure than --min-confidence 0.4, " in result.out
    left_out = json.loads((tmp_path / "out" / FUSE_SUMMARY).read_text())["left_out"]
    assert left_out["doubtful"] == 0.5 and 0.0625 <= left_out["unconfirmed"] < 0.1


def test_no_sensor_is_told_before_its_unit(
    make_capture: MakeCapture,
) -> None:
    capture = replace(open_capture(make_capture(depth_size=None)), metric=False)
    with pytest.raises(UserError, match="no sensor depth"):
        depth_source(capture, Path("sensor"))


def test_one_map_alone_is_fused_with_a_warning(
    make_capture: MakeCapture, tmp_path: Path, run: Run
) -> None:
    path = make_capture()
    write_maps(tmp_path / "maps", path)
    for id in (0, 1, 3):
        (tmp_path / "maps" / "depth" / f"{id}.png").unlink()
    summary = tmp_path / "maps" / "summary.json"
    summary.write_text(json.dumps(json.loads(summary.read_text()) | {"status": "stopped"}))
    result = run("fuse", path, tmp_path / "maps", "--out", tmp_path / "out")
    assert result.code == 0, result.err
    left_out = "3 maps of the folder left out, as not finished"
    assert result.warnings[0] == f"{left_out}: the run that fills it has not finished"
    assert len(result.warnings) == 2
    assert "none to compare" in result.warnings[1]


def test_holes_in_maps_are_holes(maps: tuple[Path, Path], tmp_path: Path, run: Run) -> None:
    for file in (maps[1] / "depth").iterdir():
        depth = np.array(Image.open(file))
        depth[:, 20:40] = 0
        Image.fromarray(depth).save(file)
    run("fuse", *maps, "--out", tmp_path / "out", "--voxel", 0.05, *FEW)
    assert len(vertices_of(tmp_path / "out" / "mesh.ply")) > 50


def test_doubtful_pixels_are_left_out(make_capture: MakeCapture, tmp_path: Path, run: Run) -> None:
    path = make_capture()
    write_maps(tmp_path / "maps", path, confidence=0.2)
    arguments = ("fuse", path, tmp_path / "maps", "--out", tmp_path / "out")
    assert_one_line(run(*arguments), "sure enough", "--min-confidence")
    assert run(*arguments, "--min-confidence", 0.1).code == 0


def test_a_file_of_somebody_else_is_not_replaced(
    maps: tuple[Path, Path], tmp_path: Path, run: Run
) -> None:
    (tmp_path / "mesh.ply").write_text("mine")
    assert_one_line(run("fuse", *maps, "--out", tmp_path), "mesh.ply", "--overwrite")
    assert (tmp_path / "mesh.ply").read_text() == "mine"


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (("--memory", 0), "--memory 0"),
        (("--memory", "nan"), "--memory nan"),
        (("--no-consistency", "--least", 3), "--least"),
        (("--no-consistency", "--neighbours", 4), "--neighbours"),
    ],
)
def test_flags_that_nothing_would_come_of_are_refused(
    maps: tuple[Path, Path], tmp_path: Path, run: Run, flags: tuple[object, ...], said: str
) -> None:
    assert_one_line(run("fuse", *maps, "--out", tmp_path / "out", *flags), said)
    of_sensor = ("fuse", maps[0], "sensor", "--min-confidence", 0.5, "--out", tmp_path / "out")
    assert_one_line(run(*of_sensor), "--min-confidence")
    assert not (tmp_path / "out").exists()


def test_glb_needs_its_extra(
    maps: tuple[Path, Path], tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "trimesh", None)
    result = run("fuse", *maps, "--out", tmp_path / "out", "--glb")
    assert_one_line(result, "trimesh", "deltas-depth[mesh]")
    assert not (tmp_path / "out").exists()


def test_torch_has_its_threads_back(maps: tuple[Path, Path], tmp_path: Path) -> None:
    before = torch.get_num_threads()
    source = depth_source(open_capture(maps[0]), maps[1])
    fuse_capture(source, tmp_path / "out", FuseConfig(voxel=0.1, neighbours=2))
    assert torch.get_num_threads() == before


def test_the_depth_command_fuses_what_is_complete(maps: tuple[Path, Path]) -> None:
    capture, folder = open_capture(maps[0]), maps[1]
    wanted = {"cloud": False, "mesh": True, "overwrite": False}
    fuse_maps(capture, folder, device="cpu", **wanted)
    assert abs(vertices_of(folder / "mesh.ply")[:, 2] - 2.5).max() < 1e-3
    assert not (folder / "cloud.ply").exists()
    (folder / "mesh.ply").unlink()
    summary = json.loads((folder / "summary.json").read_text())
    (folder / "summary.json").write_text(json.dumps({**summary, "status": "stopped"}))
    fuse_maps(capture, folder, device="cpu", **wanted)
    assert not (folder / "mesh.ply").exists()


def test_the_depth_command_warns_where_nothing_can_be_fused(
    make_capture: MakeCapture, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """What its own --min-confidence left may be less than `deltas fuse` wants."""
    path = make_capture()
    folder = tmp_path / "maps"
    capture = write_maps(folder, path, confidence=0.2)
    fuse_maps(capture, folder, cloud=False, mesh=True, device="cpu", overwrite=False)
    told = capfd.readouterr().err
    assert "nothing was fused" in told and "deltas fuse --min-confidence 0" in told


def test_maps_of_a_single_pixel_are_looked_at(maps: tuple[Path, Path], tmp_path: Path) -> None:
    for file in (maps[1] / "depth").iterdir():
        steps = np.zeros((48, 64), dtype=np.uint16)
        steps[1, 2] = 2500  # between the rows and columns of which a look takes every fourth
        Image.fromarray(steps).save(file)
    source = depth_source(open_capture(maps[0]), maps[1])
    assert look_at(source, None).area > 0
    with pytest.raises(UserError, match="no depth is left"):
        fuse_capture(source, tmp_path / "fused", FuseConfig())


def test_hardly_any_sure_pixel_is_not_told_as_maps_that_contradict(
    maps: tuple[Path, Path], tmp_path: Path
) -> None:
    for number, file in enumerate((maps[1] / "confidence").iterdir()):
        bytes = np.zeros((48, 64), dtype=np.uint8)
        bytes[number, number] = 255
        Image.fromarray(bytes).save(file)
    source = depth_source(open_capture(maps[0]), maps[1], min_confidence=1)
    with pytest.raises(UserError, match=r"sure enough \(1 or more\).*--min-confidence 0"):
        fuse_capture(source, tmp_path / "fused", FuseConfig(voxel=0.001))


def test_a_damaged_map_is_told_in_our_words_alone(
    make_capture: MakeCapture, tmp_path: Path, run: Run
) -> None:
    capture, options = make_capture(), OutputOptions(depth_format="tiff")
    file = small_maps.write_maps(capture, tmp_path / "maps", options=options) / "depth" / "1.tiff"
    file.write_bytes(
        file.read_bytes()[:100]
    )  # Pillow warns that what stands at the end is not there
    with warnings.catch_warnings(record=True) as theirs:
        warnings.simplefilter("always")
        with pytest.raises(UserError):
            read_depth_map(tmp_path / "maps", "1", 1000)
        assert theirs
        theirs.clear()
        assert_one_line(run("fuse", capture, tmp_path / "maps"), "1.tiff", "cannot be read")
        assert not theirs
