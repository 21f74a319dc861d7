"""The network takes cameras and images of any floating dtype, as geometry does."""

import pytest
import torch

from deltas_geom import PosedViews, ShapeError
from deltas_nets.config import NetworkConfig
from deltas_nets.network.deltas import Deltas

IMAGES = torch.rand(2, 3, 48, 64, generator=torch.Generator().manual_seed(0))


@pytest.fixture(scope="module")
def model() -> Deltas:
    torch.manual_seed(0)
    return Deltas(NetworkConfig()).eval()


def cameras() -> PosedViews:
    K = torch.tensor([[60.0, 0, 31.5], [0, 60, 23.5], [0, 0, 1]]).expand(2, 3, 3)
    pose = torch.eye(4).repeat(2, 1, 1)
    pose[1, 0, 3] = -0.2
    return PosedViews(K, pose)


@torch.no_grad()
def test_cameras_and_images_are_cast_to_the_dtype_of_the_weights(model: Deltas) -> None:
    views = cameras()
    wanted = model(IMAGES, views)
    for images, given in (
        (IMAGES, views.to(torch.float64)),
        (IMAGES.double(), views),
        (IMAGES.double(), PosedViews(views.K.double(), views.cam_from_world)),
    ):
        found = model(images, given)
        for ours, theirs in (
            (found.depth, wanted.depth),
            (found.std, wanted.std),
            (found.points.points, wanted.points.points),
        ):
            assert ours.dtype == torch.float32
            assert torch.equal(ours, theirs)


@torch.no_grad()
def test_images_in_half_precision_are_taken_for_what_they_are(model: Deltas) -> None:
    half = IMAGES.bfloat16()
    found, wanted = model(half, cameras()).depth, model(half.float(), cameras()).depth
    assert found.dtype == torch.float32 and torch.equal(found, wanted)


@pytest.mark.parametrize("shape", [(0, 2, 3, 48, 64), (2, 3, 0, 64)], ids=str)
def test_empty_images_are_an_error_in_words(model: Deltas, shape: tuple[int, ...]) -> None:
    with pytest.raises(ShapeError, match="images must not be empty"):
        model(torch.zeros(shape), cameras())
