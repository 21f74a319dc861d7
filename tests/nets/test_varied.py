"""What the supplement varies: the numbers reach the network, and what it lacks is refused."""

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from reference_tables import random_tables

from deltas_nets import reference
from deltas_nets.captures.capture import Capture
from deltas_nets.config import CONFIGS, NetworkConfig
from deltas_nets.config.varied import NetworkSettings, varied_config
from deltas_nets.errors import UserError
from deltas_nets.network.deltas import Deltas
from deltas_nets.predict.depth_map import PredictConfig, Wanted
from deltas_nets.predict.ours import DeltasPredictor
from deltas_nets.predict.predictor import Predictor, load_predictor
from deltas_nets.predict.reference import ReferencePredictor

WORK = PredictConfig(work_size=(48, 64))
ALL: dict[str, Any] = {
    "num_points": 40,
    "detected_share": 0.0,
    "nms_radius": 1,
    "threshold": 0.9,
    "num_samples": 9,
    "offset": 3.0,
}


@pytest.fixture(scope="module")
def published(tmp_path_factory: pytest.TempPathFactory) -> ReferencePredictor:
    """The reference network with random weights that keep the depth positive."""
    tables = random_tables()
    tables["state_dict_depth"]["conv_final.bias"] = torch.tensor([3.0])
    file = tmp_path_factory.mktemp("published") / "checkpoint.pth.tar"
    torch.save(tables, file)
    return ReferencePredictor(reference.load(file))


@pytest.fixture(scope="module")
def light() -> DeltasPredictor:
    """The paper's light network, untrained; its scores are not all 0."""
    torch.manual_seed(0)
    return DeltasPredictor(Deltas(CONFIGS["deltas-vgg9"]).eval())


def shown(predictor: Predictor, capture: Capture, **settings: Any) -> list[np.ndarray[Any, Any]]:
    """Depth, key points and their depth, of two frames."""
    frames = [capture.frame(0), capture.frame(1)]
    found = predictor.varied(NetworkSettings(**settings)).depth_map(Wanted(frames, WORK))
    points = found.keypoints
    return [found.depth, points.pixels.cpu().numpy(), points.depth.cpu().numpy()]


def differ(first: list[np.ndarray[Any, Any]], second: list[np.ndarray[Any, Any]]) -> bool:
    return any(not np.array_equal(a, b) for a, b in zip(first, second, strict=True))


@given(config=st.sampled_from(list(CONFIGS.values())))
def test_nothing_given_is_the_same_network(config: NetworkConfig) -> None:
    assert varied_config(config, NetworkSettings()) == config


@pytest.mark.parametrize("name", ALL)
def test_every_setting_reaches_the_papers_networks(
    name: str, capture: Capture, light: DeltasPredictor, published: ReferencePredictor
) -> None:
    for predictor in (light, published):
        # All points are detected, so that each setting of the detector has something to change.
        base = {"detected_share": 1.0, "threshold": 0.0, "nms_radius": 3}
        base.pop(name, None)
        assert differ(
            shown(predictor, capture, **base), shown(predictor, capture, **base | {name: ALL[name]})
        ), predictor


def test_the_published_numbers_are_what_is_not_given(
    capture: Capture, published: ReferencePredictor
) -> None:
    asked = NetworkSettings(
        num_points=512,
        detected_share=0.5,
        nms_radius=9,
        threshold=5e-4,
        num_samples=100,
        offset=1.0,
    )
    assert not differ(shown(published, capture), shown(published, capture, **asked.given()))
    assert published.network_record() == published.varied(asked).network_record()
    assert published.varied(NetworkSettings(offset=2)).network_record()["offset"] == 2


@pytest.mark.parametrize("count", [0, 24])
def test_maps_rest_on_as_many_points_as_asked(
    count: int, capture: Capture, light: DeltasPredictor, published: ReferencePredictor
) -> None:
    small = load_predictor("deltas-small")
    for predictor in (small, light, published):
        depth, pixels, _ = shown(predictor, capture, num_points=count)
        assert len(pixels) == count
        assert np.isfinite(depth).all()
        assert (depth > 0).any()


def test_without_points_the_sources_do_not_matter(capture: Capture, light: DeltasPredictor) -> None:
    alone = light.varied(NetworkSettings(num_points=0))
    one, other = (
        alone.depth_map(Wanted([capture.frame(0), capture.frame(source)], WORK)).depth
        for source in (1, 2)
    )
    assert np.array_equal(one, other)
    assert alone.network_record()["without_points"]


def test_the_weights_are_shared_and_chance_is_not_touched(light: DeltasPredictor) -> None:
    torch.manual_seed(3)
    other = light.varied(NetworkSettings(offset=2)).encode.model
    expected = torch.rand(1, generator=torch.Generator().manual_seed(3))
    assert torch.equal(torch.rand(1), expected)
    model = light.encode.model
    assert other.config != model.config
    for mine, theirs in zip(other.parameters(), model.parameters(), strict=True):
        assert mine.data_ptr() == theirs.data_ptr()


def test_what_a_network_lacks_is_named() -> None:
    small = load_predictor("deltas-small")
    with pytest.raises(UserError, match="deltas-small has no such setting, --offset"):
        small.varied(NetworkSettings(offset=2, num_points=64))
    with pytest.raises(UserError, match="plain has no such setting, --num-points, --threshold"):
        NetworkSettings(num_points=0, threshold=0, offset=1).check_known("plain", ["offset"])


@pytest.mark.parametrize(
    "wrong",
    [
        {"num_points": 3},
        {"detected_share": 1.2},
        {"nms_radius": -1},
        {"threshold": 1.0},
        {"num_samples": 2},
        {"offset": float("nan")},
    ],
)
def test_nonsense_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong))):
        NetworkSettings(**wrong)
