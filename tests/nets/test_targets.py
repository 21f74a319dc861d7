"""Targets: true keypoint depth, matches, visibility and detector labels."""

import torch
from hypothesis import given
from hypothesis import strategies as st

from deltas_geom import PosedViews, epipolar_distance, fundamental_between
from deltas_nets.losses.targets import detector_labels, keypoint_targets, read_nearest
from deltas_nets.rooms import render_room

K = torch.tensor([[50.0, 0, 31.5], [0, 50, 23.5], [0, 0, 1]])


def shifted_pair(baseline: float) -> PosedViews:
    pose = torch.eye(4).repeat(1, 2, 1, 1)
    pose[0, 1, 0, 3] = -baseline
    return PosedViews(K.expand(1, 2, 3, 3), pose)


@given(depth=st.floats(1.0, 8.0), baseline=st.floats(0.05, 0.4))
def test_the_match_of_a_plane_is_shifted_by_its_disparity(depth: float, baseline: float) -> None:
    keypoints = torch.tensor([[[40.0, 20.0], [50.0, 30.0]]])
    targets = keypoint_targets(
        shifted_pair(baseline), torch.full((1, 2, 48, 64), depth), keypoints, depth_range=(0.5, 10)
    )
    expected = keypoints.clone()
    expected[..., 0] -= 50 * baseline / depth
    torch.testing.assert_close(targets.pixels[:, 1], expected, rtol=0, atol=1e-3)
    assert targets.visible.all()


def test_what_something_nearer_hides_is_not_visible() -> None:
    depth = torch.full((1, 2, 48, 64), 4.0)
    depth[0, 1, :, 20:50] = 1.0  # the source sees a near object there
    keypoints = torch.tensor([[[40.0, 20.0], [60.0, 20.0]]])
    targets = keypoint_targets(shifted_pair(0.1), depth, keypoints, depth_range=(0.5, 10))
    assert targets.visible[0, 1].tolist() == [False, True]


def test_unknown_and_distant_depth_is_no_target() -> None:
    depth = torch.full((1, 2, 48, 64), 4.0)
    depth[0, 0, 20, 40], depth[0, 0, 30, 50] = 0.0, 20.0
    keypoints = torch.tensor([[[40.0, 20.0], [50.0, 30.0], [10.0, 10.0]]])
    targets = keypoint_targets(shifted_pair(0.1), depth, keypoints, depth_range=(0.5, 10))
    assert targets.known.tolist() == [[False, False, True]]
    assert targets.points.isfinite().all()


def test_true_matches_of_a_room_lie_on_epipolar_lines() -> None:
    room = render_room(4, num_views=2, image_size=(72, 96))
    views = PosedViews(*(tensor[None].double() for tensor in room.views))
    keypoints = torch.rand(1, 50, 2).double() * torch.tensor([95.0, 71.0])
    targets = keypoint_targets(views, room.depth[None].double(), keypoints, depth_range=(0.1, 20))
    distance = epipolar_distance(fundamental_between(views), keypoints, targets.pixels[:, 1])
    assert distance[targets.known].abs().max() < 1e-6  # px


def test_depth_is_read_from_the_pixel_that_holds_the_place() -> None:
    image = torch.arange(6.0).reshape(2, 3)
    places = torch.tensor([[0.49, 0.0], [0.51, 0.0], [2.4, 1.4], [9.0, -3.0]])
    assert read_nearest(image, places).tolist() == [0, 1, 5, 2]


def test_a_white_squares_corners_are_labelled() -> None:
    images = torch.zeros(1, 3, 48, 64)
    images[:, :, 13:30, 21:44] = 1
    labels = detector_labels(images)[0]
    assert labels.shape == (6, 8)
    cells = (labels < 64).nonzero().tolist()
    assert cells == [[1, 2], [1, 5], [3, 2], [3, 5]]
    # The corner at row 13, column 21 is at row 5, column 5 of its cell, give or take a pixel.
    row, column = divmod(int(labels[1, 2]), 8)
    assert abs(row - 5) <= 1
    assert abs(column - 5) <= 1


def test_a_blank_image_has_no_interest_points() -> None:
    assert (detector_labels(torch.full((1, 3, 40, 40), 0.5)) == 64).all()
