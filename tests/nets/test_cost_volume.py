"""The cost-volume network: its volume, its face, and that the training code trains it."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from run_command import Run
from run_fit import CONFIG, logged, read_checkpoint, train
from torch import Tensor
from torch.testing import assert_close

from deltas_geom import PosedViews, ShapeError, project, unproject
from deltas_nets.captures.posed_images import PosedImages
from deltas_nets.config import (
    CONFIGS,
    LOSS_FUNCTIONS,
    TRAIN_CONFIGS,
    MatcherConfig,
    NetworkConfig,
    TrainConfig,
)
from deltas_nets.errors import UserError
from deltas_nets.losses.losses import training_losses
from deltas_nets.network.cost_volume.network import CostVolume
from deltas_nets.network.cost_volume.volume import difference_volume
from deltas_nets.network.deltas import Deltas
from deltas_nets.network.networks import build_network
from deltas_nets.predict.dense import DensePredictor
from deltas_nets.predict.predictor import load_predictor
from deltas_nets.rooms import render_room
from deltas_nets.train.start import Start
from deltas_nets.train.step import unreached
from deltas_nets.weights_file import load_model, load_network, save_weights

SIZE = (48, 64)
SMALL = replace(
    CONFIGS["cost-volume"],
    matcher=MatcherConfig(kind="volume", num_samples=16),
    densifier_widths=(8, 16, 16, 24),
)


@pytest.fixture(scope="module")
def room() -> PosedImages:
    return render_room(5000, num_views=3, image_size=SIZE)


@pytest.fixture(scope="module")
def images(room: PosedImages) -> Tensor:
    return room.images.float() / 255


@pytest.fixture(scope="module")
def model() -> CostVolume:
    torch.manual_seed(0)
    return CostVolume(SMALL).eval()


def of_one(room: PosedImages) -> PosedViews:
    return PosedViews(*(tensor[None] for tensor in room.views))


@pytest.mark.parametrize(
    ("shape", "words"),
    [((1, 3, *SIZE), "at least one source"), ((0, 3, 3, *SIZE), "must not be empty")],
    ids=str,
)
def test_images_that_make_no_view_set_are_an_error_in_words(
    model: CostVolume, room: PosedImages, shape: tuple[int, ...], words: str
) -> None:
    with pytest.raises(ShapeError, match=words):
        model(torch.zeros(shape), room.views.select(list(range(shape[-4]))))


def test_the_volume_is_what_each_pixel_of_each_plane_says(room: PosedImages) -> None:
    """Beside projections of some points into the sources, whose features are their x."""
    views, inv_depths = of_one(room), torch.tensor([0.3, 0.6, 1.2])
    maps = torch.linspace(0, 1, SIZE[1]).expand(1, 3, 2, *SIZE)  # x, whatever the view
    found = difference_volume(maps, views, inv_depths, image_size=SIZE)[0]
    assert found.shape == (3, *SIZE)
    looked_at = 0
    for plane, row, column in ((0, 24, 30), (1, 10, 20), (2, 30, 40), (1, 24, 32)):
        pixel = torch.tensor([[[float(column), float(row)]]])
        point = unproject(room.views.select([0]), pixel, 1 / inv_depths[plane].reshape(1, 1))[0]
        there = project(room.views, point).pixels[1:, 0]
        inside = (there > -0.5).all(-1) & (there < torch.tensor([63.5, 47.5])).all(-1)
        if inside.any():
            x = there[inside, 0].clamp(0, 63)
            expected = ((x - column).abs() / 63).mean()
            assert_close(found[plane, row, column], expected, rtol=1e-3, atol=1e-4)
            looked_at += 1
    assert looked_at >= 2


def test_a_plane_that_no_source_sees_is_the_worst_of_its_pixel(room: PosedImages) -> None:
    random = torch.Generator().manual_seed(0)
    maps = torch.rand(1, 3, 4, *SIZE, generator=random)
    inv_depths = torch.tensor([0.2, 0.5, 50.0])  # 2 cm: far outside of the sources
    found = difference_volume(maps, of_one(room), inv_depths, image_size=SIZE)[0]
    assert_close(found[2], found[:2].amax(dim=0))


def test_a_map_without_points_is_a_prediction_like_others(
    model: CostVolume, images: Tensor, room: PosedImages
) -> None:
    with torch.no_grad():
        prediction = model(images, room.views)
    assert prediction.depth.shape == prediction.std.shape == (1, *SIZE)
    assert prediction.depth.isfinite().all() and (prediction.depth > 0).all()
    assert (prediction.std > 0).all()
    assert prediction.keypoints.pixels.shape == (0, 2)
    assert prediction.matches.pixels.shape == (3, 0, 2)
    assert prediction.sparse.weight.eq(0).all()
    assert [scale.shape[-2:] for scale in prediction.evidence.dense.log_depth] == [
        SIZE,
        (12, 16),
        (6, 8),
        (3, 4),
    ]
    # Untrained, the coarse scales are in the middle of the inverse depths, 0.1 to 2 1/m.
    for scale in prediction.evidence.dense.log_depth[2:]:
        assert_close(scale.exp(), torch.full_like(scale, 1 / 1.05))
    spread = prediction.evidence.dense.log_spread.exp() * 2**0.5  # of a Laplace distribution
    assert_close(prediction.std, prediction.depth * spread)  # not calibrated yet


def test_sources_in_another_order_and_another_world_give_the_same_depth(
    model: CostVolume, images: Tensor, room: PosedImages
) -> None:
    moved = torch.eye(4)
    moved[:3, :3] = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    moved[:3, 3] = torch.tensor([3.0, -2, 5])
    views = room.views._replace(cam_from_world=room.views.cam_from_world @ moved)
    order = [0, 2, 1]
    with torch.no_grad():
        depth = model(images, room.views).depth
        assert_close(model(images[order], views.select(order)).depth, depth, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("size", [(50, 70), (33, 47)])
def test_any_height_and_width_will_do(model: CostVolume, size: tuple[int, int]) -> None:
    room = render_room(1, num_views=2, image_size=size)
    with torch.no_grad():
        depth = model(room.images.float() / 255, room.views).depth
    assert depth.shape == (1, *size) and depth.isfinite().all()


def test_only_the_dense_losses_teach_it_and_they_reach_all_of_it(
    images: Tensor, room: PosedImages
) -> None:
    config = TrainConfig(network=SMALL, loss=TRAIN_CONFIGS["cost-volume"].loss, sizes=(SIZE,))
    torch.manual_seed(0)
    model = CostVolume(SMALL)
    prediction = model(images[None], of_one(room))
    losses = training_losses(
        prediction, images[None], of_one(room), room.depth[None], config.loss, depth_range=(0.5, 10)
    )
    taught = {name for name, term in losses.terms.items() if term.requires_grad}
    assert taught == {"smoothness", "depth", "gradient", "spread"}
    assert taught == {name for name in LOSS_FUNCTIONS if getattr(config.loss, name) > 0}
    silent = losses.terms.keys() - taught - {"detector"}
    assert all(losses.terms[name] == 0 for name in silent)
    assert unreached(model, config) == []


def test_the_training_code_trains_it_and_goes_on(tmp_path: Path) -> None:
    config = replace(
        CONFIG, network=SMALL, loss=TRAIN_CONFIGS["cost-volume"].loss, steps=4, batch_size=2
    )
    train(tmp_path / "whole", config, Start())
    train(tmp_path / "parts", config, Start(), stop=3)
    train(tmp_path / "parts", config, Start(resume=True))
    assert logged(tmp_path / "whole")[-1] == logged(tmp_path / "parts")[-1]
    assert read_checkpoint(tmp_path / "parts")["step"] == 4
    loaded = load_network(tmp_path / "whole" / "weights.safetensors")
    assert isinstance(loaded, CostVolume) and loaded.config == SMALL


def test_its_weights_predict_by_the_commands_and_are_refused_where_points_are_needed(
    run: Run, model: CostVolume, tmp_path: Path, make_capture: Callable[..., Path]
) -> None:
    file = tmp_path / "volume.safetensors"
    save_weights(file, model, {"data": "none"})
    assert isinstance(load_predictor(file), DensePredictor)
    flags = ("--weights", file, "--work-size", 48, 64, "--views", 2)
    said = run("evaluate", make_capture(num_frames=2), *flags)
    assert said.code == 0, said.err
    with pytest.raises(UserError, match="cost-volume has no points"):
        load_model(file)
    said = run("export", "--weights", file, "--out", tmp_path / "x.onnx")
    assert said.code == 2


def test_a_config_says_which_network_it_is_of() -> None:
    assert isinstance(build_network(NetworkConfig()), Deltas)
    assert isinstance(build_network(SMALL), CostVolume)
    with pytest.raises(ValueError, match="the volume matcher needs the lite backbone"):
        replace(CONFIGS["deltas-vgg9"], matcher=MatcherConfig(kind="volume"))
