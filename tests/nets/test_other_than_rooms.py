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
from deltas_nets.predict.first_look import depth_seen, elsewhere_than_in_rooms
from deltas_nets.predict.search import Followed

VIEWS = ViewSet("1", ("0", "2"))
CONFIG = PredictConfig()


class Scattered:
    """Finds a wall where cameras 15 cm apart would see it at 2.5 m, within what is searched; else
    points all over that, as matches that are wrong are: they pile up at no end."""

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
        return DepthMap(map, np.full(size, 0.5, dtype=np.float32), points, colors, keypoints)


@pytest.mark.parametrize("scale", [0.02, 0.2, 1.0, 8.0, 300.0])
def test_a_look_finds_surfaces_of_a_capture_in_metres(capture: Capture, scale: float) -> None:
    other = scaled(capture, scale)
    assert other.metric and not knows_its_scale(other)
    depth = depth_seen(Scattered(), other, CONFIG, threads=2)  # type: ignore[arg-type]
    usual = depth_seen(Scattered(), capture, CONFIG)  # type: ignore[arg-type]
    assert depth == pytest.approx(scale * usual)
    elsewhere = elsewhere_than_in_rooms(depth, other)
    assert elsewhere is None if scale == 1 else elsewhere == depth

    found = Followed(other, as_rooms=elsewhere is None)(Scattered(), VIEWS, CONFIG)  # type: ignore[arg-type]
    assert np.allclose(found.map.depth, 2.5 * scale, rtol=1e-5)
    assert found.reach.near < 2.5 * scale < found.reach.far


def test_what_a_capture_states_is_not_looked_for(capture: Capture) -> None:
    stated = replace(capture, depth_ranges=np.tile([10.0, 40.0], (len(capture.frames), 1)))
    assert depth_seen(None, stated, CONFIG) == pytest.approx(16)  # type: ignore[arg-type]
    assert elsewhere_than_in_rooms(16.0, stated) is None
    # Without metres nothing is usual.
    assert elsewhere_than_in_rooms(2.5, replace(capture, metric=False)) == 2.5


def test_streets_do_not_fit_in_millimetres(capture: Capture) -> None:
    options = OutputOptions()
    assert fitting_options(options, capture, None, None, None) == options
    assert fitting_options(options, capture, 15.0, None, None) == options
    assert fitting_options(options, capture, 20.0, None, (1.0, 50.0)) == options
    with pytest.raises(UserError, match=r"searched up to 80 m.*--depth-scale 400"):
        fitting_options(options, capture, 20.0, None, None)
