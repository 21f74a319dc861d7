"""The paper's networks as configurations of the same method."""

import dataclasses

import pytest
import torch
from torch import Tensor

from deltas_geom import PosedViews
from deltas_nets.config import CONFIGS, PAPER_LOSS, MatcherConfig, NetworkConfig, from_dict, to_dict
from deltas_nets.losses.losses import training_losses
from deltas_nets.network.deltas import Deltas

PAPER = ["deltas-vgg9", "deltas-resnet50"]


def scene(*batch: int, num_views: int = 3) -> tuple[Tensor, PosedViews]:
    random = torch.Generator().manual_seed(0)
    images = torch.rand(*batch, num_views, 3, 48, 80, generator=random)
    K = torch.tensor([[60.0, 0, 40], [0, 60, 24], [0, 0, 1]]).expand(*batch, num_views, 3, 3)
    pose = torch.eye(4).repeat(*batch, num_views, 1, 1)
    pose[..., 0, 3] = -0.15 * torch.arange(num_views)
    return images, PosedViews(K, pose)


@pytest.mark.parametrize("name", PAPER)
def test_a_config_survives_its_record(name: str) -> None:
    assert from_dict(NetworkConfig, to_dict(CONFIGS[name])) == CONFIGS[name]


@pytest.mark.parametrize("name", PAPER)
def test_every_weight_learns_from_the_papers_losses(name: str) -> None:
    torch.manual_seed(0)
    model = Deltas(CONFIGS[name]).train()
    images, cameras = scene(1)
    depth = 1.5 + torch.rand(1, 3, 48, 80)
    prediction = model(images, cameras, num_keypoints=64)
    config = dataclasses.replace(PAPER_LOSS, spread=0.1)  # or the spread's layer would not
    losses = training_losses(prediction, images, cameras, depth, config, depth_range=(0.5, 10.0))
    losses.total.backward()  # type: ignore[no-untyped-call]
    assert losses.total.isfinite()
    lost = [n for n, p in model.named_parameters() if p.grad is None or not p.grad.isfinite().all()]
    assert lost == []


def test_views_and_batches_are_as_each_alone() -> None:
    torch.manual_seed(0)
    model = Deltas(CONFIGS["deltas-vgg9"]).eval()
    images, cameras = scene(2, num_views=2)
    with torch.no_grad():
        both = model(images, cameras, num_keypoints=64)
        one = model(images[1], PosedViews(*(t[1] for t in cameras)), num_keypoints=64)
    torch.testing.assert_close(both.depth[1], one.depth, rtol=1e-3, atol=1e-3)
    assert torch.equal(both.keypoints.pixels[1], one.keypoints.pixels)
    assert one.depth.shape == one.std.shape == (1, 48, 80) and (one.depth > 0).all()


def test_sources_change_the_matches_and_only_the_anchor_the_keypoints() -> None:
    torch.manual_seed(0)
    model = Deltas(CONFIGS["deltas-vgg9"]).eval()
    images, cameras = scene(num_views=2)
    other = images.clone()
    other[1] = other[1].flip(-1)
    with torch.no_grad():
        first, second = (model(i, cameras, num_keypoints=64) for i in (images, other))
    assert torch.equal(first.keypoints.pixels, second.keypoints.pixels)
    assert not torch.equal(first.matches.pixels[1], second.matches.pixels[1])


def test_impossible_configs_are_refused() -> None:
    with pytest.raises(ValueError, match="joint matcher needs the lite backbone"):
        dataclasses.replace(CONFIGS["deltas-vgg9"], matcher=MatcherConfig())
    with pytest.raises(ValueError, match="densifier_widths must be 5"):
        dataclasses.replace(CONFIGS["deltas-resnet50"], densifier_widths=(1, 2, 3, 4))
