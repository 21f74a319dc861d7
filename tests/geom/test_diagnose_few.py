"""``diagnose`` of so few matches that much can be made to fit them."""

import pytest
import torch
from diagnosis_cases import (
    FLIP,
    Capture,
    Fault,
    diagnosed,
    of_another_size,
    seen_by,
    transposed,
    with_focal_lengths,
)

from deltas_geom import invert_pose
from deltas_geom.diagnosis.causes import Cause
from deltas_geom.diagnosis.diagnose import _well
from deltas_geom.diagnosis.evidence import Evidence

TWO_FAULTS: dict[str, Fault] = {
    "inverted, of another size": lambda K, T, x: (of_another_size(K, 2.0), invert_pose(T), x),
    "OpenGL's axes, exchanged": lambda K, T, x: (K, FLIP @ T, x.flip(0)),
    "transposed, cropped": lambda K, T, x: (K, transposed(T), x - torch.tensor([160.0, 120.0])),
    "other matches": lambda K, T, x: (K, T, torch.stack([x[0], x[1].roll(5, 0)])),
}


def a_dozen(seed: int, *, num_views: int, turning: float, noise: float = 0.0) -> Capture:
    """Cameras up to ``turning`` rad apart or more, each some tens of cm from the others."""
    generator = torch.Generator().manual_seed(seed)
    turn, center = torch.randn(2, num_views, 3, generator=generator).double()
    K, pose, pixels = seen_by(turning * turn, 0.4 * center, num_points=12)
    return K, pose, pixels + noise * torch.randn(pixels.shape, generator=generator)


@pytest.mark.parametrize("fault", TWO_FAULTS.values(), ids=TWO_FAULTS)
@pytest.mark.parametrize("seed", range(3))
def test_a_dozen_matches_are_not_explained_by_accident(fault: Fault, seed: int) -> None:
    """A factor or a shift can be chosen so that a quarter of so few fits."""
    K, pose, pixels = a_dozen(seed, num_views=2, turning=0.3, noise=1.0)
    found = diagnosed(fault(K, pose, pixels))
    assert found.cause is Cause.NO_SINGLE_CAUSE or found.alternatives, str(found)
    assert diagnosed((K, invert_pose(pose), pixels)).cause is Cause.POSES_INVERTED


@pytest.mark.parametrize("seed", [7, 8, 13])
def test_a_camera_is_apart_only_from_others_that_agree(seed: int) -> None:
    """Of mirrored cameras some pairs are less wrong than others, and yet wrong."""
    mirror = torch.diag(torch.tensor([1.0, -1, 1, 1]).double())
    K, pose, pixels = a_dozen(seed, num_views=3, turning=0.1)
    found = diagnosed((K, mirror @ pose, pixels))
    assert found.cause is not Cause.CAMERA_DISAGREES, str(found)


@pytest.mark.parametrize("factor", [1.2, 0.7])
def test_wrong_focal_lengths_are_no_crop_and_no_other_size(factor: float) -> None:
    K, pose, pixels = a_dozen(0, num_views=4, turning=0.3, noise=0.3)
    found = diagnosed((with_focal_lengths(K, factor), pose, pixels))
    assert found.cause is Cause.FOCAL_LENGTH and found.alternatives == (), str(found)
    assert found.factor == pytest.approx(1 / factor, rel=0.02)
    assert f"K[..., :2, :2] *= {found.factor:.4g}" in found.cure
    torch.testing.assert_close(found.mended.views.K, K, rtol=0.02, atol=0)


def test_cameras_that_see_nothing_are_not_among_the_worst() -> None:
    K, pose, pixels = a_dozen(0, num_views=3, turning=0.3)
    pixels[1] = pixels[1].roll(5, 0)
    pixels[2] = torch.nan
    found = diagnosed((K, pose, pixels))
    assert found.cause is Cause.NO_SINGLE_CAUSE and found.camera_residuals[2].isnan()
    worst = found.sentence.partition(" px off ")[2]
    assert "camera 0" in worst and "camera 2" not in worst and "nan" not in worst, worst


def test_all_is_not_well_where_one_camera_of_many_fits_no_other() -> None:
    pairs = torch.combinations(torch.arange(12))
    off = (pairs == 3).any(dim=-1).double()  # of 11 in 66 pairs
    nothing = torch.zeros(len(pairs), 0, 2)
    evidence = Evidence(pairs, nothing, nothing, torch.zeros(len(pairs)))
    assert not _well(9 * off, evidence, 12, limit=2.0)
    assert _well(off, evidence, 12, limit=2.0)
