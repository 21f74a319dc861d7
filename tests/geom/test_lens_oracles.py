"""Lenses beside OpenCV, COLMAP and PyTorch3D's formula; undistorted images beside OpenCV's."""

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from lens_cases import CASES, SIZE, TURNING, pixels_of
from torch import Tensor
from torch.testing import assert_close

from deltas_geom import Lens, PosedViews, in_image, project, undistort_image, undistort_pixels
from deltas_geom.testing.strategies import intrinsics, vectors

DIST = [-0.3, 0.1, 1e-3, -2e-3, 0.01, 0.02, -0.01, 0.003, 2e-3, 1e-3, -3e-3, 5e-4, 0, 0]
POINTS = torch.cat([pixels_of(200) / 800 - 0.6, torch.ones(200, 1)], dim=-1).double()
K = torch.tensor([[500.0, 0, 655], [0, 510, 470], [0, 0, 1]]).double()


@pytest.mark.parametrize("count", [4, 5, 8, 12, 14])
def test_opencv_projects_to_the_same_pixels(count: int) -> None:
    dist = torch.tensor(DIST[:count]).double()
    lens = Lens.from_opencv(K, dist)
    for alike in (dist[None], dist[:, None]):  # as calibrateCamera has them
        assert torch.equal(Lens.from_opencv(K, alike).coefficients, lens.coefficients)
        many = Lens.from_opencv(K.expand(2, 3, 3), alike.expand(2, *alike.shape))
        assert undistort_pixels(many, torch.zeros(2, 7, 2)).pixels.shape == (2, 7, 2)
    none = np.zeros(3)
    theirs, _ = cv2.projectPoints(POINTS.numpy(), none, none, K.numpy(), dist.numpy())
    pixels, valid = lens.project(POINTS)
    assert_close(pixels[valid].numpy(), theirs[:, 0][valid.numpy()], rtol=0, atol=1e-9)
    assert valid.double().mean() > 0.9
    settled = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-14)
    seen = pixels[valid]
    slopes = cv2.undistortPoints(
        seen.numpy()[:, None], K.numpy(), dist.numpy(), P=K.numpy(), criteria=settled
    )
    ours, found = undistort_pixels(lens, seen)
    near = found & (POINTS[valid, :2].norm(dim=-1) < 0.7)  # its iterations fail farther out
    assert_close(ours[near].numpy(), slopes[:, 0][near.numpy()], rtol=0, atol=1e-6)


def test_opencv_fisheye_projects_to_the_same_pixels() -> None:
    dist = torch.tensor(CASES["OPENCV_FISHEYE"].coefficients).double()
    none = np.zeros(3)
    theirs, _ = cv2.fisheye.projectPoints(
        POINTS.numpy()[:, None], none, none, K.numpy(), dist.numpy()
    )
    ours = Lens.from_opencv_fisheye(K, dist[:, None]).project(POINTS)
    assert ours.valid.all()
    assert_close(ours.pixels.numpy(), theirs[:, 0], rtol=0, atol=1e-9)


@pytest.mark.parametrize("model", sorted(set(CASES) - {"OPENCV_THIN_PRISM"}))
def test_colmap_projects_to_the_same_pixels(model: str) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    lens = CASES[model].lens()
    params = lens.to_colmap()
    camera = pycolmap.Camera(model=model, width=SIZE[1], height=SIZE[0], params=params.numpy())
    pixels, valid = lens.project(POINTS)
    theirs = camera.img_from_cam(POINTS.numpy()) - 0.5
    assert (valid.double().mean() > 0.8 and valid.all()) or model == "DIVISION"
    assert_close(pixels[valid].numpy(), theirs[valid.numpy()], rtol=0, atol=1e-9)
    again = Lens.from_colmap(model, params)
    assert_close([again.K, again.coefficients], [lens.K, lens.coefficients])


def test_colmap_has_no_model_that_is_not_in_the_table() -> None:
    pycolmap = pytest.importorskip("pycolmap")
    assert set(pycolmap.CameraModelId.__members__) - {"INVALID"} <= set(Lens.models())


def ramp(size: tuple[int, int]) -> Tensor:
    """Waves that bilinear reading keeps to a thousandth."""
    y, x = torch.meshgrid(torch.arange(size[0]), torch.arange(size[1]), indexing="ij")
    return torch.stack([torch.sin(x / 40), torch.cos(y / 30)]).double()


def test_opencv_undistorts_the_same_image() -> None:
    lens = CASES["OPENCV"].lens()
    image = ramp(SIZE)
    found = undistort_image(lens, image, alpha=0.5)
    maps = cv2.initUndistortRectifyMap(
        lens.K.numpy(), lens.coefficients.numpy(), None, found.K.numpy(), SIZE[::-1], cv2.CV_32FC1
    )
    theirs = np.stack([cv2.remap(c.numpy(), *maps, cv2.INTER_LINEAR) for c in image])
    inner = (found.mask & cv2_inside(maps)).expand_as(image)
    assert inner.double().mean() > 0.6
    assert float((found.image - torch.from_numpy(theirs))[inner].abs().max()) < 2e-3


def cv2_inside(maps: tuple[np.ndarray, np.ndarray]) -> Tensor:
    places = torch.from_numpy(np.stack(maps, axis=-1))
    return in_image(places, image_size=SIZE, border=1)


@pytest.mark.parametrize("alpha", [0.0, 1.0])
def test_alpha_chooses_as_opencv_does(alpha: float) -> None:
    lens = Lens(K, torch.tensor([-0.05, 0.01]).double(), "RADIAL")
    dist = torch.cat([lens.coefficients, torch.zeros(2)]).numpy()
    theirs, _ = cv2.getOptimalNewCameraMatrix(lens.K.numpy(), dist, SIZE[::-1], alpha)
    ours = undistort_image(lens, torch.zeros(1, *SIZE), alpha=alpha).K
    assert_close(ours.numpy(), theirs, rtol=0.01, atol=1)


EACH = pytest.mark.parametrize(
    "name", [n for n in CASES | TURNING if n not in ("EQUIRECTANGULAR",)]
)


@EACH
def test_alpha_0_has_seen_all_pixels_and_alpha_1_keeps_all(name: str) -> None:
    lens = (CASES | TURNING)[name].lens()
    image = torch.ones(1, *SIZE, dtype=torch.float64)
    kept = undistort_image(lens, image, new_size=(120, 160))
    assert kept.mask.all()
    assert_close(kept.image, torch.ones_like(kept.image))
    whole = undistort_image(lens, image, alpha=1.0, new_size=(120, 160))
    rays, valid = lens.unproject(pixels_of(1000))
    asked = valid & (rays[:, 2] > 0.18)
    pixels, _ = undistort_pixels(lens, pixels_of(1000), whole.K)
    assert in_image(pixels[asked], image_size=(120, 160), border=-0.1).all()


def test_an_image_undistorted_at_its_own_K_keeps_depth_and_gradients() -> None:
    lens = CASES["OPENCV_FISHEYE"].lens()
    depth = 2 + ramp(SIZE)[:1]
    found = undistort_image(lens, depth, new_K=lens.K, mode="nearest", new_size=(100, 50))
    assert torch.isin(found.image[found.mask], depth).all()
    coefficients = lens.coefficients.clone().requires_grad_()
    image = ramp(SIZE).requires_grad_()
    result = undistort_image(Lens(lens.K, coefficients, lens.model), image, new_K=lens.K)
    result.image.sum().backward()
    assert coefficients.grad is not None and coefficients.grad.abs().sum() > 0
    assert image.grad is not None and image.grad.abs().sum() > 0
    with pytest.raises(ValueError, match="alpha"):
        undistort_image(lens, depth, alpha=2.0)


@given(
    K=intrinsics(2),
    ndc=vectors(2, within=0.5, size=4),
    turn=vectors(2, within=0.3),
    size=st.sampled_from([(480, 640), (640, 480)]),
)
def test_pytorch3d_cameras_see_the_same_pixels(
    K: Tensor, ndc: Tensor, turn: Tensor, size: tuple[int, int]
) -> None:
    R, T = torch.linalg.matrix_exp(skew(turn)), torch.tensor([[0.1, -0.2, 0.3]] * 2).double()
    focal, principal = 1 + ndc[:, :2], ndc[:, 2:]
    points = torch.tensor([[0.3, 0.2, 4.0], [-0.5, 0.1, 3.0]]).double()
    views = PosedViews.from_pytorch3d(R, T, focal, principal, image_size=size)
    views.check_values()
    for view in range(2):
        # Of PyTorch3D's notes on cameras: X R + T, NDC of the shorter side, x left, y up.
        x, y, z = (points.numpy() @ R[view].numpy() + T[view].numpy()).T
        u = focal[view, 0].item() * x / z + principal[view, 0].item()
        v = focal[view, 1].item() * y / z + principal[view, 1].item()
        half, (height, width) = min(size) / 2, size
        screen = np.stack([width / 2 - half * u, height / 2 - half * v], axis=-1)
        ours = project(views, points).pixels[view]
        assert_close(ours.numpy(), screen - 0.5, rtol=0, atol=1e-9)


def skew(vectors: Tensor) -> Tensor:
    return torch.linalg.cross(vectors[:, None], torch.eye(3).double().expand(2, 3, 3))


@given(centers=vectors(3, within=5.0), view=st.sampled_from([0, 2, None]))
def test_recentred_views_see_the_same_pixels_of_points_less_the_offset(
    centers: Tensor, view: int | None
) -> None:
    far = torch.tensor([5e5, 5.5e6, 200.0]).double()  # as UTM
    world_from_cam = torch.eye(4).double().repeat(3, 1, 1)
    world_from_cam[:, :3, 3] = centers + far
    views = PosedViews.from_world_from_cam(K.expand(3, 3, 3), world_from_cam)
    moved, offset = views.recentred(view)
    wanted = centers.mean(dim=0) if view is None else centers[view]
    assert_close(offset, wanted + far)
    points = centers[0] + far + torch.tensor([[0.0, 0, 20], [1, 2, 30]]).double()
    pixels = project(views, points).pixels
    assert_close(project(moved, points - offset).pixels, pixels, rtol=0, atol=1e-5)
    single = project(moved.to(torch.float32), (points - offset).float()).pixels
    assert_close(single.double(), pixels, rtol=0, atol=1e-2)
