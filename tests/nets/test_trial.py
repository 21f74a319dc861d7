"""How large images are seen: as large as the network is sure of, whatever the capture."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from run_command import Run

from deltas_nets import load_model
from deltas_nets.captures.capture import Capture
from deltas_nets.captures.spread import spread
from deltas_nets.captures.view_sets import ViewSet
from deltas_nets.network.known_depth import KnownDepth
from deltas_nets.predict import trial
from deltas_nets.predict.depth_map import (
    ENLARGED,
    WORK_PIXELS,
    DepthMap,
    KeypointDepths,
    PredictConfig,
    Wanted,
)
from deltas_nets.predict.ours import num_points, work_size_of
from deltas_nets.predict.search import Asked
from deltas_nets.predict.trial import (
    AS_SURE,
    LARGE_PIXELS,
    TRIED,
    surer,
    surest_config,
    with_larger_images,
)

SMALL = PredictConfig(work_pixels=1000)
"""Of the small frames of tests; all their pixels are the large ones."""
SETS = [ViewSet(str(k), (str((k + 1) % 4),)) for k in range(4)]


class Surer:
    """As sure of small images as ``small`` says, of large ones as ``large``."""

    takes_larger = True

    def __init__(self, small: float, large: float) -> None:
        self.sure = {SMALL.work_pixels: small, LARGE_PIXELS: large}
        self.seen: list[tuple[int, int]] = []

    def depth_map(self, wanted: Wanted) -> DepthMap:
        config, size = wanted.config, work_size_of(wanted.anchor, wanted.config)
        self.seen.append(size)
        # The relative deviation of which the probability to be within 5 % is that.
        deviation = -(2**0.5) * 0.05 / np.log(1 - self.sure[config.work_pixels])
        map = np.ones(wanted.size, dtype=np.float32)
        keypoints = KeypointDepths(torch.zeros(9, 2), torch.ones(9), size)
        work = KnownDepth(torch.ones(1, *size), torch.full((1, *size), deviation))
        points, colors = np.zeros((1, 3)), np.zeros((1, 3), np.uint8)
        return DepthMap(map, map, points, colors, keypoints, work.deviation.log(), work)


def chosen(capture: Capture, network: Surer, config: PredictConfig = SMALL) -> PredictConfig:
    search = Asked(capture, (0.5, 10.0))
    return surest_config(network, capture, SETS, config, search)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("small", "large", "grows"), [(0.5, 0.6, True), (0.5, 0.495, True), (0.5, 0.48, False)]
)
def test_images_are_as_large_as_the_network_is_sure_of(
    capture: Capture, small: float, large: float, grows: bool
) -> None:
    network = Surer(small, large)
    assert chosen(capture, network) == (with_larger_images(SMALL) if grows else SMALL)
    assert len(set(network.seen)) == 2
    assert len(network.seen) == 2 * len(SETS)


def test_nothing_is_tried_where_nothing_is_to_be_chosen(capture: Capture) -> None:
    alone = Surer(0.5, 0.6)
    alone.takes_larger = False
    assert chosen(capture, alone) == SMALL
    stated, small_already = replace(SMALL, work_size=(48, 64)), PredictConfig()
    network = Surer(0.5, 0.6)
    assert chosen(capture, network, stated) == stated
    assert chosen(capture, network, small_already) == small_already
    assert alone.seen == network.seen == []


@pytest.mark.parametrize(
    ("photo", "usual", "larger"),
    [
        ((48, 64), (96, 128), (96, 128)),
        ((120, 160), (240, 320), (240, 320)),
        ((240, 320), (288, 384), (480, 640)),
        ((360, 540), (272, 416), (352, 528)),
        ((480, 640), (288, 384), (480, 640)),
        ((3000, 4000), (288, 384), (480, 640)),
    ],
)
def test_photos_are_enlarged_to_what_the_network_wants_or_twice_their_sides(
    capture: Capture, photo: tuple[int, int], usual: tuple[int, int], larger: tuple[int, int]
) -> None:
    frame = replace(capture.frame("0"), image_size=photo)
    # As they are, to a multiple.
    assert np.prod(work_size_of(frame, PredictConfig())) < 1.2 * np.prod(photo)
    config = PredictConfig(enlarged=ENLARGED)
    assert work_size_of(frame, config) == usual
    assert work_size_of(frame, with_larger_images(config)) == larger


@given(gains=st.lists(st.floats(-1, 1), min_size=1, max_size=TRIED))
def test_the_mean_of_what_is_gained_decides(gains: list[float]) -> None:
    config = PredictConfig(min_confidence=0.2)
    found = surer(config, gains)
    assert found.work_pixels == (LARGE_PIXELS if np.mean(gains) >= -AS_SURE else WORK_PIXELS)
    assert replace(found, work_pixels=WORK_PIXELS) == config


@given(count=st.integers(1, 300))
def test_what_is_tried_is_spread_over_the_capture(count: int) -> None:
    sets = [ViewSet(str(k), ()) for k in range(count)]
    places = [int(views.anchor) for views in spread(sets, TRIED)]
    assert places == sorted(set(places))
    assert len(places) == min(count, TRIED)
    assert places[0] == 0
    assert places[-1] == (count - 1 if count > 1 else 0)
    gaps = np.diff(places)
    assert len(gaps) == 0 or gaps.max() - gaps.min() <= 1


@given(rows=st.integers(2, 60), columns=st.integers(2, 60))
def test_points_are_as_dense_in_large_images_and_never_fewer(rows: int, columns: int) -> None:
    model, size = MODEL, (16 * rows, 16 * columns)
    usual = model.config.detector.num_keypoints
    assert num_points(model, size) >= usual
    if size[0] * size[1] >= 192 * usual:
        assert num_points(model, size) == pytest.approx(size[0] * size[1] / 192, abs=1)


MODEL = load_model()


def test_the_command_tries_all_view_sets_and_says_what_it_chose(
    capture: Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run: Run
) -> None:
    tried: list[int] = []

    def large(*given: object, **options: object) -> PredictConfig:
        _, _, view_sets, config, _ = given
        assert isinstance(view_sets, Sequence)
        assert isinstance(config, PredictConfig)
        tried.append(len(view_sets))
        return with_larger_images(config)

    monkeypatch.setattr(trial, "surest_config", large)
    out = tmp_path / "maps"
    said = run("depth", capture.path, "--out", out, "--shard", "2/2", "--no-page")
    assert said.code == 0, said.err
    assert "larger images are as sure" in said.out
    assert tried == [len(capture.frames)]  # not those of this shard alone
    summary = json.loads((out / "summary.2-of-2.json").read_text())
    settings = summary["settings"]
    assert settings["predict"]["work_pixels"] == LARGE_PIXELS
    for number in (2, 1):  # what one has chosen is not tried again
        assert run("depth", capture.path, "--out", out, "--shard", f"{number}/2").code == 0
    assert json.loads((out / "summary.json").read_text())["settings"] == settings
    run("depth", capture.path, "--out", tmp_path / "b", "--work-size", 48, 64, "--no-page")
    assert len(tried) == 1
    assert run("depth", capture.path, "--out", out, "--overwrite", "--no-page").code == 0
    assert len(tried) == 2
