"""`deltas depth` and `deltas evaluate` with the checkpoint that the paper's authors predicting."""

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image
from reference_tables import Tables, formula_tensor, random_tables
from run_command import Run, assert_one_line
from torch.testing import assert_close

from deltas_geom.testing.scenes import rigid
from deltas_nets import reference
from deltas_nets.captures.capture import Capture, Frame
from deltas_nets.captures.opening import open_capture
from deltas_nets.errors import UserError
from deltas_nets.outputs.products import read_depth_png, read_points_ply
from deltas_nets.predict import reference as predicting
from deltas_nets.predict.predictor import load_predictor
from deltas_nets.weights_file import weights_file

MakeCapture = Callable[..., Path]
SMALL = ("--work-size", 48, 64, "--views", 2)


@pytest.fixture(scope="module")
def tables() -> Tables:
    """Random weights; the last layer's bias keeps the depth positive."""
    tables = random_tables()
    tables["state_dict_depth"]["conv_final.bias"] = torch.tensor([3.0])
    return tables


@pytest.fixture(scope="module")
def checkpoint(tables: Tables, tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("published") / "checkpoint.pth.tar"
    torch.save(tables, file)
    return file


def test_the_command_writes_what_the_network_says(
    run: Run, make_capture: MakeCapture, checkpoint: Path, tmp_path: Path
) -> None:
    folder, out = make_capture(num_frames=2), tmp_path / "out"
    said = run("depth", folder, "--out", out, "--weights", checkpoint, *SMALL)
    assert (said.code, said.err) == (0, "")
    assert "no confidence is written" in said.out
    beside = {"index.html", "contact_sheet.jpg", "preview"}
    assert {path.name for path in out.iterdir()} == {"depth", "points", "summary.json"} | beside
    capture, network = open_capture(folder), reference.load(checkpoint)
    frames = [capture.frame(0), capture.frame(1)]
    expected = predicting.predict_reference(network, frames, work_size=(48, 64)).depth[0].numpy()
    depth = read_depth_png(out / "depth" / "0.png")
    assert (expected > 0).mean() > 0.9  # else there is nothing to see
    assert np.abs(depth - np.maximum(expected, 0)).max() < 0.0006  # m
    points, colors = read_points_ply(out / "points" / "0.ply")
    assert len(points) == len(colors) == (depth > 0).sum()
    summary = json.loads((out / "summary.json").read_text())
    assert summary["status"] == "complete"
    assert summary["files"] == ["depth", "points"]
    assert summary["settings"]["network"] == {"name": "published"}
    assert summary["settings"]["weights"]["origin"] == "the published checkpoint"


def test_a_finished_run_is_kept_and_other_weights_are_other_settings(
    run: Run, make_capture: MakeCapture, checkpoint: Path, tables: Tables, tmp_path: Path
) -> None:
    command = ["depth", make_capture(num_frames=2), "--out", tmp_path / "out", *SMALL]
    assert run(*command, "--weights", checkpoint).code == 0
    (tmp_path / "out" / "depth" / "1.png").unlink()
    again = run(*command, "--weights", checkpoint)
    assert "1 depth map in" in again.out
    assert "1 kept" in again.out
    other = tmp_path / "other.pth"
    changed = tables["state_dict_depth"] | {"conv_final.bias": torch.tensor([2.0])}
    torch.save(tables | {"state_dict_depth": changed}, other)
    assert_one_line(run(*command, "--weights", other), "other settings", "weights")


def test_it_is_scored_like_any_network(
    run: Run, make_capture: MakeCapture, checkpoint: Path, tmp_path: Path
) -> None:
    folder, out, file = make_capture(num_frames=2), tmp_path / "out", tmp_path / "a.json"
    said = run("evaluate", folder, "--weights", checkpoint, *SMALL, "--json", file)
    assert (said.code, said.err) == (0, "")
    direct = json.loads(file.read_text())["metrics"]
    assert run("depth", folder, "--out", out, "--weights", checkpoint, *SMALL).code == 0
    assert run("evaluate", folder, "--predictions", out, "--json", file).code == 0
    from_files = json.loads(file.read_text())["metrics"]
    for name in ("abs_rel", "delta1", "coverage"):
        assert from_files["dense"][name] == pytest.approx(direct["dense"][name], abs=2e-3)
    assert 0 < direct["sparse points"]["coverage"] < 1  # points that nothing sees are among them


def test_points_that_the_dense_map_does_not_rest_on_have_no_depth(
    make_capture: MakeCapture, checkpoint: Path
) -> None:
    capture, network = open_capture(make_capture()), reference.load(checkpoint)
    frames = [capture.frame(0), capture.frame(1)]
    found = predicting.predict_reference(network, frames, work_size=(48, 64))
    generator = torch.Generator().manual_seed(predicting.SEED)
    matched = network.predict(*predicting.load_input(frames, (48, 64)), generator=generator).matched
    drawn = []
    for seen, z in zip(
        matched.in_range[0, 0].tolist(), matched.points_3d[0, :, 2].tolist(), strict=True
    ):
        drawn.append(z if seen and 0.5 < z < 10 else 0.0)
    assert 0 < sum(z > 0 for z in drawn) < len(drawn)
    assert_close(found.point_depth, torch.tensor(drawn))


def test_what_it_cannot_do_is_one_line_and_nothing_is_written(
    run: Run, make_capture: MakeCapture, checkpoint: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    base = ["depth", make_capture(), "--out", out, "--weights", checkpoint]
    assert_one_line(run(*base, "--depth-range", 0.3, 8), "0.5 to 10 m", "--depth-range")
    assert_one_line(run(*base, "--work-size", 50, 64), "multiples of 8", "leave it out to use 240")
    assert_one_line(run(*base, "--min-confidence", 0.5), "states no confidence")
    assert_one_line(run("demo", "--weights", checkpoint, "--out", out), "use deltas depth")
    assert_one_line(run(*base, "--precision", "bfloat16"), "float32 alone", "leave it out")
    exported = run("export", "--weights", checkpoint, "--out", tmp_path / "a.onnx")
    assert_one_line(exported, "no network of deltas train", "name deltas-small")
    assert not out.exists()


@pytest.mark.parametrize("content", [b"", b"text", None])
def test_a_file_of_neither_kind_is_one_line(
    run: Run, make_capture: MakeCapture, tmp_path: Path, content: bytes | None
) -> None:
    file = tmp_path / "other.pth"
    if content is None:
        torch.save({"state_dict": {}}, file)
    else:
        file.write_bytes(content)
    said = run("depth", make_capture(), "--out", tmp_path / "out", "--weights", file)
    assert_one_line(
        said, "neither weights of deltas train nor the published", "other.pth", "name a"
    )
    assert not (tmp_path / "out").exists()


def test_a_damaged_checkpoint_names_what_is_missing(
    run: Run, make_capture: MakeCapture, tables: Tables, tmp_path: Path
) -> None:
    table = {key: value for key, value in tables["state_dict"].items() if key != "convPb.weight"}
    torch.save(tables | {"state_dict": table}, tmp_path / "cut.pth")
    out = tmp_path / "out"
    said = run("depth", make_capture(), "--out", out, "--weights", tmp_path / "cut.pth")
    assert_one_line(said, "state_dict has no convPb.weight", "cut.pth")
    assert not out.exists()


def test_contents_decide_and_not_names(tmp_path: Path, checkpoint: Path) -> None:
    renamed = tmp_path / "mine.bin"
    renamed.write_bytes(checkpoint.read_bytes())
    assert not load_predictor(renamed).states_confidence
    renamed.write_bytes(weights_file("deltas-small").read_bytes())
    assert load_predictor(renamed).states_confidence


def turned_frames(folder: Path, *, centre: tuple[float, float, float]) -> list[Frame]:
    """The first two frames of a capture; the second camera is moved and turned."""
    turn = torch.tensor([0.1, -0.2, 0.05]).double()
    world_from_cam = rigid(turn, torch.tensor(centre).double())
    np.savetxt(folder / "pose" / "1.txt", world_from_cam.numpy(), fmt="%.12f")
    capture = open_capture(folder)
    return [capture.frame(0), capture.frame(1)]


def test_frames_are_prepared_as_the_original_did(make_capture: MakeCapture) -> None:
    folder = make_capture(num_frames=2, image_size=(60, 100), origin=(4000.0, 0, 0))
    turned = turned_frames(folder, centre=(4000.3, 0.1, -0.2))  # far from the world's origin
    given = predicting.load_input(turned, (48, 64))
    for image, frame in zip(given.images, turned, strict=True):
        pixels = frame.read_image().astype(np.float32)
        resized = cv2.resize(pixels, (64, 48), interpolation=cv2.INTER_LINEAR)
        expected = torch.from_numpy((resized / 255 - 0.5) / 0.5).permute(2, 0, 1)
        assert_close(image, expected, rtol=0, atol=1e-4)
    # The corners of the image stay where they are, each axis by its own scale.
    K = turned[0].K
    cx, cy = 0.64 * (K[0, 2] + 0.5) - 0.5, 0.8 * (K[1, 2] + 0.5) - 0.5
    expected_K = torch.tensor([[0.64 * K[0, 0], 0, cx], [0, 0.8 * K[1, 1], cy], [0, 0, 1]])
    assert_close(given.intrinsics, expected_K[None].float())
    point = np.array([4000.5, -0.3, 2.0, 1])
    in_anchor, in_source = (frame.cam_from_world @ point for frame in turned)
    moved = given.cam_from_anchor[0, 0].double() @ torch.from_numpy(in_anchor)
    assert_close(moved, torch.from_numpy(in_source), rtol=0, atol=1e-6)  # m


def test_cameras_in_one_place_are_exactly_so(make_capture: MakeCapture) -> None:
    frames = turned_frames(make_capture(origin=(3.1, -2.7, 11.3)), centre=(3.1, -2.7, 11.3))
    given = predicting.load_input(frames, (48, 64))
    assert not given.cam_from_anchor[..., :3, 3].any()


def test_one_camera_for_all_frames_or_an_error(capture: Capture) -> None:
    frames = [capture.frame(0), capture.frame(1)]
    predicting.check_cameras(frames, work_size=(48, 64))
    K = frames[1].K.copy()
    K[0, 0] += 0.6  # pixels; the images are of the work size
    zoomed = Frame(7, frames[1].image_path, frames[1].image_size, K, frames[1].cam_from_world)
    with pytest.raises(UserError, match="frame 7 has another than frame 0"):
        predicting.check_cameras([*frames, zoomed], work_size=(48, 64))
    predicting.check_cameras([*frames, zoomed], work_size=(24, 32))


@pytest.mark.slow  # test_reference.py runs the network with these weights
@pytest.mark.shared
def test_formula_weights_at_the_size_of_the_original(
    run: Run, make_capture: MakeCapture, shared_data: Path, tmp_path: Path
) -> None:
    """A file with the published names and shapes; frames at 240 x 320, so nothing is resized."""
    reference_folder = shared_data.parent / "reference"
    shapes = json.loads((reference_folder / "state_dicts.json").read_text())
    weights = {
        entry: {
            key: torch.from_numpy(formula_tensor(entry, key, shape))
            for key, shape in table.items()
            if not key.endswith("num_batches_tracked")
        }
        for entry, table in shapes.items()
    }
    torch.save(weights, tmp_path / "formula.pth")
    arrays = np.load(reference_folder / "outputs.npz")
    folder, out, sets = (
        make_capture(3, image_size=(240, 320)),
        tmp_path / "out",
        tmp_path / "s.json",
    )
    sets.write_text('[{"anchor": 0, "sources": [1, 2]}]')
    pixels = np.random.default_rng(3).integers(0, 255, (240, 320, 3), dtype=np.uint8)
    for id in range(3):
        (folder / "color" / f"{id}.jpg").unlink()
        Image.fromarray(np.roll(pixels, 9 * id, axis=1)).save(folder / "color" / f"{id}.png")
    K = arrays["intrinsics"][0]
    padded = np.eye(4)
    padded[:3, :3] = K
    np.savetxt(folder / "intrinsic" / "intrinsic_color.txt", padded)
    for id, pose in enumerate(arrays["cam_from_anchor"][0], start=1):
        np.savetxt(folder / "pose" / f"{id}.txt", np.linalg.inv(pose))
    np.savetxt(folder / "pose" / "0.txt", np.eye(4))
    file = tmp_path / "formula.pth"
    said = run("depth", folder, "--out", out, "--weights", file, "--view-sets", sets)
    assert (said.code, said.err) == (0, "")
    images = torch.from_numpy(np.stack([np.roll(pixels, 9 * id, axis=1) for id in range(3)]))
    level = (images.permute(0, 3, 1, 2).float() / 255 - 0.5) / 0.5
    expected = reference.load(file).predict(
        level,
        torch.from_numpy(arrays["intrinsics"]).float(),
        torch.from_numpy(arrays["cam_from_anchor"]).float(),
        generator=torch.Generator().manual_seed(predicting.SEED),
    )
    depth = read_depth_png(out / "depth" / "0.png")
    wanted = np.maximum(expected.depth[0, 0].numpy(), 0)
    assert (wanted > 0).any()
    assert np.abs(depth - wanted).max() < 0.002  # m
