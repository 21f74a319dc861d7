"""Descriptors: resolution, unit length, and the names that shipped weights rely on."""

from typing import Literal

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from deltas_geom import PosedViews
from deltas_nets.config import CONFIGS, NetworkConfig
from deltas_nets.network.deltas import Deltas
from deltas_nets.network.lite.descriptor import WIDTH, Descriptor
from deltas_nets.network.lite.efficientnet import EfficientNetLite0
from deltas_nets.rooms import render_room
from deltas_nets.weights_file import load_weights, weights_file

STRIDES = (2, 4)
Stride = Literal[2, 4]


@pytest.fixture(scope="module")
def encoder() -> EfficientNetLite0:
    torch.manual_seed(0)
    return EfficientNetLite0().eval()


@given(stride=st.sampled_from(STRIDES), height=st.integers(20, 70), width=st.integers(20, 70))
def test_descriptors_have_their_stride_and_unit_length(
    encoder: EfficientNetLite0, stride: Stride, height: int, width: int
) -> None:
    with torch.no_grad():
        features = encoder(torch.rand(1, 2, 3, height, width))
        descriptors = Descriptor(24, EfficientNetLite0.channels, stride).eval()(features)
    assert descriptors.maps.shape == (1, 2, 24, -(-height // stride), -(-width // stride))
    assert descriptors.context.shape == (1, 2, WIDTH, -(-height // 8), -(-width // 8))
    length = torch.linalg.vector_norm(descriptors.maps, dim=2)
    torch.testing.assert_close(length, torch.ones_like(length), rtol=0, atol=1e-5)


@pytest.mark.parametrize("stride", STRIDES)
def test_every_weight_of_a_descriptor_learns(encoder: EfficientNetLite0, stride: Stride) -> None:
    descriptor = Descriptor(24, EfficientNetLite0.channels, stride)
    maps, context = descriptor(encoder(torch.rand(1, 2, 3, 32, 48)))
    (maps[:, 0].sum() + context.sum()).backward()
    assert [name for name, weight in descriptor.named_parameters() if weight.grad is None] == []


def test_the_shipped_weights_fit_descriptors_at_half_resolution() -> None:
    load_weights(
        Deltas(NetworkConfig(descriptor_stride=2, redraws=True)), weights_file("deltas-small")
    )


@pytest.mark.parametrize("stride", STRIDES)
def test_a_network_finds_depth_by_descriptors_of_either_stride(stride: Stride) -> None:
    torch.manual_seed(0)
    room = render_room(3, num_views=2, image_size=(48, 64))
    model = Deltas(NetworkConfig(descriptor_stride=stride)).eval()
    with torch.no_grad():
        prediction = model(
            room.images[None].float() / 255, PosedViews(*(t[None] for t in room.views))
        )
    assert prediction.depth.shape == (1, 1, 48, 64)
    assert prediction.depth.isfinite().all() and (prediction.points.valid).any()


def test_only_the_lite_backbone_has_a_choice() -> None:
    paper = CONFIGS["deltas-vgg9"]
    with pytest.raises(ValueError, match="descriptor_stride is of the lite backbone"):
        NetworkConfig(
            backbone="vgg9",
            matcher=paper.matcher,
            densifier_widths=paper.densifier_widths,
            descriptor_stride=4,
        )
