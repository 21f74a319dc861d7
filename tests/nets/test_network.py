"""The network: shapes, batch dims, determinism, what each part promises."""

from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from deltas_geom import PosedViews, ShapeError, SparseDepth, Status
from deltas_nets.captures.posed_images import PosedImages
from deltas_nets.config import DetectorConfig, MatcherConfig, NetworkConfig
from deltas_nets.network.deltas import Deltas
from deltas_nets.network.joint.context import Context
from deltas_nets.network.lite.densifier import interpolate_sparse
from deltas_nets.network.lite.detector import detector_heatmap, spread_points
from deltas_nets.network.lite.efficientnet import EfficientNetLite0
from deltas_nets.network.prediction import DepthPrediction
from deltas_nets.rooms import render_room

SIZE = (64, 96)


@pytest.fixture(scope="module")
def room() -> PosedImages:
    return render_room(3, num_views=3, image_size=SIZE)


@pytest.fixture(scope="module")
def images(room: PosedImages) -> Tensor:
    return room.images.float() / 255


def make_model(kind: str = "joint") -> Deltas:
    torch.manual_seed(0)
    matcher = MatcherConfig(kind=kind, num_samples=32)  # type: ignore[arg-type]
    config = NetworkConfig(detector=DetectorConfig(num_keypoints=64), matcher=matcher)
    return Deltas(config).eval()


@pytest.fixture(scope="module", params=["joint", "per_view"])
def model(request: pytest.FixtureRequest) -> Deltas:
    return make_model(request.param)


@pytest.fixture(scope="module")
def prediction(model: Deltas, images: Tensor, room: PosedImages) -> DepthPrediction:
    with torch.no_grad():
        return model(images, room.views)


def test_wrong_shapes_and_ranges_are_refused(images: Tensor, room: PosedImages) -> None:
    model = make_model()
    with pytest.raises(ShapeError, match=r"images must have shape \(\*B, V, 3, H, W\)"):
        model(images[:, :2], room.views)
    with pytest.raises(ShapeError, match="at least one source"):
        model(images[:1], room.views.select(0))
    with pytest.raises(ValueError, match="near < far"):
        model(images, room.views, (3.0, 1.0))


def test_every_pixel_gets_a_positive_depth_and_deviation(prediction: DepthPrediction) -> None:
    assert prediction.depth.shape == prediction.std.shape == (1, *SIZE)
    for image in (prediction.depth, prediction.std):
        assert image.isfinite().all()
        assert (image > 0).all()
    assert ((prediction.confidence() >= 0) & (prediction.confidence() <= 1)).all()


def test_shapes_are_as_documented(prediction: DepthPrediction) -> None:
    assert prediction.keypoints.pixels.shape == (64, 2)
    assert prediction.matches.pixels.shape == (3, 64, 2)
    assert prediction.matches.covariance.shape == (3, 64, 2, 2)
    assert prediction.points.points.shape == (64, 3)
    assert prediction.sparse.depth.shape == (1, *SIZE)
    sizes = [scale.shape[-2:] for scale in prediction.evidence.dense.log_depth]
    assert sizes == [SIZE, (16, 24), (8, 12), (4, 6)]
    assert prediction.evidence.dense.log_spread.shape[-2:] == SIZE


def test_a_prediction_comes_back_from_a_file_and_prints_no_numbers(
    prediction: DepthPrediction, tmp_path: Path
) -> None:
    torch.save(prediction.detach(), tmp_path / "prediction.pt")
    loaded = torch.load(tmp_path / "prediction.pt")
    assert type(loaded) is DepthPrediction and torch.equal(loaded.depth, prediction.depth)
    assert prediction.to(torch.float64).points.points.dtype == torch.float64
    assert "points Triangulation(points (" in repr(prediction) and len(repr(prediction)) < 1200


def test_the_anchors_match_is_the_keypoint(prediction: DepthPrediction) -> None:
    assert torch.equal(prediction.matches.pixels[0], prediction.keypoints.pixels)
    assert (prediction.matches.weights[0] == 1).all()


def test_leading_batch_dims_are_kept_and_do_not_mix(
    model: Deltas, images: Tensor, room: PosedImages, prediction: DepthPrediction
) -> None:
    stacked = torch.stack([images, images.flip(-1)])[None]
    views = PosedViews(*(tensor.expand(1, 2, *tensor.shape) for tensor in room.views))
    with torch.no_grad():
        both = model(stacked, views)
    assert both.depth.shape == (1, 2, 1, *SIZE)
    assert both.points.points.shape == (1, 2, 64, 3)
    torch.testing.assert_close(both.depth[0, 0], prediction.depth, rtol=1e-3, atol=1e-3)


def test_the_same_input_gives_the_same_depth(
    model: Deltas, images: Tensor, room: PosedImages, prediction: DepthPrediction
) -> None:
    with torch.no_grad():
        assert torch.equal(model(images, room.views).depth, prediction.depth)


@pytest.mark.parametrize("size", [(50, 70), (33, 47)])
def test_any_height_and_width_will_do(size: tuple[int, int]) -> None:
    room = render_room(1, num_views=2, image_size=size)
    with torch.no_grad():
        prediction = make_model()(room.images.float() / 255, room.views)
    assert prediction.depth.shape == (1, *size)
    assert prediction.depth.isfinite().all()


def test_sources_in_another_order_give_the_same_depth(images: Tensor, room: PosedImages) -> None:
    model, order = make_model(), [0, 2, 1]
    with torch.no_grad():
        straight = model(images, room.views)
        swapped = model(images[order], room.views.select(order))
    torch.testing.assert_close(swapped.depth, straight.depth, rtol=1e-3, atol=1e-3)


def test_the_world_may_be_anywhere(images: Tensor, room: PosedImages) -> None:
    model = make_model()
    world_from_new = torch.eye(4)
    world_from_new[:3, :3] = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    world_from_new[:3, 3] = torch.tensor([3.0, -2, 5])
    moved = room.views._replace(cam_from_world=room.views.cam_from_world @ world_from_new)
    with torch.no_grad():
        torch.testing.assert_close(
            model(images, moved).depth, model(images, room.views).depth, rtol=1e-3, atol=1e-3
        )


def test_without_parallax_there_are_no_points_but_still_a_map(images: Tensor) -> None:
    K = torch.tensor([[90.0, 0, 47.5], [0, 90, 31.5], [0, 0, 1]]).expand(3, 3, 3)
    with torch.no_grad():
        prediction = make_model()(images, PosedViews(K, torch.eye(4).repeat(3, 1, 1)))
    assert (prediction.points.status == Status.NO_PARALLAX).all()
    assert (prediction.sparse.weight == 0).all()
    assert prediction.depth.isfinite().all()


def test_a_source_that_sees_nothing_changes_nothing_but_confidence(
    images: Tensor, room: PosedImages
) -> None:
    behind = torch.diag(torch.tensor([-1.0, 1, -1, 1])) @ room.views.cam_from_world[:1]
    views = PosedViews(
        torch.cat([room.views.K, room.views.K[:1]]),
        torch.cat([room.views.cam_from_world, behind]),
    )
    with torch.no_grad():
        prediction = make_model()(torch.cat([images, images[:1]]), views)
    assert not prediction.matches.mask[3].any()
    assert prediction.depth.isfinite().all()


@pytest.mark.parametrize("kind", ["joint", "per_view"])
def test_gradients_reach_every_parameter_and_are_finite(
    kind: str, images: Tensor, room: PosedImages
) -> None:
    model = make_model(kind).train()
    prediction = model(images[None], PosedViews(*(t[None] for t in room.views)))
    evidence = prediction.evidence
    loss = (
        sum(scale.square().mean() for scale in evidence.dense.log_depth)
        + evidence.dense.log_spread.mean()
        + prediction.points.points.square().mean()
        + prediction.keypoints.logits.logsumexp(1).mean()
        + evidence.confidence.mean()
        + sum((stage**2).mean() for stage in evidence.posterior.stages)
    )
    loss.backward()
    without = [name for name, p in model.named_parameters() if p.grad is None]
    broken = [
        name
        for name, p in model.named_parameters()
        if p.grad is not None and not p.grad.isfinite().all()
    ]
    assert without == []
    assert broken == []


def test_the_small_network_keeps_within_its_budget() -> None:
    count = sum(parameter.numel() for parameter in Deltas(NetworkConfig()).parameters())
    assert count < 3_000_000


def test_encoder_strides_share_the_image_plane() -> None:
    features = EfficientNetLite0().eval()(torch.rand(1, 2, 3, 64, 96))
    assert [feature.shape[-2:] for feature in features] == [
        (32, 48), (32, 48), (16, 24), (8, 12), (4, 6)
    ]  # fmt: skip


@given(count=st.integers(8, 600), height=st.integers(16, 300), width=st.integers(16, 300))
def test_spread_points_are_inside_and_leave_no_large_hole(
    count: int, height: int, width: int
) -> None:
    points = spread_points(count, image_size=(height, width))
    assert points.shape == (count, 2)
    assert (points >= 0).all()
    assert (points[:, 0] <= width - 1).all()
    assert (points[:, 1] <= height - 1).all()
    # No square of four times a point's fair share is empty.
    side = 2 * count**-0.5
    unit = points / torch.tensor([width, height])
    corners = torch.cartesian_prod(torch.linspace(0, 1 - side, 8), torch.linspace(0, 1 - side, 8))
    if side < 1:
        inside = (unit[None] >= corners[:, None] - 0.05) & (
            unit[None] <= corners[:, None] + side + 0.05
        )
        assert inside.all(-1).any(-1).all()


def test_heatmap_puts_channels_row_by_row() -> None:
    logits = torch.full((1, 65, 2, 3), -9.0)
    logits[0, 8 * 3 + 5, 1, 2] = 9.0  # row 3, column 5 of the cell at row 1, column 2
    heatmap = detector_heatmap(logits, image_size=(16, 24))
    assert heatmap.flatten().argmax() == (8 + 3) * 24 + 16 + 5


def test_interpolation_of_a_constant_is_the_constant() -> None:
    depth = torch.zeros(1, 1, 40, 56)
    depth[0, 0, ::9, ::7] = 3.0
    filled = interpolate_sparse(SparseDepth(depth, (depth > 0).float()))
    torch.testing.assert_close(filled.log_depth.exp(), torch.full((1, 1, 10, 14), 3.0))
    assert (filled.deviation < 0.01).all()


def test_interpolation_without_points_is_the_fallback() -> None:
    empty = torch.zeros(1, 1, 40, 56)
    filled = interpolate_sparse(SparseDepth(empty, empty), fallback=2.0)
    torch.testing.assert_close(filled.log_depth.exp(), torch.full((1, 1, 10, 14), 2.0))


@given(scale=st.floats(0.1, 10.0))
def test_interpolation_is_equivariant_to_the_unit_of_depth(scale: float) -> None:
    random = torch.Generator().manual_seed(0)
    depth = torch.rand(1, 1, 40, 56, generator=random) + 1
    weight = (torch.rand(1, 1, 40, 56, generator=random) < 0.05).float()
    one = interpolate_sparse(SparseDepth(depth * weight, weight))
    other = interpolate_sparse(SparseDepth(scale * depth * weight, weight))
    shift = torch.tensor(scale).log()
    torch.testing.assert_close(other.log_depth, one.log_depth + shift, rtol=0, atol=1e-4)


def test_exchange_without_learned_correction_sharpens_agreement() -> None:
    torch.manual_seed(0)
    context = Context(8, rounds=2, heads=2).eval()
    logits = torch.zeros(1, 6, 16)
    logits[..., 4] = 2.0
    logits[0, 0, 11] = 2.5  # one point prefers another depth than all its neighbours
    stages = context(logits, torch.zeros(1, 6, 8), torch.rand(1, 6, 2)).stages
    assert stages[0][0, 0].argmax() == 11
    assert stages[-1][0, 0].argmax() == 4


def test_rounds_beyond_the_second_start_as_the_identity_and_learn() -> None:
    torch.manual_seed(0)
    context = Context(8, rounds=4, heads=2).eval()
    stages, embedding = context(torch.randn(2, 6, 16), torch.randn(2, 6, 8), torch.rand(2, 6, 2))
    assert embedding.shape == (2, 6, 64)
    assert len(stages) == 5
    assert not torch.equal(stages[1], stages[0]) and not torch.equal(stages[2], stages[1])
    assert torch.equal(stages[3], stages[2]) and torch.equal(stages[4], stages[3])
    stages[-1].square().sum().backward()
    for further in context.rounds[2:]:
        gain = further.get_parameter("gain")
        assert gain.grad is not None and (gain.grad != 0).all()


def test_another_way_to_say_how_many_samples_gives_the_same_depth(
    images: Tensor, room: PosedImages
) -> None:
    model = make_model()
    with torch.no_grad():
        usual, roomy = model(images, room.views), model(images, room.views, refinement=8)
    torch.testing.assert_close(roomy.depth, usual.depth, rtol=0, atol=1e-5)
    with pytest.raises(ValueError, match="refinement must be at least 1"):
        model(images, room.views, refinement=0)


def test_the_detectors_fine_branch_starts_as_no_correction_and_then_moves_points_alone() -> None:
    config = NetworkConfig(detector=DetectorConfig(fine_width=8))
    torch.manual_seed(0)
    model = Deltas(config).eval()
    features = model.encoder(torch.rand(1, 1, 3, 50, 70))  # neither side a multiple of 8
    with torch.no_grad():
        before = model.detector(features, image_size=(50, 70)).logits
        assert model.detector.fine is not None
        plain, model.detector.fine = model.detector.fine, None
        assert torch.equal(before, model.detector(features, image_size=(50, 70)).logits)
        model.detector.fine = plain
        torch.nn.init.ones_(plain.convs[-1].weight)
        after = model.detector(features, image_size=(50, 70)).logits
    assert after.shape == before.shape and not torch.equal(after[:, :-1], before[:, :-1])
    assert torch.equal(after[:, -1], before[:, -1])
