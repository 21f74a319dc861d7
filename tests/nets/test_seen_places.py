"""What a frame has in its image, if nothing hides it; where cameras stand."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from deltas_geom import PosedViews, project
from deltas_geom.testing.strategies import intrinsics, poses, vectors
from deltas_nets.captures import view_choice
from deltas_nets.captures.capture import Capture
from deltas_nets.captures.centres import camera_centres
from deltas_nets.captures.frame import FloatArray, Frame, Lens
from deltas_nets.captures.frames import Frames
from deltas_nets.captures.known_depths import points_in_view
from deltas_nets.captures.points import Observations, SparsePoints
from deltas_nets.captures.seen_places import in_images, seen_places
from deltas_nets.captures.straight import StraightFrame, in_photo, straight

SIZE = (480, 640)


@given(intrinsics(3), poses(3, turn=2.0, shift=2.0), vectors(12, within=4.0), st.floats(0, 2))
def test_a_frame_sees_what_projects_into_its_image_and_is_not_too_near(
    K: Tensor, cam_from_world: Tensor, places: Tensor, nearest: float
) -> None:
    """Places around the first camera, in its axes; beside projections of them in the world."""
    frames = Frames.of(
        Frame(str(number), Path(f"{number}.png"), SIZE, K[number].numpy(), pose.numpy())
        for number, pose in enumerate(cam_from_world)
    )
    pose, others = cam_from_world[0], np.array([2, 1])
    found = seen_places(frames, others, places.T.numpy(), pose.numpy(), nearest=nearest)
    in_world = (places - pose[:3, 3]) @ pose[:3, :3]
    seen = project(PosedViews(K, cam_from_world).select([2, 1]), in_world)
    x, y = seen.pixels.unbind(dim=-1)
    off = torch.maximum((x - 319.5).abs() - 320, (y - 239.5).abs() - 240)
    # On the image's edge, and at the nearest depth, rounding decides.
    sure = (off.abs() > 1e-6) & ((seen.depth - nearest).abs() > 1e-6)
    expected = seen.in_front & (seen.depth > nearest) & (off < 0)
    assert torch.equal(torch.from_numpy(found)[sure], expected[sure])


def untold(xyz: FloatArray) -> SparsePoints:
    """Points of which nobody says who sees them."""
    count = len(xyz)
    return SparsePoints(xyz, np.zeros((count, 3), np.uint8), np.zeros(count), Observations.none())


@pytest.mark.parametrize(
    "lens",
    [
        Lens("SIMPLE_RADIAL", (-0.21,)),
        Lens("SIMPLE_RADIAL", (0.15,)),
        Lens("OPENCV_FISHEYE", (0.02, -0.01, 0, 0)),
    ],
    ids=["barrel", "pincushion", "fisheye"],
)
def test_through_a_lens_a_frame_sees_what_is_in_its_photo(lens: Lens) -> None:
    K = np.array([[400.0, 0, 319.5], [0, 400, 239.5], [0, 0, 1]])
    pinhole = Frame("pinhole", Path("0.png"), SIZE, K, np.eye(4))
    frames = Frames.of([replace(pinhole, id="lens", lens=lens), pinhole])
    x, y = np.meshgrid(np.linspace(-2, 2, 41), np.linspace(-2, 2, 41))
    places = np.stack([x.ravel(), y.ravel(), np.full(x.size, 1.0)])
    found = seen_places(frames, np.array([1, 0, 1]), 3 * places, np.eye(4))
    assert (found[0] == found[2]).all()
    frame = straight(frames["lens"])
    assert isinstance(frame, StraightFrame)
    near = np.linalg.norm(places, axis=0) < 1.9  # the straight image ends at 2
    assert (found[1] == in_photo(frame, places.T))[near].all()
    assert (found[1] != found[0])[near].sum() > 10
    capture = Capture(Path(), frames, {}, points=untold(3 * places.T))
    points = points_in_view(capture, 0)
    assert points is not None and np.array_equal(points, 3 * places.T[found[1]])
    probes, _ = view_choice._probes(replace(capture, points=None), 0, 2.0)
    assert in_images(frames, np.array([0]), probes[None]).all()
    assert np.ptp(probes[0] / probes[2]) > 0.75 * np.ptp(places[0, found[1] & near])


def test_a_point_on_the_first_half_pixel_is_in_view() -> None:
    K = np.array([[100.0, 0, 319.5], [0, 100, 239.5], [0, 0, 1]])
    frames = Frames.of([Frame("0", Path("0.png"), SIZE, K, np.eye(4))])
    columns = np.array([-0.6, -0.4, 0, 639, 639.4, 639.6])
    xyz = np.stack([(columns - 319.5) / 100, 0 * columns, 1 + 0 * columns], axis=-1)
    capture = Capture(Path(), frames, {}, points=untold(xyz))
    points = points_in_view(capture, 0, least=1)
    assert points is not None and np.array_equal(points, xyz[1:5])


@given(poses(3, turn=3.0, shift=5.0))
def test_a_camera_has_its_centre_at_its_own_origin(cam_from_world: Tensor) -> None:
    centres = torch.from_numpy(camera_centres(cam_from_world.numpy()))
    moved = cam_from_world[:, :3, :3] @ centres[..., None] + cam_from_world[:, :3, 3:]
    assert moved.abs().max() < 1e-12
