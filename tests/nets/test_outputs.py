"""Outputs: values survive the files, and a folder can be killed, continued and refused."""

import json
import os
import re
import threading
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from small_output import output_of, summary_of, write_frame

from deltas_nets.commands.depth import Depth
from deltas_nets.commands.fuse import Fuse
from deltas_nets.errors import UserError
from deltas_nets.fuse import FuseConfig
from deltas_nets.outputs import prepare as output_prepare
from deltas_nets.outputs import products
from deltas_nets.outputs.atomic_files import write_json
from deltas_nets.outputs.prepare import prepare_output
from deltas_nets.outputs.products import (
    FrameOutput,
    OutputOptions,
    check_depth_fits,
    read_depth_png,
    read_points_ply,
    write_confidence_png,
    write_depth_png,
    write_points_ply,
)
from deltas_nets.outputs.summary import difference, shard_summary, unfinished
from deltas_nets.predict.depth_map import PredictConfig

SETTINGS: dict[str, Any] = {"weights": "deltas-small", "views": 3, "depth_range": (0.5, 10.0)}
MakeCapture = Callable[..., Path]


def files_in(folder: Path) -> dict[str, bytes]:
    paths = (path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in paths}


@settings(deadline=None, max_examples=50)
@given(metres=st.lists(st.floats(0.0005, 65.534), min_size=6, max_size=6))
def test_depth_survives_within_half_a_millimetre(
    metres: list[float], tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.getbasetemp() / "depth.png"
    depth = np.array(metres).reshape(2, 3)
    write_depth_png(path, depth)
    assert np.abs(read_depth_png(path) - depth).max() <= 0.0005 + 4e-6  # float32 at 65 m


def test_depth_that_is_unknown_is_0_and_known_depth_is_not(tmp_path: Path) -> None:
    depth = np.array([[0, -1, np.nan, np.inf], [1e-5, 65.535, 900, 1.2344]])
    write_depth_png(tmp_path / "d.png", depth)
    with Image.open(tmp_path / "d.png") as image:
        assert image.mode == "I;16"
        assert np.asarray(image).tolist() == [[0, 0, 0, 0], [1, 65534, 65534, 1234]]


def test_confidence_is_rounded_to_8_bits(tmp_path: Path) -> None:
    write_confidence_png(tmp_path / "c.png", np.array([[0, 0.5, 1, 2, -1, np.nan]]))
    with Image.open(tmp_path / "c.png") as image:
        assert image.mode == "L"
        assert np.asarray(image).tolist() == [[0, 128, 255, 255, 0, 0]]


@given(scale=st.floats(1e-3, 1e5), part=st.floats(0.001, 1))
def test_another_scale_holds_other_depths(
    scale: float, part: float, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path, options = tmp_path_factory.getbasetemp() / "s.png", OutputOptions(depth_scale=scale)
    metres = part * options.max_depth
    write_depth_png(path, np.full((2, 3), metres), scale=scale)
    assert read_depth_png(path, scale=scale) == pytest.approx(metres, abs=0.51 / scale, rel=1e-6)
    check_depth_fits((metres / 2, metres), options)
    with pytest.raises(UserError) as error:
        check_depth_fits((metres, 1.01 * options.max_depth), options)
    told = re.search(r"--depth-scale (\S+) ", error.value.remedy)
    assert told is not None
    # What is proposed holds twice the range, and no more than that by far.
    assert 2 <= OutputOptions(depth_scale=float(told[1])).max_depth / options.max_depth < 5
    check_depth_fits((1, np.inf), options)


def test_pixels_too_far_for_the_file_are_counted(tmp_path: Path) -> None:
    depth = np.array([[1.0, 65.534, 65.6, 900], [0, np.nan, np.inf, 2]])
    folder = prepare_output(tmp_path, settings=SETTINGS)
    folder.write_frame(output_of("7", depth=depth), {"status": "ok"})
    write_frame(folder, "8")
    folder.write_summary("complete")
    frames = summary_of(tmp_path)["frames"]
    assert frames["7"] == {"status": "ok", "saturated_pixels": 2}
    assert "saturated_pixels" not in frames["8"]


def test_surveyed_coordinates_keep_their_digits(tmp_path: Path) -> None:
    points = np.array([441547.5, 5121946.5, 312.0]) + np.random.default_rng(0).random((99, 3))
    write_points_ply(tmp_path / "p.ply", points, np.zeros((99, 3), np.uint8))
    assert np.array_equal(read_points_ply(tmp_path / "p.ply")[0], points)
    near = points - points.mean(axis=0)
    write_points_ply(tmp_path / "p.ply", near, np.zeros((99, 3), np.uint8))
    assert np.array_equal(read_points_ply(tmp_path / "p.ply")[0], near.astype(np.float32))


@pytest.mark.parametrize("change", [lambda whole: whole[:-1], lambda whole: whole + b"0"])
def test_points_that_are_cut_short_are_refused(
    tmp_path: Path, change: Callable[[bytes], bytes]
) -> None:
    path = tmp_path / "p.ply"
    write_points_ply(path, np.eye(3), np.zeros((3, 3), np.uint8))
    path.write_bytes(change(path.read_bytes()))
    with pytest.raises(UserError, match="not one of ours"):
        read_points_ply(path)


def test_a_product_is_a_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Everything that the folder does with its files follows from the table."""

    def write(path: Path, frame: FrameOutput, options: OutputOptions) -> None:
        path.write_text(frame.anchor.id)

    rows = (*products.PRODUCTS, products.Product("names", ".txt", write))
    for module in (products, output_prepare):
        monkeypatch.setattr(module, "PRODUCTS", rows)
    folder = prepare_output(tmp_path, settings=SETTINGS, frame_ids=["1"])
    write_frame(folder, "1")
    file = folder.file("names", "1")
    assert file == tmp_path / "names" / "1.txt" and file.read_text() == "1"
    assert summary_of(tmp_path)["files"] == ["depth", "confidence", "points", "names"]
    file.unlink()
    assert not folder.is_finished("1")
    (tmp_path / "names" / ".1.txt.x7.deltas-tmp").write_bytes(b"half")
    folder = prepare_output(tmp_path, settings=SETTINGS, frame_ids=["1"])
    assert list((tmp_path / "names").iterdir()) == []
    write_frame(folder, "1")
    prepare_output(tmp_path, settings=SETTINGS, overwrite=True)
    assert not file.exists()


def test_a_confidence_is_written_where_there_is_one(tmp_path: Path) -> None:
    silent = OutputOptions(confidence=False)
    folder = prepare_output(tmp_path, settings=SETTINGS, options=silent)
    with pytest.raises(ValueError, match="confidence=False"):
        write_frame(folder, "1")
    folder.write_frame(output_of("1", confidence=None), {"status": "ok"})
    assert folder.is_finished("1") and not (tmp_path / "confidence").exists()


@pytest.mark.parametrize("count", [0, 1, 1000])
def test_points_survive(tmp_path: Path, count: int) -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(count, 3)).astype(np.float32)
    colors = rng.integers(0, 256, (count, 3), dtype=np.uint8)
    write_points_ply(tmp_path / "p.ply", points, colors)
    read_points, read_colors = read_points_ply(tmp_path / "p.ply")
    assert np.array_equal(points, read_points) and np.array_equal(colors, read_colors)
    assert (tmp_path / "p.ply").read_bytes().startswith(b"ply\nformat binary_little_endian 1.0\n")


def test_points_that_are_not_finite_are_left_out(tmp_path: Path) -> None:
    points = np.array([[1, 2, 3], [np.nan, 0, 0], [np.inf, 0, 0]])
    write_points_ply(tmp_path / "p.ply", points, np.full((3, 3), 9, np.uint8))
    assert read_points_ply(tmp_path / "p.ply")[0].tolist() == [[1, 2, 3]]
    with pytest.raises(ValueError, match=r"colors must have shape \(N, 3\)"):
        write_points_ply(tmp_path / "p.ply", points, np.zeros((3, 3)))


def test_json_takes_what_settings_hold(tmp_path: Path) -> None:
    content = {"path": Path("a"), "far": float("inf"), "n": np.int64(3), "x": np.float32(0.5)}
    write_json(tmp_path / "x.json", content)
    text = (tmp_path / "x.json").read_text()
    assert json.loads(text) == {"path": "a", "far": "inf", "n": 3, "x": 0.5}


def test_files_follow_the_umask(tmp_path: Path) -> None:
    old = os.umask(0o027)
    try:
        write_json(tmp_path / "x.json", {})
    finally:
        os.umask(old)
    assert (tmp_path / "x.json").stat().st_mode & 0o777 == 0o640


def test_a_new_folder_has_a_summary_from_the_start(tmp_path: Path) -> None:
    out = tmp_path / "a" / "b"
    folder = prepare_output(out, settings=SETTINGS, head={"version": "1.0"})
    assert summary_of(out)["status"] == "running"
    assert summary_of(out)["settings"]["depth_range"] == [0.5, 10.0]
    assert not folder.is_finished("7")
    write_frame(folder, "7")
    assert folder.is_finished("7")
    folder.write_summary("complete", lost_frames=2)
    summary = summary_of(out)
    assert (summary["status"], summary["version"], summary["lost_frames"]) == ("complete", "1.0", 2)
    assert summary["frames"] == {"7": {"status": "done", "seconds": 0.1}}
    assert set(files_in(out)) == {
        "summary.json", "depth/7.png", "confidence/7.png", "points/7.ply",
    }  # fmt: skip


def test_a_killed_run_is_continued(tmp_path: Path) -> None:
    killed = prepare_output(tmp_path, settings=SETTINGS)
    write_frame(killed, "1")
    write_frame(killed, "2")
    (tmp_path / "depth" / "2.png").unlink()
    (tmp_path / "depth" / ".2.png.x7.deltas-tmp").write_bytes(b"half")
    folder = prepare_output(tmp_path, settings=SETTINGS)
    assert (folder.is_finished("1"), folder.is_finished("2")) == (True, False)
    folder.keep_frame("1")
    write_frame(folder, "2")
    folder.write_summary("complete")
    frames = summary_of(tmp_path)["frames"]
    assert frames["1"] == frames["2"] == {"status": "done", "seconds": 0.1}
    assert not list((tmp_path / "depth").glob(".*"))
    # Once more: records of frames that are kept survive.
    prepare_output(tmp_path, settings=SETTINGS).write_summary("complete")
    assert summary_of(tmp_path)["frames"] == frames


def test_other_settings_are_an_error_that_names_them(tmp_path: Path) -> None:
    write_frame(prepare_output(tmp_path, settings=SETTINGS), "1")
    before = files_in(tmp_path)
    with pytest.raises(UserError) as error:
        prepare_output(tmp_path, settings=SETTINGS | {"views": 5})
    assert error.value.where == tmp_path / "summary.json"
    assert "--views was 3, is 5" in error.value.what and "--overwrite" in error.value.remedy
    assert files_in(tmp_path) == before


def test_settings_that_differ_are_named_by_options_that_exist() -> None:
    flags = {field.name for command in (Depth, Fuse) for field in fields(command)}
    configs = {field.name for config in (PredictConfig, FuseConfig) for field in fields(config)}
    for name in configs | {"depth", "cameras", "frames", "sensor_depth", "precision", "passes"}:
        said = difference({"settings": {name: 1}}, {name: 2})
        options = re.findall(r"--([a-z-]+)", said)
        assert all(option.replace("-", "_") in flags for option in options), said


def test_overwrite_starts_again_and_spares_what_is_not_ours(tmp_path: Path) -> None:
    write_frame(prepare_output(tmp_path, settings=SETTINGS, frame_ids=["1"]), "1")
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "depth" / "notes.txt").write_text("mine")
    folder = prepare_output(tmp_path, settings=SETTINGS | {"views": 5}, overwrite=True)
    assert not folder.is_finished("1")
    assert set(files_in(tmp_path)) == {"summary.json", "notes.txt", "depth/notes.txt"}
    assert summary_of(tmp_path)["frames"] == {}


@pytest.mark.parametrize("shard", [(1, 1), (1, 2)])
def test_a_folder_whose_maps_are_being_removed_is_not_complete(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shard: tuple[int, int]
) -> None:
    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    folder = prepare_output(tmp_path, settings=SETTINGS, frame_ids=["1"])
    write_frame(folder, "1")
    folder.write_summary("complete")
    monkeypatch.setattr(output_prepare, "_remove_frames", killed)
    with pytest.raises(KeyboardInterrupt):
        prepare_output(tmp_path, settings=SETTINGS, frame_ids=["1"], overwrite=True, shard=shard)
    assert summary_of(tmp_path)["status"] == "stopped"


@pytest.mark.parametrize("name", ["notes.txt", "summary.json"])
def test_a_folder_of_someone_else_is_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text('{"writer": "someone"}')
    before = files_in(tmp_path)
    with pytest.raises(UserError) as error:
        prepare_output(tmp_path, settings=SETTINGS)
    assert error.value.where == tmp_path and name in error.value.what
    assert files_in(tmp_path) == before
    assert not (tmp_path / "depth").exists()


def test_overwrite_in_a_folder_of_someone_else_replaces_only_its_frames(tmp_path: Path) -> None:
    for kind, suffix in (("depth", "png"), ("confidence", "png"), ("points", "ply")):
        for id in (1, 2):
            (tmp_path / kind).mkdir(exist_ok=True)
            (tmp_path / kind / f"{id}.{suffix}").write_text("old")
    folder = prepare_output(tmp_path, settings=SETTINGS, overwrite=True, frame_ids=["1"])
    assert not folder.is_finished("1")
    assert (tmp_path / "depth" / "2.png").read_text() == "old"


def test_the_capture_is_never_the_output(make_capture: MakeCapture) -> None:
    path = make_capture()
    before = files_in(path)
    with pytest.raises(UserError, match=r"capture itself"):
        prepare_output(path / ".", settings=SETTINGS, overwrite=True, forbidden=path)
    assert files_in(path) == before


def test_a_folder_that_cannot_be_made_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for out in (tmp_path / "file", tmp_path / "file" / "out"):
        with pytest.raises(UserError, match=f"(is a file|cannot be written).*, {out}: name"):
            prepare_output(out, settings=SETTINGS)
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "depth").write_text("")
    with pytest.raises(UserError, match=r"cannot be written .*out/depth"):
        prepare_output(tmp_path / "out", settings=SETTINGS, overwrite=True)


def test_a_folder_without_write_permission_is_an_error(tmp_path: Path) -> None:
    if os.geteuid() == 0:
        pytest.skip("root may write everywhere")
    tmp_path.chmod(0o555)
    with pytest.raises(UserError, match=r"cannot be written .Permission denied"):
        prepare_output(tmp_path, settings=SETTINGS)


def test_shards_share_a_folder_and_its_summary(tmp_path: Path) -> None:
    first = prepare_output(tmp_path, settings=SETTINGS, shard=(1, 2), frame_ids=["1"])
    second = prepare_output(tmp_path, settings=SETTINGS, shard=(2, 2), frame_ids=["2"])
    write_frame(first, "1")
    first.write_summary("complete")
    assert summary_of(tmp_path)["status"] == "running"
    assert unfinished(tmp_path) == "the folder is complete after --shard 2/2"
    second.write_summary("stopped")
    assert summary_of(tmp_path)["status"] == "stopped"
    assert summary_of(tmp_path)["waiting_for"] == ["2/2"]
    write_frame(second, "2")
    second.write_summary("complete")
    summary = summary_of(tmp_path)
    assert summary["status"] == "complete" and set(summary["frames"]) == {"1", "2"}
    assert "waiting_for" not in summary and unfinished(tmp_path) is None
    # A shard that starts again leaves the others' frames alone.
    again = prepare_output(
        tmp_path, settings=SETTINGS, shard=(2, 2), frame_ids=["2"], overwrite=True
    )
    assert (again.is_finished("1"), again.is_finished("2")) == (True, False)


def test_a_shard_keeps_what_a_run_of_all_frames_recorded(tmp_path: Path) -> None:
    whole = prepare_output(tmp_path, settings=SETTINGS, frame_ids=["1", "2"])
    for id in ("1", "2"):
        write_frame(whole, id)
    whole.write_summary("complete")
    before = summary_of(tmp_path)["frames"]
    shard = prepare_output(tmp_path, settings=SETTINGS, shard=(1, 2), frame_ids=["1"])
    shard.keep_frame("1")
    shard.write_summary("complete")
    assert summary_of(tmp_path)["frames"] == before
    assert set(json.loads(shard_summary(tmp_path, (1, 2)).read_text())["frames"]) == {"1"}


def test_a_shard_that_is_done_waits_for_those_that_never_ran(tmp_path: Path) -> None:
    folder = prepare_output(tmp_path, settings=SETTINGS, shard=(1, 4), frame_ids=["1"])
    write_frame(folder, "1")
    folder.write_summary("complete")
    summary = summary_of(tmp_path)
    assert (summary["status"], summary["waiting_for"]) == ("stopped", ["2/4", "3/4", "4/4"])


def test_shards_that_start_and_finish_at_once_lose_nothing(tmp_path: Path) -> None:
    count = 8
    barrier = threading.Barrier(count)
    failures: list[BaseException] = []

    def work(index: int) -> None:
        try:
            barrier.wait()
            folder = prepare_output(tmp_path, settings=SETTINGS, shard=(index, count))
            write_frame(folder, str(index))
            barrier.wait()
            folder.write_summary("complete")
        except BaseException as error:
            failures.append(error)
            barrier.abort()

    threads = [threading.Thread(target=work, args=(index,)) for index in range(1, count + 1)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert failures == []
    summary = summary_of(tmp_path)
    assert summary["status"] == "complete" and len(summary["frames"]) == count
