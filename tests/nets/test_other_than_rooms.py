"""Captures in metres of desks and streets: metres do not tell how far surfaces are, a look does."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.scaled import scaled
from deltas_nets.captures.view_sets import ViewSet
from deltas_nets.captures.working_depth import knows_its_scale
from deltas_nets.commands.depth_options import fitting_options
from deltas_nets.errors import UserError
from deltas_nets.outputs.products import OutputOptions
from deltas_nets.predict.depth_map import DepthMap, KeypointDepths, PredictConfig, Wanted
from deltas_nets.predict.first_look import depth_seen, depth_unlike_rooms
from deltas_nets.predict.search import Followed

VIEWS = ViewSet("1", ("0", "2"))
CONFIG = PredictConfig()


class Scattered:
    """Finds a wall where cameras 15 cm apart would see it at 2.5 m, within what is searched; else
    points all over that, as matches that are wrong are: they pile up at no end."""

    def __init__(self, sure: float | None = 0.5, *, at_first: float | None = None) -> None:
        self.sure, self.states_confidence = sure, sure is not None
        self.at_first, self.calls = at_first, 0

    def depth_map(self, wanted: Wanted) -> DepthMap:
        frames, config, _ = wanted
        near, far = config.depth_range
        apart = np.linalg.norm((frames[1].cam_from_world - frames[0].cam_from_world)[:3, 3])
        wall = 2.5 * float(apart) / 0.15
        depth = torch.full((99,), wall)
        if not near < wall < far:
            depth = 1 / torch.linspace(1 / far, 1 / near, 101)[1:-1]
        size = wanted.size
        map = np.full(size, float(depth.median()), dtype=np.float32)
        points, colors = np.zeros((1, 3)), np.zeros((1, 3), np.uint8)
        keypoints = KeypointDepths(torch.zeros(99, 2), depth, size)
        self.calls += 1
        sure = self.at_first if self.at_first and self.calls <= 4 else self.sure
        confidence = None if sure is None else np.full(size, sure, dtype=np.float32)
        return DepthMap(map, confidence, points, colors, keypoints)


@pytest.mark.parametrize("scale", [0.02, 0.2, 1.0, 8.0, 300.0])
def test_a_look_finds_surfaces_of_a_capture_in_metres(capture: Capture, scale: float) -> None:
    other, network = scaled(capture, scale), Scattered()
    assert other.metric and not knows_its_scale(other)
    usual = depth_seen(network, capture, CONFIG)  # type: ignore[arg-type]
    found = depth_unlike_rooms(network, other, CONFIG, threads=2)  # type: ignore[arg-type]
    assert found == (None if scale == 1 else pytest.approx(scale * usual))

    seen = Followed(other, as_rooms=found is None)(network, VIEWS, CONFIG)  # type: ignore[arg-type]
    assert np.allclose(seen.map.depth, 2.5 * scale, rtol=1e-5)
    assert seen.reach.near < 2.5 * scale < seen.reach.far


def test_who_is_not_sure_takes_a_capture_in_metres_for_a_room(capture: Capture) -> None:
    other = scaled(capture, 8.0)
    for network in (Scattered(sure=0.2), Scattered(sure=None)):
        assert depth_unlike_rooms(network, other, CONFIG) is None  # type: ignore[arg-type]
        nothing_known = replace(other, metric=False)
        assert depth_unlike_rooms(network, nothing_known, CONFIG) is not None  # type: ignore[arg-type]


def test_it_looks_again_with_views_for_what_it_saw(capture: Capture) -> None:
    network, other = Scattered(at_first=0.1), scaled(capture, 8.0)
    assert depth_unlike_rooms(network, other, CONFIG) == pytest.approx(  # type: ignore[arg-type]
        depth_seen(Scattered(), other, CONFIG)  # type: ignore[arg-type]
    )
    one_more = Scattered(at_first=0.1)
    assert depth_unlike_rooms(one_more, capture, CONFIG) is None and one_more.calls == 2  # type: ignore[arg-type]


def test_what_a_capture_states_is_not_looked_for(capture: Capture) -> None:
    stated = replace(capture, depth_ranges=np.tile([10.0, 40.0], (len(capture.frames), 1)))
    assert depth_seen(None, stated, CONFIG) == pytest.approx(16)  # type: ignore[arg-type]
    assert depth_unlike_rooms(None, stated, CONFIG) is None  # type: ignore[arg-type]


def test_streets_do_not_fit_in_millimetres(capture: Capture) -> None:
    options = OutputOptions()
    assert fitting_options(options, capture, None, None, None) == options
    assert fitting_options(options, capture, 15.0, None, None) == options
    assert fitting_options(options, capture, 20.0, None, (1.0, 50.0)) == options
    with pytest.raises(UserError, match=r"searched up to 80 m.*--depth-scale 400"):
        fitting_options(options, capture, 20.0, None, None)
