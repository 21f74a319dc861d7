"""Frames encoded once, and view sets put together from them."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor
from torch.testing import assert_close

from deltas_geom import PosedViews
from deltas_nets.captures.capture import Frame
from deltas_nets.captures.work_size import load_image, load_views
from deltas_nets.config import CONFIGS, DetectorConfig
from deltas_nets.network.deltas import Deltas
from deltas_nets.network.encoded import Encoded
from deltas_nets.predict.depth_map import PredictConfig
from deltas_nets.predict.encoded_frames import EncodedFrames
from deltas_nets.predict.ours import predict_frame

SIZE = (48, 64)


@pytest.fixture(scope="module")
def model() -> Deltas:
    torch.manual_seed(0)
    return Deltas(CONFIGS["deltas-small"]).eval()


@pytest.fixture
def frames(tmp_path: Path) -> list[Frame]:
    random = np.random.default_rng(0)
    made = []
    for id in range(5):
        path = tmp_path / f"{id}.png"
        Image.fromarray(random.integers(0, 256, (*SIZE, 3), dtype=np.uint8)).save(path)
        pose = np.eye(4)
        pose[0, 3] = -0.1 * id
        K = np.array([[60.0, 0, 31.5], [0, 60, 23.5], [0, 0, 1]])
        made.append(Frame(id, path, SIZE, K, pose))
    return made


class CountingModel(Deltas):
    """Counts the images that it encodes."""

    images = 0

    def encode(self, images: Tensor) -> Encoded:
        self.images += images.shape[1]
        return super().encode(images)


@pytest.mark.parametrize("name", ["deltas-small", "deltas-resnet50", "deltas-vgg9"])
def test_views_taken_apart_and_joined_are_the_views(name: str) -> None:
    model = Deltas(CONFIGS[name]).eval()
    with torch.no_grad():
        encoded = model.encode(torch.rand(1, 3, 3, *SIZE))
    joined = Encoded.joined(encoded.each())
    assert_close(joined, encoded, rtol=0, atol=0)
    turned = Encoded.joined([encoded.each()[view] for view in (2, 0, 1)])
    assert torch.equal(turned.descriptors.maps, encoded.descriptors.maps[:, [2, 0, 1]])
    anchors = zip(turned.features.of_anchor(), encoded.features.each()[2].of_anchor(), strict=True)
    assert all(torch.equal(*pair) for pair in anchors)


@pytest.mark.parametrize("name", ["deltas-small", "deltas-vgg9"])
def test_predicting_from_encoded_images_is_predicting(name: str) -> None:
    detector = dataclasses.replace(DetectorConfig(), num_keypoints=32)
    model = Deltas(dataclasses.replace(CONFIGS[name], detector=detector)).eval()
    images = torch.rand(2, 3, 3, *SIZE)
    K = torch.tensor([[60.0, 0, 31.5], [0, 60, 23.5], [0, 0, 1]]).expand(2, 3, 3, 3)
    pose = torch.eye(4).repeat(2, 3, 1, 1)
    pose[:, 1:, 0, 3] = torch.tensor([0.1, -0.2])
    views = PosedViews(K, pose)
    with torch.no_grad():
        whole = model(images, views)
        parts = model.from_encoded(model.encode(images), views, image_size=SIZE)
    assert torch.equal(whole.depth, parts.depth) and torch.equal(whole.std, parts.std)


def test_every_frame_is_encoded_once(frames: list[Frame]) -> None:
    model = CountingModel(CONFIGS["deltas-small"]).eval()
    remember = EncodedFrames(model)
    for anchor in range(4):
        remember([frames[anchor], frames[anchor + 1], frames[0]], work_size=SIZE)
    assert model.images == 5
    remember(frames[:2], work_size=(32, 48))  # another size is another image
    assert model.images == 7


def test_what_is_remembered_is_the_view_set(model: Deltas, frames: list[Frame]) -> None:
    remember = EncodedFrames(model)
    remember([frames[3], frames[1]], work_size=SIZE)
    order = [frames[1], frames[4], frames[3], frames[1]]  # the anchor may be its own source
    found = remember(order, work_size=SIZE)
    images, _ = load_views(order, work_size=SIZE)
    assert torch.equal(found.images, images)
    with torch.no_grad():
        expected = model.encode(images[None])
    assert_close(found.encoded, expected, rtol=1e-4, atol=1e-5)


def test_the_least_recently_used_frame_goes_first(frames: list[Frame]) -> None:
    model = CountingModel(CONFIGS["deltas-small"]).eval()
    remember = EncodedFrames(model, capacity=2)
    see(remember, frames, 0, 1)
    see(remember, frames, 0, 2)  # 1 is forgotten
    assert model.images == 3
    see(remember, frames, 0, 2)
    assert model.images == 3
    see(remember, frames, 1, 2)
    assert model.images == 4
    see(remember, frames, 0, 1, 2, 3)  # a view set larger than the memory
    assert model.images == 6


def see(remember: EncodedFrames, frames: Sequence[Frame], *ids: int) -> None:
    remember([frames[id] for id in ids], work_size=SIZE)


def test_a_map_does_not_depend_on_what_was_seen_before(model: Deltas, frames: list[Frame]) -> None:
    config = PredictConfig(work_size=SIZE)
    alone = predict_frame(EncodedFrames(model), frames[:3], config)
    remember = EncodedFrames(model)
    predict_frame(remember, [frames[2], frames[4]], config)
    after = predict_frame(remember, frames[:3], config)
    assert_close(after.map.depth, alone.map.depth, rtol=1e-3, atol=1e-4)


def test_an_image_is_the_files_from_0_to_1(frames: list[Frame]) -> None:
    image = load_image(frames[0], work_size=SIZE)
    assert image.shape == (3, *SIZE) and image.dtype == torch.float32
    assert np.array_equal((image * 255).round().permute(1, 2, 0).numpy(), frames[0].read_image())
