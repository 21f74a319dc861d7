"""``diagnose`` of cameras that agree two by two, and contradict each other in threes."""

import pytest
import torch
from diagnosis_cases import Capture, diagnosed, seen_by, spoiled, with_translation
from torch import Tensor

from deltas_geom import PosedViews, camera_centers, diagnose
from deltas_geom.diagnosis.causes import Cause


def in_a_row(num_views: int, *, num_points: int = 150) -> Capture:
    """As a car drives, or a rig is built: 20 cm apart, turned a little."""
    step = torch.arange(num_views)[:, None].double()
    row = torch.tensor([0.2, 0.0, 0.05]).double() * step
    turn = torch.cat([0.02 * step.sin(), 0.05 * step.cos(), 0.0 * step], dim=-1)
    return seen_by(turn, row, num_points=num_points)


def farther(pose: Tensor, camera: int, factor: float) -> Tensor:
    """One camera moved away from the first, along the row."""
    centers = camera_centers(pose)
    center = centers[0] + factor * (centers[camera] - centers[0])
    translation = pose[:, :3, 3].clone()
    translation[camera] = -pose[camera, :3, :3] @ center
    return with_translation(pose, translation)


@pytest.mark.parametrize("wrong", [0.0, 0.3])
@pytest.mark.parametrize("num_views", [4, 6, 10])
@pytest.mark.parametrize("factor", [0.001, 3.0, 1000.0])
def test_a_camera_in_a_row_with_its_own_unit_disagrees(
    factor: float, num_views: int, wrong: float
) -> None:
    K, pose, pixels = in_a_row(num_views)
    pixels = spoiled(pixels, noise=0.5, wrong=wrong)
    assert diagnosed((K, pose, pixels)).well
    found = diagnosed((K, farther(pose, 2, factor), pixels))
    assert found.cause is Cause.CAMERA_DISAGREES and found.cameras == (2,), str(found)
    assert found.residual_as_given > 3 > 1 > found.residual_if_mended  # px
    assert int(found.camera_residuals.argmax()) == 2
    views, pixels, mask = found.mended
    assert diagnose(views, pixels, mask=mask).well


@pytest.mark.parametrize("wrong", [0.0, 0.3])
def test_of_three_cameras_in_a_row_none_is_singled_out(wrong: float) -> None:
    K, pose, pixels = in_a_row(3)
    pixels = spoiled(pixels, noise=0.5, wrong=wrong)
    assert diagnosed((K, pose, pixels)).well
    found = diagnosed((K, farther(pose, 2, 1000.0), pixels))
    assert found.cause is Cause.NO_SINGLE_CAUSE and found.residual_as_given > 3, str(found)


def test_few_points_of_three_views_raise_no_alarm() -> None:
    K, pose, pixels = in_a_row(4)
    mask = torch.ones(4, 150, dtype=torch.bool)
    # Each point is seen by two cameras, and a few by all: too few to blame one of them.
    mask[0, ::2] = mask[1, ::2] = mask[2, 1::2] = mask[3, 1::2] = False
    mask[:, :8] = True
    assert diagnose(PosedViews(K, farther(pose, 2, 3.0)), pixels, mask=mask).well
