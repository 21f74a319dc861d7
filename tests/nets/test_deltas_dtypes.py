"""The network takes cameras and images of any floating dtype, as geometry does.

It works in the dtype of its weights, and geometry in float32 at least.
"""

import copy
from collections.abc import Callable
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.testing import assert_close
from torch.utils._python_dispatch import TorchDispatchMode

from deltas_geom import PosedViews, ShapeError
from deltas_nets import load_model
from deltas_nets.config import CONFIGS, LossConfig, NetworkConfig
from deltas_nets.losses.losses import training_losses
from deltas_nets.network.deltas import Deltas
from deltas_nets.network.layers import WideBatchNorm1d, WideLinear, WideRowConv
from deltas_nets.network.lite.calibration import VIEWS, Curve, SpreadCalibration
from deltas_nets.network.prediction import DepthPrediction

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
        for ours, theirs in ((found.depth, wanted.depth), (found.std, wanted.std)):
            assert ours.dtype == torch.float32
            assert torch.equal(ours, theirs)
        assert found.points.points.dtype == given.cam_from_world.dtype
        assert_close(found.points.points.float(), wanted.points.points)


@torch.no_grad()
def test_images_in_half_precision_are_taken_for_what_they_are(model: Deltas) -> None:
    half = IMAGES.bfloat16()
    found, wanted = model(half, cameras()).depth, model(half.float(), cameras()).depth
    assert found.dtype == torch.float32 and torch.equal(found, wanted)


@pytest.mark.parametrize("shape", [(0, 2, 3, 48, 64), (2, 3, 0, 64)], ids=str)
def test_empty_images_are_an_error_in_words(model: Deltas, shape: tuple[int, ...]) -> None:
    with pytest.raises(ShapeError, match="images must not be empty"):
        model(torch.zeros(shape), cameras())


SMOOTH = F.interpolate(
    torch.rand(2, 3, 8, 12, generator=torch.Generator().manual_seed(0)), (32, 48), mode="bilinear"
)
"""Of which rounding does not change the choice of keypoints, as it does in noise."""


# The slow one differs from the last in its backbone alone.
NETWORKS = [
    "deltas-small",
    pytest.param("deltas-resnet50", marks=pytest.mark.slow),
    "deltas-vgg9",
]


@pytest.fixture(scope="module", params=NETWORKS)
def network(request: pytest.FixtureRequest) -> Deltas:
    """Each of the named ones: trained, if its weights are shipped."""
    torch.manual_seed(0)
    name = request.param
    return load_model() if name == "deltas-small" else Deltas(CONFIGS[name]).eval()


def predicted(network: Deltas) -> DepthPrediction:
    return network(SMOOTH, cameras(), num_keypoints=64)


def gradients(network: Deltas, prediction: DepthPrediction) -> list[Tensor]:
    """Of the parameters that are used."""
    total = prediction.depth.log().sum() + prediction.std.log().sum()
    total = total + prediction.evidence.confidence.sum()
    found = torch.autograd.grad(total, list(network.parameters()), allow_unused=True)
    return [gradient for gradient in found if gradient is not None]


def floats(value: Any) -> list[Tensor]:
    """Every floating tensor of a prediction."""
    if isinstance(value, Tensor):
        return [value] if value.is_floating_point() else []
    return [item for part in value or () for item in floats(part)]


def test_a_double_network_predicts_and_learns_in_double_what_the_single_one_does(
    network: Deltas,
) -> None:
    double = copy.deepcopy(network).double()
    wanted, found = predicted(network), predicted(double)
    assert {tensor.dtype for tensor in floats(found)} == {torch.float64}
    assert torch.equal(found.keypoints.pixels, wanted.keypoints.pixels.double())
    for ours, theirs in zip(found[:2], wanted[:2], strict=True):
        assert_close(ours, theirs.double(), rtol=1e-3, atol=0)
    of_double, of_single = gradients(double, found), gradients(network, wanted)
    assert len(of_double) == len(of_single)
    assert {gradient.dtype for gradient in of_double} == {torch.float64}
    ours, theirs = (
        torch.cat([g.flatten().double() for g in all]) for all in (of_double, of_single)
    )
    # As a whole: what batch norm takes away again has a gradient of nothing but rounding.
    assert (ours - theirs).norm() < 5e-3 * theirs.norm()


class Roundings(TorchDispatchMode):
    """Counts casts of doubles to narrower numbers that change their values."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        output = func(*args, **(kwargs or {}))
        if func is torch.ops.aten._to_copy.default and args[0].dtype == torch.float64:
            self.count += output.is_floating_point() and not torch.equal(output.double(), args[0])
        return output


@torch.no_grad()
def test_nothing_in_a_double_network_is_rounded_to_single(network: Deltas) -> None:
    double = copy.deepcopy(network).double()
    images, views = SMOOTH.double(), cameras().to(torch.float64)
    with Roundings() as roundings:
        double(images, views, num_keypoints=64)
        assert roundings.count == 0
        (images / 3).float()
    assert roundings.count == 1


@torch.no_grad()
@pytest.mark.parametrize("half", [torch.bfloat16, torch.float16], ids=str)
def test_a_network_of_half_precision_keeps_geometry_in_single(
    network: Deltas, half: torch.dtype
) -> None:
    wanted, found = predicted(network), predicted(copy.deepcopy(network).to(half))
    assert {tensor.dtype for tensor in floats(found)} == {torch.float32}
    relative = (found.depth / wanted.depth - 1).abs()
    assert relative.median() < 0.02
    assert found.std.isfinite().all() and (found.std > 0).all()


def test_a_network_in_bfloat16_has_finite_gradients_in_bfloat16(network: Deltas) -> None:
    half = copy.deepcopy(network).bfloat16()
    found = gradients(half, predicted(half))
    assert {gradient.dtype for gradient in found} == {torch.bfloat16}
    assert all(gradient.isfinite().all() for gradient in found)


def test_losses_of_a_double_network_take_images_in_single(model: Deltas) -> None:
    double = copy.deepcopy(model).double()
    views = PosedViews(*(tensor[None] for tensor in cameras()))
    prediction = double(SMOOTH[None], views, num_keypoints=64)
    truth = torch.full((1, 2, 32, 48), 2.0)
    losses = training_losses(
        prediction, SMOOTH[None], views, truth, LossConfig(), depth_range=(0.5, 10.0)
    )
    assert losses.total.dtype == torch.float64 and losses.total.isfinite()


WIDE_LAYERS: dict[str, Callable[[], nn.Module]] = {
    "linear": lambda: WideLinear(4, 3),
    "convolution": lambda: WideRowConv(4, 3, 5, padding=2),
    "batch norm": lambda: WideBatchNorm1d(4),
}


@pytest.mark.parametrize("name", WIDE_LAYERS)
@pytest.mark.parametrize("narrow", [torch.bfloat16, torch.float32], ids=str)
def test_wide_layers_are_the_same_layers_with_their_weights_promoted(
    name: str, narrow: torch.dtype
) -> None:
    random = torch.Generator().manual_seed(0)
    shape = (6, 4, 2, 4) if name == "convolution" else (6, 4, 4)
    given = torch.randn(shape, generator=random, dtype=torch.float64)
    torch.manual_seed(0)
    kept = WIDE_LAYERS[name]().to(narrow)
    widened = copy.deepcopy(kept).double()
    for _ in range(2):  # the second time from other statistics
        found = kept(given)
        assert found.dtype == torch.float64
        assert torch.equal(found, widened(given))
        for buffer_name, buffer in kept.named_buffers():
            wanted = widened.get_buffer(buffer_name)
            assert_close(buffer, wanted.to(buffer.dtype), rtol=0.01, atol=0.01)
    kept, widened = kept.eval(), copy.deepcopy(kept).double().eval()
    assert torch.equal(kept(given), widened(given))


def test_knots_that_rounding_joins_are_a_step_of_the_calibration() -> None:
    calibration = SpreadCalibration()
    knots = torch.tensor([-6.0, -5.001, -5.0, -4.0, -3.0, -2.0, 0.0, 2.0])  # two as one in bfloat16
    values = torch.tensor([-6.0, -5.0, -4.0, -3.0, -2.0, -1.0, 0.0, 2.0])
    for num_views in VIEWS:
        calibration.set(num_views, Curve(knots, values))
    log_std = torch.tensor([-7.0, -5.5, -4.5, -1.0, 3.0])
    wanted = calibration(log_std, 2)
    found = calibration.bfloat16()(log_std, 2)
    assert found.dtype == torch.float32
    assert_close(found, wanted, rtol=0, atol=0.02)
