"""What a frame has in its image, if nothing hides it; where cameras stand."""

from pathlib import Path

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from deltas_geom import PosedViews, project
from deltas_geom.testing.strategies import intrinsics, poses, vectors
from deltas_nets.captures.centres import camera_centres
from deltas_nets.captures.frame import Frame
from deltas_nets.captures.frames import Frames
from deltas_nets.captures.seen_places import seen_places

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


@given(poses(3, turn=3.0, shift=5.0))
def test_a_camera_has_its_centre_at_its_own_origin(cam_from_world: Tensor) -> None:
    centres = torch.from_numpy(camera_centres(cam_from_world.numpy()))
    moved = cam_from_world[:, :3, :3] @ centres[..., None] + cam_from_world[:, :3, 3:]
    assert moved.abs().max() < 1e-12
