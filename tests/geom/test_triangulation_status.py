"""What becomes of points that cannot be triangulated, and of hostile input."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch.testing import assert_close
from triangulation_cases import noisy

from deltas_geom import Status, camera_centers, triangulate
from deltas_geom.testing import PosedScene, forward_motion

pytestmark = pytest.mark.usefixtures("way")


@given(drawn=noisy(), view=st.integers(0, 2))
def test_status_tells_the_truth(drawn: tuple[PosedScene, Tensor], view: int) -> None:
    scene, weights = drawn
    weights = weights.clone()
    weights[:, 1] = 0
    weights[view, 1] = 1  # one view alone
    weights[:, 2] *= torch.where(torch.arange(3) == view, 1.0, 1e-12)  # as good as alone
    result = triangulate(scene.views.proj, scene.pixels, weights)
    wanted = [Status.OK, Status.TOO_FEW_VIEWS, Status.TOO_FEW_VIEWS, Status.OK]
    assert result.status.tolist() == wanted
    assert (result.valid == (result.status == Status.OK)).all()
    # The other cameras' pixels, mirrored through the centre, meet behind every camera.
    behind = scene._replace(points=2 * camera_centers(scene.views.cam_from_world)[0] - scene.points)
    homogeneous = (
        torch.cat([behind.points, torch.ones(4, 1).double()], dim=-1) @ scene.views.proj.mT
    )
    pixels = homogeneous[..., :2] / homogeneous[..., 2:]
    assert (triangulate(scene.views.proj, pixels).status == Status.BEHIND_CAMERA).all()


def test_unequal_weights_do_not_send_a_near_point_to_infinity(dtype: torch.dtype) -> None:
    scene = forward_motion(dtype=dtype)
    weights = torch.tensor([[1.0], [1e-5]], dtype=dtype).expand(2, 3)
    result = triangulate(scene.views.proj, scene.pixels, weights)
    assert (result.status == Status.OK).all()
    assert_close(result.points, scene.points, rtol=0, atol=1e-4)  # m


def test_every_status_explains_itself() -> None:
    for status in Status:
        assert len(status.explanation.split()) >= 4
    assert np.unique([status.explanation for status in Status]).size == len(Status)
