"""Rigid transforms cancel like fractions."""

import pytest
import torch
from hypothesis import given
from kornia.geometry.linalg import inverse_transformation
from torch.testing import assert_close

from deltas_geom import ShapeError, camera_centers, invert_pose, is_rigid, relative_pose
from deltas_geom.cameras.poses import recentred
from deltas_geom.testing import rigid
from deltas_geom.testing.strategies import poses, vectors


def test_a_pose_is_4x4() -> None:
    for operation in (invert_pose, camera_centers, is_rigid):
        with pytest.raises(ShapeError, match=r"\(\*B, 4, 4\), got \(3, 4\)"):
            operation(torch.zeros(3, 4))
    pose = torch.eye(4)
    with pytest.raises(ShapeError, match=r"b_from_world must have .* got \(3, 4\)"):
        relative_pose(pose[:3], pose)
    with pytest.raises(ShapeError, match=r"a_from_world must have .* got \(3, 4\)"):
        relative_pose(pose, pose[:3])
    with pytest.raises(TypeError, match=r"a_from_world must be a torch\.Tensor, got ndarray"):
        relative_pose(pose, pose.numpy())
    with pytest.raises(ShapeError, match=r"must broadcast, got \(3,\), \(2,\)"):
        relative_pose(pose.expand(3, 4, 4), pose.expand(2, 4, 4))


@given(pose=poses(3, turn=3.0, shift=100.0))
def test_a_pose_times_its_inverse_is_nothing(pose: torch.Tensor) -> None:
    identity = torch.eye(4, dtype=pose.dtype).expand_as(pose)
    assert_close(pose @ invert_pose(pose), identity, rtol=0, atol=1e-12)  # rad, m


@given(pose=poses(2, turn=3.0, shift=10.0))
def test_a_relative_pose_cancels_the_world(pose: torch.Tensor) -> None:
    b_from_a = relative_pose(pose[1], pose[0])
    assert_close(b_from_a @ pose[0], pose[1], rtol=0, atol=1e-13)


@given(pose=poses(2, turn=3.0, shift=10.0))
def test_a_camera_stands_at_its_own_origin(pose: torch.Tensor) -> None:
    centers = camera_centers(pose)
    at_origin = (pose[:, :3, :3] @ centers[..., None]).squeeze(-1) + pose[:, :3, 3]
    assert_close(at_origin, torch.zeros_like(at_origin), rtol=0, atol=1e-13)  # m


@given(pose=poses(3, turn=3.0, shift=10.0))
def test_every_rotation_is_rigid_and_no_mirror_or_scaling_is(pose: torch.Tensor) -> None:
    assert is_rigid(pose).all()
    mirror = torch.diag(torch.tensor([-1.0, 1, 1, 1], dtype=pose.dtype))
    assert not is_rigid(mirror @ pose).any()
    assert not is_rigid(pose * torch.tensor([1.01, 1.01, 1.01, 1])).any()
    assert not is_rigid(torch.where(pose == pose[0, 0, 3], torch.nan, pose))[0]


@given(pose=poses(3, turn=3.0, shift=10.0))
def test_the_inverse_is_kornias(pose: torch.Tensor) -> None:
    assert_close(invert_pose(pose), inverse_transformation(pose), rtol=0, atol=1e-13)


@given(turn=vectors(3, within=3.0))
def test_axis_times_angle_is_scipys_rotation_vector(turn: torch.Tensor) -> None:
    rotation = pytest.importorskip("scipy.spatial.transform").Rotation
    wanted = torch.from_numpy(rotation.from_rotvec(turn.numpy()).as_matrix())
    assert_close(rigid(turn, torch.zeros_like(turn))[:, :3, :3], wanted, rtol=0, atol=1e-6)


def test_the_inverse_has_the_right_gradient() -> None:
    pose = rigid(torch.tensor([[0.1, 0.2, 0.3]]), torch.ones(1, 3)).double().requires_grad_()
    assert torch.autograd.gradcheck(invert_pose, (pose,))


@given(pose=poses(3, turn=3.0, shift=10.0))
def test_the_middle_of_cameras_is_that_of_the_known_ones(pose: torch.Tensor) -> None:
    unknown = torch.where(torch.arange(3)[:, None, None] == 1, torch.nan, pose)
    _, offset = recentred(unknown, None)
    assert_close(offset, camera_centers(pose[[0, 2]]).mean(dim=0), rtol=0, atol=1e-13)  # m
