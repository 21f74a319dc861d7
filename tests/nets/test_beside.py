"""What shows maps goes with them: the page follows a fusion, and leaves with the maps it is of."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from conftest import MakeCapture
from run_command import Run, assert_one_line
from small_maps import write_maps
from small_output import write_frame

from deltas_nets.captures.opening import open_capture
from deltas_nets.outputs.beside import PAGE, PREVIEWS, SHEET, range_of_page
from deltas_nets.outputs.prepare import prepare_output
from deltas_nets.page.maps import fused_in, open_maps
from deltas_nets.page.write import write_page

FLAT = ("--no-consistency", "--voxel", "0.05")
RANGE = (0.3, 2.75)


@pytest.fixture
def filled(make_capture: MakeCapture, tmp_path: Path) -> tuple[Path, Path]:
    """A capture of four frames, and the folder of its maps with a page."""
    capture = make_capture()
    folder = write_maps(capture, tmp_path / "maps", depth=lambda size: np.full(size, 2.5))
    write_page(open_maps(open_capture(capture), folder), depth_range=RANGE)
    return capture, folder


def layers_of_page(folder: Path) -> list[str]:
    """Names of what the page shows in three dimensions."""
    text = (folder / PAGE).read_text(encoding="utf-8")
    (data,) = re.findall(r'<script type="application/json" id="data">(.*?)</script>', text, re.S)
    return [layer["name"] for layer in json.loads(data)["scene"]["layers"]]


def files_of(folder: Path) -> set[str]:
    return {str(file.relative_to(folder)) for file in folder.rglob("*") if file.is_file()}


def test_a_page_shows_what_is_fused_afterwards(
    filled: tuple[Path, Path], tmp_path: Path, run: Run
) -> None:
    assert layers_of_page(filled[1]) == ["points of the maps"]
    result = run("fuse", *filled, "--out", tmp_path / "fused", "--mesh", *FLAT)
    assert result.code == 0, result.err
    assert layers_of_page(filled[1]) == ["mesh"]
    assert range_of_page(filled[1]) == RANGE
    assert f"look at {filled[1] / PAGE}" in result.out


def test_what_no_page_shows_leaves_the_page_alone(
    filled: tuple[Path, Path], tmp_path: Path, run: Run
) -> None:
    pytest.importorskip("trimesh")
    before = (filled[1] / PAGE).read_bytes()
    result = run("fuse", *filled, "--out", tmp_path / "fused", "--glb", *FLAT)
    assert result.code == 0 and result.err == ""
    assert (filled[1] / PAGE).read_bytes() == before


@pytest.mark.parametrize("page", [None, "<html>mine</html>"])
def test_no_page_is_made_where_there_is_none_of_ours(
    filled: tuple[Path, Path], tmp_path: Path, run: Run, page: str | None
) -> None:
    (filled[1] / PAGE).unlink()
    if page is not None:
        (filled[1] / PAGE).write_text(page)
    before = files_of(filled[1])
    assert run("fuse", *filled, "--out", tmp_path / "fused", "--mesh", *FLAT).code == 0
    assert files_of(filled[1]) == before
    assert page is None or (filled[1] / PAGE).read_text() == page


def test_a_page_that_cannot_be_written_stays_as_it_was_and_the_mesh_is_there(
    filled: tuple[Path, Path], tmp_path: Path, run: Run
) -> None:
    before = (filled[1] / PAGE).read_bytes()
    for file in (filled[1] / PREVIEWS).iterdir():
        file.unlink()
    (filled[1] / PREVIEWS).rmdir()
    (filled[1] / PREVIEWS).write_text("in the way")
    result = run("fuse", *filled, "--out", tmp_path / "fused", "--mesh", *FLAT)
    assert result.code == 0 and (tmp_path / "fused" / "mesh.ply").exists()
    assert any("the page is as it was" in line for line in result.warnings), result.err
    assert (filled[1] / PAGE).read_bytes() == before


def test_overwriting_maps_takes_what_shows_them_and_spares_what_others_put_there(
    filled: tuple[Path, Path], run: Run
) -> None:
    """The fused files are in the folder of the maps, as `deltas depth --mesh` has them."""
    folder = filled[1]
    assert run("fuse", *filled, "--out", folder, "--mesh", *FLAT).code == 0
    settings = json.loads((folder / "summary.json").read_text())["settings"]
    spared = {"cloud.ply", "mesh.obj", f"{PREVIEWS}/mine.jpg", "notes.txt"}
    for name in spared:
        (folder / name).write_text("mine")
    fewer = {**settings, "view_sets": settings["view_sets"][:1]}
    prepare_output(folder, settings=fewer, frame_ids=["0"], overwrite=True)
    assert files_of(folder) == {"summary.json"} | spared


def test_overwriting_maps_spares_a_page_and_a_fusion_of_something_else(
    filled: tuple[Path, Path], run: Run
) -> None:
    capture, folder = filled
    (folder / PAGE).write_text("<html>mine</html>")
    assert run("fuse", capture, "sensor", "--out", folder, "--mesh", *FLAT).code == 0
    prepare_output(folder, settings={}, frame_ids=["0"], overwrite=True)
    assert files_of(folder) == {"summary.json", PAGE, SHEET, "mesh.ply", "fuse.json"}
    assert not (folder / PREVIEWS).exists()


def test_a_shard_that_starts_again_takes_what_no_shard_plans_and_leaves_the_others_alone(
    tmp_path: Path,
) -> None:
    def start(shard: tuple[int, int], ids: list[str], *, every: str, overwrite: bool) -> None:
        settings = {"view_sets": [[id, []] for id in every]}
        folder = prepare_output(
            tmp_path, settings=settings, frame_ids=ids, shard=shard, overwrite=overwrite
        )
        for id in ids:
            write_frame(folder, id)
        folder.write_summary("complete")

    start((1, 2), ["0", "2"], every="0123", overwrite=False)
    start((2, 2), ["1", "3"], every="0123", overwrite=False)
    for id in "0123":
        (tmp_path / PREVIEWS).mkdir(exist_ok=True)
        (tmp_path / PREVIEWS / f"{id}.jpg").write_bytes(b"old")
    start((1, 2), ["0"], every="01", overwrite=True)
    assert {file.stem for file in (tmp_path / "depth").iterdir()} == {"0", "1"}
    assert {file.stem for file in (tmp_path / PREVIEWS).iterdir()} == {"1"}


def test_another_fusion_takes_the_files_of_the_one_it_replaces(
    filled: tuple[Path, Path], tmp_path: Path, run: Run
) -> None:
    out = tmp_path / "fused"
    assert run("fuse", *filled, "--out", out, "--cloud", *FLAT).code == 0
    assert run("fuse", *filled, "--out", out, "--mesh", *FLAT).code == 0
    assert json.loads((out / "fuse.json").read_text())["files"] == ["cloud.ply", "mesh.ply"]
    (out / "mesh.glb").write_text("mine")
    coarser = ("--no-consistency", "--voxel", "0.1", "--overwrite")
    assert run("fuse", *filled, "--out", out, "--mesh", *coarser).code == 0
    assert files_of(out) == {"mesh.ply", "mesh.glb", "fuse.json"}


def test_a_fusion_takes_no_file_for_its_own_that_it_did_not_write(
    filled: tuple[Path, Path], tmp_path: Path, run: Run
) -> None:
    out = tmp_path / "fused"
    assert run("fuse", *filled, "--out", out, "--cloud", *FLAT).code == 0
    (out / "mesh.ply").write_text("mine")
    assert fused_in(out) == [out / "cloud.ply"]
    refused = run("fuse", *filled, "--out", out, "--mesh", *FLAT)
    assert_one_line(refused, "the file exists", "mesh.ply", "--overwrite")
    assert (out / "mesh.ply").read_text() == "mine"
    assert run("fuse", *filled, "--out", out, "--mesh", *FLAT, "--overwrite").code == 0
    assert (out / "mesh.ply").read_bytes().startswith(b"ply")
    assert fused_in(out) == [out / "mesh.ply", out / "cloud.ply"]
