"""Detectors beside each other: what counts as a point, a match, a right pose; table and record."""

import math
import weakref
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from kornia.feature import ALIKED, DISK
from reference_tables import random_tables
from rich.console import Console
from run_command import Run, assert_one_line
from small_capture import write_capture
from torch import Tensor
from torch.testing import assert_close

from deltas_geom import PosedViews
from deltas_nets.captures.capture import Capture, Frame
from deltas_nets.captures.frame import Lens
from deltas_nets.captures.frames import Frames
from deltas_nets.captures.opening import open_capture
from deltas_nets.captures.saving import save_capture
from deltas_nets.captures.view_sets import ViewSet
from deltas_nets.commands import detectors
from deltas_nets.config import DetectorConfig, NetworkConfig
from deltas_nets.distill.superpoint import SuperPoint
from deltas_nets.errors import UserError
from deltas_nets.evaluate.detectors.aliked import AlikedExtractor
from deltas_nets.evaluate.detectors.capture import pairs_of, score_capture
from deltas_nets.evaluate.detectors.classical import orb, sift
from deltas_nets.evaluate.detectors.config import TableConfig
from deltas_nets.evaluate.detectors.dense import disk, superpoint
from deltas_nets.evaluate.detectors.features import DetectionConfig, Features, thinned
from deltas_nets.evaluate.detectors.matched import mutual_nearest
from deltas_nets.evaluate.detectors.own import ours
from deltas_nets.evaluate.detectors.pairs_file import read_pairs
from deltas_nets.evaluate.detectors.pose.consensus import ConsensusConfig
from deltas_nets.evaluate.detectors.registry import (
    CHANCE,
    NamedExtractor,
    load_extractors,
    spread,
)
from deltas_nets.evaluate.detectors.scores import pool, score_pair
from deltas_nets.evaluate.record import read_record
from deltas_nets.evaluate.some_sets import evenly_spaced
from deltas_nets.network.deltas import Deltas
from deltas_nets.network.lite.detector import spread_points
from deltas_nets.rooms.textures import load_picture
from deltas_nets.terminal import table_console
from deltas_nets.weights_file import save_weights

SIZE = (96, 128)
whole = st.tuples(st.integers(0, 127), st.integers(0, 95))


@pytest.fixture(scope="module")
def photograph() -> Tensor:
    pixels = np.asarray(load_picture("astronaut.png").resize((256, 192)))
    return torch.from_numpy(pixels.copy()).permute(2, 0, 1).float() / 255


@pytest.fixture(scope="module")
def small_weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("weights") / "small.safetensors"
    with torch.random.fork_rng():
        torch.manual_seed(0)
        save_weights(file, Deltas(NetworkConfig(detector=DetectorConfig(64))), {"step": "0"})
    return file


@pytest.mark.parametrize("fields", [{"nms_radius": -1}, {"num_points": 0}, {"border": -2}])
def test_points_that_make_no_sense_are_refused(fields: dict[str, int]) -> None:
    with pytest.raises(ValueError, match=next(iter(fields))):
        DetectionConfig(**fields)


@given(points=st.lists(whole, min_size=1, max_size=40), radius=st.integers(0, 9))
def test_thinned_points_are_apart_and_what_is_left_out_is_near_a_stronger(
    points: list[tuple[int, int]], radius: int
) -> None:
    pixels, strength = torch.tensor(points).float(), torch.arange(len(points)) * 1.0
    kept = thinned(pixels, strength, SIZE, DetectionConfig(radius, border=0))
    apart = torch.cdist(pixels[kept], pixels[kept], p=math.inf)
    assert (apart + 100 * torch.eye(len(kept)) > radius).all()
    for index in set(range(len(points))) - set(kept.tolist()):
        stronger = kept[kept > index]
        assert (pixels[stronger] - pixels[index]).abs().amax(dim=1).min() <= radius
    assert (strength[kept].diff() <= 0).all()


@given(sizes=st.tuples(st.integers(1, 20), st.integers(1, 20)), seed=st.integers(0, 99))
def test_matches_are_mutual_whichever_comes_first_and_those_of_opencv(
    sizes: tuple[int, int], seed: int
) -> None:
    random = torch.Generator().manual_seed(seed)
    first, second = (torch.randn(count, 8, generator=random) for count in sizes)
    matches = mutual_nearest(first, second)
    back = mutual_nearest(second, first).flip(1)
    assert sorted(matches.tolist()) == sorted(back.tolist())
    theirs = cv2.BFMatcher(cv2.NORM_L2, crossCheck=True).match(first.numpy(), second.numpy())
    assert sorted(matches.tolist()) == sorted([m.queryIdx, m.trainIdx] for m in theirs)


def test_nothing_described_matches_nothing() -> None:
    assert mutual_nearest(torch.zeros(4, 0), torch.zeros(3, 0)).shape == (0, 2)


def moved_wall(shift: int) -> tuple[PosedViews, Tensor, Features, Features]:
    """Points of a wall 2 m away, seen again by a camera 0.02 m a pixel to the side."""
    K = torch.tensor([[100.0, 0, 63.5], [0, 100, 47.5], [0, 0, 1]]).expand(2, 3, 3)
    pose = torch.eye(4).repeat(2, 1, 1)
    pose[1, 0, 3] = -shift * 2 / 100
    slope = torch.linspace(1.5, 2.5, SIZE[1]).expand(2, *SIZE)
    pixels = torch.cartesian_prod(torch.arange(40.0, 120, 11), torch.arange(8.0, 90, 11))
    code = torch.randn(len(pixels), 16, generator=torch.Generator().manual_seed(0))
    depth = slope[0, pixels[:, 1].long(), pixels[:, 0].long()]
    there = pixels - torch.stack([shift * 2 / depth, torch.zeros_like(depth)], dim=-1)
    # The second view sees the same tilted wall: its depth is read at the nearest pixel.
    seen = torch.zeros(SIZE)
    for row in range(SIZE[0]):
        x = torch.arange(SIZE[1]) - shift * 2 / slope[0, row]
        order = x.argsort()
        seen[row] = torch.from_numpy(
            np.interp(np.arange(SIZE[1]), x[order].numpy(), slope[0, row][order].numpy())
        ).float()
    return (
        PosedViews(K, pose),
        torch.stack([slope[0], seen]),
        Features(pixels, code),
        Features(there, code),
    )


@settings(max_examples=6)
@given(shift=st.integers(2, 20))
def test_what_moves_with_the_scene_is_repeated_matched_and_posed(shift: int) -> None:
    views, depth, first, second = moved_wall(shift)
    pair = score_pair(views, depth, first, second, tolerance=3.0, consensus=ConsensusConfig())
    scores = pool([pair], len(first.pixels))
    assert scores.matching == 1 and scores.repeatability == 1 and scores.one_to_one == 1
    assert scores.rotation == 1 and scores.translation == 1 and scores.precision == 1
    assert scores.localisation < 0.1 and scores.translation_median < 0.01


def test_descriptors_of_other_points_cost_the_matching_score_alone() -> None:
    views, depth, first, second = moved_wall(8)
    mixed = second._replace(descriptors=second.descriptors.flip(0))
    pair = score_pair(views, depth, first, mixed, tolerance=3.0, consensus=ConsensusConfig())
    scores = pool([pair], len(first.pixels))
    assert scores.repeatability == 1 and scores.matching < 0.1 and scores.translation == 0


def test_points_without_descriptors_have_no_scores_of_them() -> None:
    views, depth, first, second = moved_wall(8)
    bare = [one._replace(descriptors=one.descriptors[:, :0]) for one in (first, second)]
    pair = score_pair(views, depth, *bare, tolerance=3.0, consensus=ConsensusConfig())
    scores = pool([pair], len(first.pixels))
    assert scores.repeatability == 1
    assert all(math.isnan(s) for s in (scores.matching, scores.rotation, scores.translation))


@pytest.mark.parametrize("detect", [orb, sift])
@pytest.mark.parametrize("count", [None, 40])
def test_classical_points_are_apart_and_within_the_border(
    detect: object, count: int | None, photograph: Tensor
) -> None:
    config = DetectionConfig(num_points=count)
    found = detect(photograph, config)  # type: ignore[operator]
    assert len(found.pixels) == len(found.descriptors) == (count or len(found.pixels)) > 20
    apart = torch.cdist(found.pixels, found.pixels, p=math.inf) + 100 * torch.eye(len(found.pixels))
    assert apart.min() > config.nms_radius
    assert found.pixels.min() >= config.border


def test_a_blank_image_has_no_classical_points() -> None:
    blank = torch.full((3, 64, 64), 0.5)
    assert len(orb(blank, DetectionConfig()).pixels) == 0
    assert len(sift(blank, DetectionConfig()).pixels) == 0


def test_sift_is_about_opencvs(photograph: Tensor) -> None:
    found = sift(photograph, DetectionConfig(nms_radius=0))
    grey = (255 * photograph.mean(dim=0)).round().byte().numpy()
    theirs = cv2.SIFT_create().detect(grey)
    places = torch.tensor([point.pt for point in theirs])
    near = torch.cdist(places, found.pixels).min(dim=1).values < 1
    assert near.float().mean() > 0.7
    assert 0.5 < len(found.pixels) / len(theirs) < 2


def test_disk_finds_what_kornia_finds(photograph: Tensor, tmp_path: Path) -> None:
    torch.manual_seed(0)
    network = DISK().eval()
    torch.save(network.state_dict(), tmp_path / "disk.pth")
    config = DetectionConfig(border=8)
    found = disk(tmp_path / "disk.pth")(photograph, config)
    with torch.inference_mode():
        theirs = network(photograph[None], window_size=7, score_threshold=0.0)[0]
    inside = ((theirs.keypoints >= 8) & (theirs.keypoints < torch.tensor([248, 184]))).all(dim=1)
    assert {tuple(p) for p in found.pixels.tolist()} == {
        tuple(p) for p in theirs.keypoints[inside].float().tolist()
    }
    order = {tuple(p): n for n, p in enumerate(theirs.keypoints.float().tolist())}
    index = [order[tuple(p)] for p in found.pixels.tolist()]
    assert_close(found.descriptors, theirs.descriptors[index], rtol=0, atol=1e-4)


def test_aliked_finds_what_kornia_finds(photograph: Tensor) -> None:
    torch.manual_seed(0)
    network = ALIKED("aliked-t16", nms_radius=5).eval()
    found = AlikedExtractor(network)(photograph, DetectionConfig(num_points=50))
    again = ALIKED("aliked-t16", max_num_keypoints=50, detection_threshold=0, nms_radius=3).eval()
    again.load_state_dict({**network.state_dict(), "dkd.hw_grid": again.dkd.hw_grid})
    with torch.inference_mode():
        theirs = again(photograph[None])[0]
    order = theirs.keypoint_scores.argsort(descending=True)
    inside = ((theirs.keypoints >= 4) & (theirs.keypoints <= torch.tensor([251, 187]))).all(dim=1)
    order = order[inside[order]]
    assert_close(found.pixels, theirs.keypoints[order])
    assert_close(found.descriptors, theirs.descriptors[order])


def test_superpoint_describes_a_cells_centre_by_the_cell(tmp_path: Path) -> None:
    torch.manual_seed(0)
    network = SuperPoint(batch_norm=True).eval()
    torch.save(network.state_dict(), tmp_path / "superpoint.pth")
    image = torch.rand(3, 60, 68)  # no whole number of cells
    look = superpoint(tmp_path / "superpoint.pth").look(image[None])
    maps = network.maps(image[None]).descriptors
    centres = torch.tensor([[3.5, 3.5], [35.5, 27.5]])
    assert_close(look.describe(centres), maps[0, :, [0, 3], [0, 4]].T, rtol=0, atol=1e-5)


def test_a_file_says_whether_it_is_ours_or_the_published_checkpoint(
    small_weights: Path, tmp_path: Path, photograph: Tensor
) -> None:
    published = tmp_path / "checkpoint.pth.tar"
    torch.save(random_tables(), published)
    for file, width in ((small_weights, 48), (published, 128)):
        found = ours(file)(photograph, DetectionConfig(num_points=30))
        assert found.descriptors.shape == (len(found.pixels), width)
        norms = found.descriptors.norm(dim=1)
        assert_close(norms, torch.ones_like(norms), rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    ("words", "what"),
    [
        (["surf"], "no such detector, surf: use ours, orb"),
        (["aliked"], "aliked needs weights, aliked: write aliked=FILE"),
        (["orb", "orb"], "the same detector twice, orb"),
        (["ours="], "no file is named, ours="),
        (["orb=x.pth"], "no such detector"),
        (["ours=nope.safetensors"], "no such weights"),
    ],
)
def test_detectors_that_are_none_are_refused(words: list[str], what: str) -> None:
    with pytest.raises(UserError, match=what):
        load_extractors(words)


@given(total=st.integers(1, 50), count=st.integers(1, 60))
def test_some_sets_are_spread_over_all(total: int, count: int) -> None:
    chosen = evenly_spaced(list(range(total)), count)
    assert len(chosen) == min(count, total) and chosen[0] == 0
    steps = {b - a for a, b in pairwise(chosen)}
    assert len(steps) <= 2 and all(step > 0 for step in steps)
    assert total - chosen[-1] <= math.ceil(total / len(chosen))


def expect_first(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file has to be there before its table is printed, whose reader may have had enough."""

    def printing() -> Console:
        assert file.is_file()
        return table_console()

    monkeypatch.setattr(detectors, "table_console", printing)


def test_the_command_prints_the_table_and_keeps_what_made_it(
    run: Run, tmp_path: Path, small_weights: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    capture = write_capture(tmp_path / "capture", 3, image_size=SIZE, depth_size=SIZE)
    file = tmp_path / "found" / "table1.json"
    expect_first(file, monkeypatch)
    words = ["orb", "spread", f"ours={small_weights}"]
    result = run("detectors", capture, "--detectors", *words, "--sets", 1, "--json", file)
    assert result.code == 0 and "trans@5cm" in result.out, result.err
    record = read_record(file)
    assert record.table == "detectors" and [row["detector"] for row in record.rows][:2] == words[:2]
    assert record.protocol["detection"]["nms_radius"] == 3 and record.protocol["tolerance"] == 3
    assert record.rows[1]["matching"] is None  # spread points describe nothing
    assert list(record.weights) == [record.rows[2]["detector"]]
    assert str(tmp_path) not in file.read_text()


def test_of_images_with_a_lens_the_first_is_named() -> None:
    lens, place = Lens("SIMPLE_RADIAL", (0.1,)), Path("depth.png")
    frames = [
        Frame(str(id), Path(f"{id}.jpg"), (4, 4), np.eye(3), np.eye(4), place, lens=lens)
        for id in range(30)
    ]
    capture = Capture(Path(), Frames.of(frames, Path()), {})
    views = [ViewSet(str(id), (str(id - 1),)) for id in range(29, 0, -1)]
    with pytest.raises(UserError) as error:
        pairs_of(capture, views)
    assert error.value.where == Path("29.jpg")


def test_what_no_later_pair_needs_is_forgotten(tmp_path: Path) -> None:
    capture = open_capture(write_capture(tmp_path / "walk", 8, image_size=(48, 64)))
    alive: weakref.WeakSet[Tensor] = weakref.WeakSet()
    most = []

    def extract(image: Tensor, config: DetectionConfig) -> Features:
        found = spread(image, config)
        alive.add(found.descriptors)
        most.append(len(alive))
        return found

    pairs = [(str(id), str(id + 1)) for id in range(7)]
    scores = score_capture([NamedExtractor("spread", extract, {})], capture, pairs, TableConfig())
    assert len(most) == 8 and max(most) <= 3
    assert scores["spread"].points == len(spread_points(CHANCE, image_size=(48, 64)))


def test_the_command_reads_pairs_without_depth(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    capture = write_capture(tmp_path / "capture", 2, image_size=SIZE)
    expect_first(tmp_path / "p.json", monkeypatch)
    K = "128 0 63.5 0 128 47.5 0 0 1"
    line = f"0.jpg 1.jpg 0 0 {K} {K} 1 0 0 -0.15 0 1 0 0 0 0 1 0 0 0 0 1"
    file = capture / "color" / "pairs.txt"
    file.write_text(line + "\n\n")
    result = run("detectors", file, "--detectors", "orb", "--json", tmp_path / "p.json")
    assert result.code == 0 and "dir@10" in result.out, result.err
    assert read_record(tmp_path / "p.json").rows[0]["pairs"] == 1
    for wrong, what in (
        (line + " 3", "39 words"),
        (line.replace("0.jpg", "9.jpg"), "no image 9.jpg"),
        (line.replace(" 0 0 128", " 1 0 128", 1), "rotated images"),
        (line.replace("128", "f", 1), "no number"),
        (line.replace("-0.15", "nan", 1), "no number"),
        (line.replace("128", "1e999", 1), "no number"),
        ("", "no pairs"),
    ):
        file.write_text(wrong)
        with pytest.raises(UserError, match=what):
            read_pairs(file)


def test_the_file_of_a_capture_is_no_list_of_pairs(run: Run, tmp_path: Path) -> None:
    capture = open_capture(write_capture(tmp_path / "capture", 3, image_size=SIZE))
    save_capture(capture, tmp_path / "own", "own")
    result = run("detectors", tmp_path / "own" / "frames.json", "--detectors", "orb")
    assert result.code == 0 and "trans@5cm" in result.out, result.err
    image = next((tmp_path / "own" / "images").iterdir())
    assert_one_line(run("detectors", image, "--detectors", "orb"), "is not text", "38 words")
    assert_one_line(run("detectors", tmp_path / "own", "--detectors"), "nothing is named")


def test_without_metres_no_length_is_scored(run: Run, tmp_path: Path) -> None:
    capture = open_capture(write_capture(tmp_path / "capture", 3, image_size=SIZE))
    save_capture(replace(capture, metric=False), tmp_path / "own", "own")
    file = tmp_path / "t.json"
    result = run("detectors", tmp_path / "own", "--detectors", "orb", "--json", file)
    assert result.code == 0 and "states no metres" in result.err
    (row,) = read_record(file).rows
    assert row["translation"] is None and row["translation_median"] is None
    assert row["rotation"] is not None


def test_a_capture_without_depth_is_refused_before_anything_is_written(
    run: Run, tmp_path: Path
) -> None:
    capture = write_capture(tmp_path / "capture", 2, depth_size=None)
    result = run("detectors", capture, "--detectors", "orb", "--json", tmp_path / "t" / "t.json")
    assert_one_line(result, "no two views with sensor depth")
    assert not (tmp_path / "t").exists()
    assert_one_line(run("detectors", capture, "--sets", 0), "--sets 0")
    assert_one_line(run("detectors", capture, "--tolerance", 0), "--tolerance 0")
