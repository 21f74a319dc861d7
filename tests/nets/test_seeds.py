"""Confident points of depth maps, with tracks: as COLMAP itself would have them."""

from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from conftest import MakeCapture
from PIL import Image
from run_command import Run, assert_one_line
from small_maps import map_of, write_maps

from deltas_nets.captures.opening import open_capture
from deltas_nets.captures.saving import save_capture
from deltas_nets.captures.scaled import in_metres
from deltas_nets.outputs.products import OWN_UNIT, OutputOptions

SIZE = (48, 64)
OWN = OutputOptions(unit=OWN_UNIT)


@pytest.fixture
def capture(make_capture: MakeCapture) -> Path:
    return make_capture()  # four frames, a wall at 2.5 m


def wall(size: tuple[int, int]) -> np.ndarray:
    return np.full(size, 2.5)


@pytest.mark.parametrize("to", ["colmap", "colmap-bin"])
def test_a_model_has_our_points_with_tracks(
    run: Run, capture: Path, tmp_path: Path, to: str
) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    maps = write_maps(capture, tmp_path / "maps", depth=wall)
    out = tmp_path / "model"
    said = run("convert", capture, out, "--to", to, "--depths", maps, "--points", 200)
    assert said.code == 0, said.err
    model = pycolmap.Reconstruction(out / "sparse" / "0")
    assert 100 < len(model.points3D) <= 260
    for point in model.points3D.values():
        assert point.xyz[2] == pytest.approx(2.5, abs=1e-3)
        assert point.track.length() >= 2 and 0 <= point.error < 0.1
        for element in point.track.elements:
            image = model.images[element.image_id]
            seen = image.points2D[element.point2D_idx].xy
            assert image.project_point(point.xyz) == pytest.approx(seen, abs=1e-3)
            assert (seen >= 0).all() and (seen <= SIZE[::-1]).all()
    seen_by = [sum(p.has_point3D() for p in image.points2D) for image in model.images.values()]
    assert min(seen_by) > 50


def test_maps_go_along_as_depth(run: Run, capture: Path, tmp_path: Path) -> None:
    maps = write_maps(capture, tmp_path / "maps", depth=wall)
    out = tmp_path / "nerf"
    flags = ("--to", "transforms", "--depths", maps, "--points", 50)
    assert run("convert", capture, out, *flags).code == 0
    written = open_capture(out)
    assert written.points is not None and len(written.points.xyz) >= 25
    for frame in written.frames.values():
        assert frame.depth_path is not None and out in frame.depth_path.parents
        assert np.abs(frame.read_depth() - 2.5).max() < 1e-3


@pytest.mark.parametrize("known", [False, True])
def test_maps_points_and_poses_are_brought_into_metres_together(
    run: Run, capture: Path, tmp_path: Path, known: bool
) -> None:
    """Whether `deltas depth` was told the unit or not."""
    save_capture(replace(open_capture(capture), metric=False), tmp_path / "own")
    opened = open_capture(tmp_path / "own")
    made, options = (in_metres(opened, 0.3), OutputOptions()) if known else (opened, OWN)
    deep = 2.5 * (0.3 if known else 1)
    maps = write_maps(
        made, tmp_path / "maps", options=options, depth=lambda size: np.full(size, deep)
    )
    flags = ("--depths", maps, "--scale", 0.3, "--points", 50)
    said = run("convert", tmp_path / "own", tmp_path / "out", *flags)
    assert said.code == 0, said.err
    written = open_capture(tmp_path / "out")
    assert written.metric and written.points is not None
    assert np.abs(written.frame(1).read_depth() - 0.75).max() < 1e-3
    assert np.abs(written.points.xyz[:, 2] - 0.75).max() < 1e-3
    assert written.frame(3).cam_from_world[0, 3] == pytest.approx(-0.3 * 0.45)


def test_what_no_other_map_confirms_is_no_point(run: Run, capture: Path, tmp_path: Path) -> None:
    wrong = iter([1.0, 2.0, 4.0, 8.0])

    def half_true(size: tuple[int, int]) -> np.ndarray:
        depth = np.full(size, 2.5)
        depth[: size[0] // 2] = next(wrong)
        return depth

    maps = write_maps(capture, tmp_path / "maps", depth=half_true)
    assert run("convert", capture, tmp_path / "out", "--depths", maps, "--points", 400).code == 0
    points = open_capture(tmp_path / "out").points
    assert points is not None
    assert (points.xyz[:, 1] > 0).all()  # the lower half of the images


def test_without_agreement_it_is_said(run: Run, capture: Path, tmp_path: Path) -> None:
    depths = iter([1.0, 2.0, 4.0, 8.0])
    maps = write_maps(capture, tmp_path / "maps", depth=lambda size: np.full(size, next(depths)))
    said = run("convert", capture, tmp_path / "out", "--depths", maps)
    assert_one_line(said, "no two maps agree")
    assert not (tmp_path / "out").exists()
    assert_one_line(run("convert", capture, tmp_path / "out", "--points", 0), "--points 0")


def test_points_of_maps_in_floats_go_into_a_model(
    run: Run,
    capture: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    options = OutputOptions(depth_format="npz")
    maps = write_maps(capture, tmp_path / "maps", depth=wall, options=options)

    def saving(*told: Any, **more: Any) -> list[str]:
        """The reader of what is printed may have had enough of it."""
        assert "points" not in capfd.readouterr().out
        return save_capture(*told, **more)

    monkeypatch.setattr("deltas_nets.captures.saving.save_capture", saving)
    said = run("convert", capture, tmp_path / "model", "--to", "colmap", "--depths", maps)
    assert said.code == 0, said.err
    assert "points that two maps or more agree on\n" in said.out
    points = open_capture(tmp_path / "model").points
    assert points is not None and len(points.xyz) > 100


@pytest.mark.parametrize("to", ["own", "transforms", "scannet"])
@pytest.mark.parametrize("format", ["npz", "tiff", "pfm"])
def test_maps_in_floats_go_along_as_depth(
    run: Run, capture: Path, tmp_path: Path, to: str, format: Literal["npz", "tiff", "pfm"]
) -> None:
    options = OutputOptions(depth_format=format)
    maps = write_maps(capture, tmp_path / "maps", options=options)
    flags = ("--to", to, "--depths", maps, "--points", 40, "--scale", 2)
    said = run("convert", capture, tmp_path / "out", *flags)
    assert said.code == 0, said.err
    frames = open_capture(tmp_path / "out").frames.values()
    fine = 1e-3 if to == "scannet" else 1e-6  # which has PNG alone
    for frame in frames:
        assert np.abs(frame.read_depth() - 2 * map_of(SIZE)).max() < fine
        assert to != "transforms" or frame.depth_path is None or frame.depth_path.suffix != ".npz"


def test_maps_that_are_not_there_are_counted(run: Run, capture: Path, tmp_path: Path) -> None:
    maps = write_maps(capture, tmp_path / "maps", depth=wall)
    next((maps / "depth").iterdir()).unlink()
    said = run("convert", capture, tmp_path / "out", "--depths", maps)
    assert said.code == 0 and "1 map of the folder left out" in said.warnings[0]


def test_maps_that_are_not_sure_are_told_with_what_convert_can_do(
    run: Run, capture: Path, tmp_path: Path
) -> None:
    maps = write_maps(capture, tmp_path / "maps", depth=wall)
    for file in (maps / "confidence").iterdir():
        Image.new("L", SIZE[::-1], 30).save(file)
    said = run("convert", capture, tmp_path / "out", "--depths", maps)
    assert_one_line(said, "sure enough (0.4 or more)", "deltas check")
    assert "--min-confidence" not in said.err  # which the command does not have
