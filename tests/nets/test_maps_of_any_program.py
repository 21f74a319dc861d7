"""Maps that another program wrote, scored: what is not as it has to be is told, not scored."""

import contextlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from run_command import Result, Run, assert_one_line
from small_capture import write_capture

from deltas_nets.errors import UserError
from deltas_nets.outputs.depth_formats import read_depth_map

Score = Callable[[], Result]
DEPTH = np.full((48, 64), 2.5, np.float32)  # m, as the capture's
STEPS = DEPTH.astype(np.uint16)


@pytest.fixture
def maps(tmp_path: Path) -> Path:
    """A folder for the map of frame 1."""
    write_capture(tmp_path / "capture", 3)
    (tmp_path / "sets.json").write_text('[{"anchor": 1, "sources": [0]}]')
    (tmp_path / "maps" / "depth").mkdir(parents=True)
    return tmp_path / "maps" / "depth"


@pytest.fixture
def score(maps: Path, run: Run, tmp_path: Path) -> Score:
    asked = ("--predictions", maps.parent, "--view-sets", tmp_path / "sets.json")
    return lambda: run("evaluate", tmp_path / "capture", *asked)


@pytest.mark.parametrize("shape", [(48, 64), (24, 32), (60, 61), (60, 60)])
def test_a_map_of_another_size_is_scored(maps: Path, score: Score, shape: tuple[int, int]) -> None:
    np.savez(maps / "1.npz", depth=np.full(shape, 2.5, np.float32))
    told = score()
    assert told.code == 0 and not told.err


def test_a_turned_map_is_not(maps: Path, score: Score) -> None:
    np.savez(maps / "1.npz", depth=DEPTH.T)
    assert_one_line(score(), "map of frame 1 is 48x64 and its photo 64x48: it is turned")


def test_a_frame_has_one_map(maps: Path, score: Score) -> None:
    np.savez(maps / "1.npz", depth=DEPTH)
    Image.fromarray(1000 * STEPS).save(maps / "1.png")
    assert_one_line(score(), "a frame has several depth maps, 1.png and 1.npz")


@pytest.mark.parametrize("kind", [np.float16, np.float64, np.uint16])
def test_a_map_of_numbers_of_another_type_is_read_as_float32(maps: Path, kind: type) -> None:
    np.savez(maps / "1.npz", depth=(4 * DEPTH).astype(kind))
    found = read_depth_map(maps.parent, "1", 1000.0, ours=False)
    assert found.dtype == np.float32 and np.array_equal(found, 4 * DEPTH)


def test_words_and_damaged_files_are_no_maps(maps: Path) -> None:
    file = maps / "1.npz"
    np.savez(file, depth=np.full((48, 64), "far"))
    with pytest.raises(UserError, match="it must hold numbers"):
        read_depth_map(maps.parent, "1", 1000.0)
    np.savez_compressed(file, depth=np.random.default_rng(0).random((12, 16), np.float32))
    whole = file.read_bytes()
    for place in range(0, len(whole), 11):
        file.write_bytes(whole[:place] + bytes([whole[place] ^ 0xFF]) + whole[place + 1 :])
        with contextlib.suppress(UserError):
            read_depth_map(maps.parent, "1", 1000.0)


@pytest.mark.parametrize("factor", [1000, 0.001])
def test_another_unit_is_warned_of(maps: Path, score: Score, factor: float) -> None:
    np.savez(maps / "1.npz", depth=factor * DEPTH)
    told = score()
    assert told.code == 0 and "the maps are right but for a factor" in told.err


@pytest.mark.parametrize("name", ["000001.npz", "1.npy"])
def test_maps_of_another_name_are_told_how_to_be_written(
    maps: Path, score: Score, name: str
) -> None:
    (maps / name).touch()
    assert_one_line(score(), f"{name} is there", "write ID.png (16-bit millimetres), ID.npz")


def test_maps_of_another_kind_are_told_how_to_be_written(maps: Path, score: Score) -> None:
    Image.fromarray(STEPS.astype(np.uint8)).save(maps / "1.png")
    assert_one_line(score(), "16 bits of one channel", "write ID.png (16-bit millimetres), ID.npz")


@pytest.mark.parametrize("nothing", [0, np.nan, -1])
def test_maps_without_any_depth_are_not_scored(maps: Path, score: Score, nothing: float) -> None:
    np.savez(maps / "1.npz", depth=np.full_like(DEPTH, nothing))
    assert_one_line(score(), "no map has depth where the true depth is, of 1 map", "0 and NaN")


def test_an_empty_map_among_others_is_warned_of(maps: Path, score: Score, tmp_path: Path) -> None:
    (tmp_path / "sets.json").write_text(
        '[{"anchor": 1, "sources": [0]}, {"anchor": 2, "sources": [0]}]'
    )
    np.savez(maps / "1.npz", depth=DEPTH)
    np.savez(maps / "2.npz", depth=0 * DEPTH)
    told = score()
    assert told.code == 0
    assert "1 of 2 maps have no depth where the true depth is" in told.err
    assert told.err.rstrip().endswith("the first is 2")
