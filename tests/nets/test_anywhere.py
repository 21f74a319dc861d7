"""Worlds of which the cameras are far from the origin, and images of other ranges."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from stand_in_device import DEVICE, one_device, to_device
from torch import Tensor
from torch.testing import assert_close

from deltas_geom import PosedViews
from deltas_nets import load_model
from deltas_nets.config import LossConfig
from deltas_nets.losses.losses import training_losses
from deltas_nets.network.deltas import Deltas
from deltas_nets.network.prediction import DepthPrediction
from deltas_nets.rooms import render_room

ROOM = render_room(6, num_views=3, image_size=(96, 128))
IMAGES = ROOM.images[None].float() / 255
VIEWS = PosedViews(*(tensor[None] for tensor in ROOM.views))
RANGE = (0.5, 10.0)


@pytest.fixture(scope="module")
def model() -> Deltas:
    return load_model()


def costs(prediction: DepthPrediction, views: PosedViews) -> dict[str, Tensor]:
    depth = ROOM.depth[None]
    found = training_losses(prediction, IMAGES, views, depth, LossConfig(), depth_range=RANGE)
    assert found.terms["point"] > 0 and found.terms["match"] > 0
    return found.terms


@torch.no_grad()
@settings(max_examples=4)
@given(place=st.lists(st.floats(-6e6, 6e6), min_size=3, max_size=3))
def test_depth_and_losses_stay_and_points_move_with_the_world(
    model: Deltas, place: list[float]
) -> None:
    """As with UTM coordinates, or with the centre of the earth as origin."""
    by = torch.tensor(place, dtype=torch.float64)
    near_from_far = torch.eye(4, dtype=torch.float64)
    near_from_far[:3, 3] = -by
    near = VIEWS.to(torch.float64)
    far = PosedViews(near.K, near.cam_from_world @ near_from_far)
    here, there = model(IMAGES, near), model(IMAGES, far)
    assert_close(there.depth, here.depth, rtol=1e-3, atol=0)
    both = here.points.valid & there.points.valid
    assert both.sum() > 0.98 * here.points.valid.sum() > 100
    off = there.points.points - by - here.points.points
    assert off[both].norm(dim=-1).median() < 1e-5  # m
    assert (there.points.points[~there.points.valid] == 0).all()
    assert_close(costs(there, far), costs(here, near), rtol=2e-3, atol=1e-4)


@torch.no_grad()
def test_images_of_another_range_are_refused_where_looking_is_free(model: Deltas) -> None:
    for wrong in (IMAGES * 255, 4 * IMAGES - 2, IMAGES.bfloat16() * 255, IMAGES + torch.inf):
        with pytest.raises(ValueError, match=r"in \[0, 1\], got values from"):
            model(wrong, VIEWS)
    with pytest.raises(TypeError, match="floating point"):
        model(ROOM.images[None], VIEWS)
    for fine in (1.2 * IMAGES - 0.1, torch.where(IMAGES > 0.9, torch.nan, IMAGES)):
        model(fine, VIEWS)  # resizing overshoots; NaN is no range
    bright = to_device(IMAGES * 255)
    with one_device():
        assert load_model(device=DEVICE).encode(bright).descriptors.maps.device == DEVICE
