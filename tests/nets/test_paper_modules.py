"""The paper's network modules: any size, the published names, what each block promises."""

import pytest
import torch
import torch.nn.functional as F
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn
from torch.testing import assert_close
from torch.utils.flop_counter import FlopCounterMode

from deltas_nets.network.paper.dense_pyramid import DensePyramid
from deltas_nets.network.paper.resnet import ResNet50
from deltas_nets.network.paper.sparse_densifier import SparseDensifier, join_taps
from deltas_nets.network.paper.superpoint_head import DescriptorHead, DetectorHead
from deltas_nets.network.paper.taps import Backbone, Taps, imagenet_normalised
from deltas_nets.network.paper.up_projection import (
    SkiplessUpProjection,
    UpProjection,
    enlarge_by_both_axes,
    insert_zeros,
)
from deltas_nets.network.paper.vgg import VGG9

SIZES = st.tuples(st.integers(8, 70), st.integers(8, 70))
MAKERS: dict[str, type[ResNet50] | type[VGG9]] = {"resnet50": ResNet50, "vgg9": VGG9}


class Whole(nn.Module):
    """A narrow network of all parts, of the published one's shape."""

    def __init__(self, make: type[ResNet50] | type[VGG9]) -> None:
        super().__init__()
        self.backbone: Backbone = make(3, 8)
        self.detector = DetectorHead(self.backbone.channels, width=8)
        self.descriptor = DescriptorHead(self.backbone.channels, dim=6, width=8)
        self.densifier = SparseDensifier(make(1, 2), self.backbone.channels, (16, 8, 8, 4, 4))


@pytest.fixture(scope="module", params=MAKERS)
def whole(request: pytest.FixtureRequest) -> Whole:
    torch.manual_seed(0)
    return Whole(MAKERS[request.param]).eval()


@settings(max_examples=15)
@given(size=SIZES)
def test_any_height_and_width(whole: Whole, size: tuple[int, int]) -> None:
    height, width = size
    with torch.no_grad():
        taps = whole.backbone(torch.rand(1, 3, height, width))
        assert tuple(tap.shape[1] for tap in taps) == whole.backbone.channels
        for level, tap in enumerate(taps, start=1):
            assert tap.shape[-2:] == (-(-height // 2**level), -(-width // 2**level))
        cells = (height // 8, width // 8)
        assert whole.detector(taps, image_size=size).logits.shape == (1, 65, *cells)
        unit = whole.descriptor(taps, image_size=size).unit
        assert unit.shape == (1, 6, *cells)
        assert_close(torch.linalg.vector_norm(unit, dim=1), torch.ones(1, *cells))
        depth = whole.densifier(taps, torch.zeros(1, 1, height, width))
        for level, scale in enumerate(depth):
            assert scale.shape == (1, 1, -(-height // 2**level), -(-width // 2**level))


def test_gradients_reach_every_weight_and_the_sparse_depth(whole: Whole) -> None:
    whole.train()
    sparse = torch.rand(2, 1, 72, 104, requires_grad=True)
    taps = whole.backbone(torch.rand(2, 3, 72, 104))
    results = (
        whole.detector(taps, image_size=(72, 104)).logits,
        whole.descriptor(taps, image_size=(72, 104)).unit,
        *whole.densifier(taps, sparse),
    )
    total = sum((result * torch.rand_like(result)).sum() for result in results)
    assert isinstance(total, Tensor)
    total.backward()  # type: ignore[no-untyped-call]
    for name, weight in whole.named_parameters():
        assert weight.grad is not None, name
        # Batch norm takes the mean away, and with it what a bias before it would learn.
        if not name.endswith("bias"):
            assert weight.grad.abs().max() > 0, name
    assert sparse.grad is not None and sparse.grad.abs().max() > 0
    whole.zero_grad()
    whole.eval()


def published_parts() -> dict[str, tuple[nn.Module, ...]]:
    with torch.device("meta"):
        image, depth = ResNet50(3, 64), ResNet50(1, 16)
        densifier = SparseDensifier(depth, image.channels)
        heads = (DetectorHead(image.channels), DescriptorHead(image.channels))
    return {
        "state_dict": (image, *heads),
        "state_dict_depth": (densifier.encoder, densifier.decoder),
    }


def test_names_and_shapes_are_the_published_ones() -> None:
    tables = {
        entry: {
            key: tuple(value.shape) for part in parts for key, value in part.state_dict().items()
        }
        for entry, parts in published_parts().items()
    }
    assert len(tables["state_dict"]) == 357
    assert len(tables["state_dict_depth"]) == 506
    some = {
        "conv1.weight": (64, 3, 7, 7),
        "layer1.0.downsample.0.weight": (256, 64, 1, 1),
        "layer3.5.conv3.weight": (1024, 256, 1, 1),
        "layer4.2.bn3.num_batches_tracked": (),
        "convPa.weight": (256, 2048, 3, 3),
        "bnPb.running_var": (128,),
        "convPc.bias": (65,),
        "convDb.weight": (256, 640, 1, 1),
        "convDd.weight": (128, 576, 1, 1),
    }
    assert {key: tables["state_dict"].get(key) for key in some} == some
    some = {
        "conv1.weight": (16, 1, 7, 7),
        "layer1.0.downsample.0.weight": (64, 16, 1, 1),
        "gud_up_proj_layer1.conv1.weight": (512, 2560, 5, 5),
        "gud_up_proj_layer1.conv1_1.weight": (512, 1792, 3, 3),
        "gud_up_proj_layer4.bn1_1.bias": (64,),
        "gud_up_proj_layer5.sc_conv1.weight": (32, 64, 5, 5),
        "ASPP.daspp_4.conv1.weight": (128, 640, 1, 1),
        "ASPP.convf.weight": (256, 896, 3, 3),
        "conv_final.weight": (1, 32, 3, 3),
        "conv_scale8.weight": (1, 256, 1, 1),
        "conv_scale2.bias": (1,),
    }
    assert {key: tables["state_dict_depth"].get(key) for key in some} == some
    assert "gud_up_proj_layer5.conv1_1.weight" not in tables["state_dict_depth"]


def test_a_state_dict_loads_strictly() -> None:
    for parts in published_parts().values():
        for part in parts:
            empty = {key: torch.empty(value.shape) for key, value in part.state_dict().items()}
            part.load_state_dict(empty, strict=True, assign=True)


def giga_macs(
    make: type[ResNet50] | type[VGG9],
    width: int,
    head_width: int,
    widths: tuple[int, int, int, int, int],
) -> float:
    """Of the convolutions for two images of 240 x 320, both heads on both."""
    with torch.device("meta"), FlopCounterMode(display=False) as counter:
        backbone = make(3, width)
        taps = backbone(torch.empty(2, 3, 240, 320))
        DetectorHead(backbone.channels, head_width)(taps, image_size=(240, 320))
        DescriptorHead(backbone.channels, width=head_width)(taps, image_size=(240, 320))
        densifier = SparseDensifier(make(1, width // 4), backbone.channels, widths)
        densifier(taps.of_first(1), torch.empty(1, 1, 240, 320))
    return float(counter.get_total_flops()) / 2e9


def test_costs_are_the_papers() -> None:
    assert giga_macs(ResNet50, 64, 256, (512, 256, 128, 64, 32)) == pytest.approx(84.36, abs=0.01)
    assert giga_macs(VGG9, 64, 128, (96, 64, 32, 16, 8)) == pytest.approx(16.88, abs=0.01)


def test_images_are_normalised_channel_by_channel() -> None:
    mean_color = torch.tensor([0.485, 0.456, 0.406])[:, None, None].expand(3, 2, 2)
    assert_close(imagenet_normalised(mean_color), torch.zeros(3, 2, 2))
    white = imagenet_normalised(torch.ones(1, 3, 1, 1)).flatten()
    assert_close(white, torch.tensor([0.515 / 0.229, 0.544 / 0.224, 0.594 / 0.225]))


def test_resnet_maps_do_not_depend_on_the_batch(whole: Whole) -> None:
    images = torch.rand(3, 3, 40, 56)
    with torch.no_grad():
        together, alone = whole.backbone(images), whole.backbone(images[1:2])
    for one, other in zip(together.of_first(2), alone, strict=True):
        assert_close(one[1:2], other, rtol=1e-4, atol=1e-5)


@given(size=st.tuples(st.integers(1, 9), st.integers(1, 9)), seed=st.integers(0, 100))
def test_zeros_are_inserted_between_pixels(size: tuple[int, int], seed: int) -> None:
    height, width = size
    shape = (1, 2, -(-height // 2), -(-width // 2))
    x = torch.rand(shape, generator=torch.Generator().manual_seed(seed)) + 1
    enlarged = insert_zeros(x, size)
    assert enlarged.shape == (1, 2, height, width)
    assert torch.equal(enlarged[..., ::2, ::2], x)
    assert (enlarged > 0).sum() == x.numel()


def test_odd_sizes_are_enlarged_by_the_nearest_pixel() -> None:
    x = torch.arange(6.0).view(1, 1, 2, 3)
    assert torch.equal(enlarge_by_both_axes(x, (4, 6)), insert_zeros(x, (4, 6)))
    rows_odd = enlarge_by_both_axes(x, (3, 6))
    assert torch.equal(rows_odd, F.interpolate(x, (3, 6)))
    assert torch.equal(rows_odd[0, 0, :, 0], torch.tensor([0.0, 0.0, 3.0]))
    columns_odd = enlarge_by_both_axes(x, (4, 5))
    assert torch.equal(columns_odd, F.interpolate(x, (4, 5)))


def random_norms(module: nn.Module) -> None:
    for layer in module.modules():
        if isinstance(layer, nn.BatchNorm2d):
            nn.init.normal_(layer.running_mean)  # type: ignore[arg-type]
            nn.init.uniform_(layer.running_var, 0.5, 2)  # type: ignore[arg-type]
            nn.init.normal_(layer.bias)


def test_a_block_without_a_skip_is_two_transposed_convolutions() -> None:
    """Zeros and a convolution are a strided transposed convolution by the mirrored kernel."""
    torch.manual_seed(1)
    block = SkiplessUpProjection(3, 5).eval()
    random_norms(block)
    x = torch.rand(2, 3, 6, 7)

    def transposed(convolution: nn.Conv2d) -> Tensor:
        mirrored = convolution.weight.flip(-1, -2).transpose(0, 1)
        return F.conv_transpose2d(x, mirrored, stride=2, padding=2, output_padding=1)

    inner = F.relu(block.bn1(transposed(block.conv1)))
    shortcut = block.sc_bn1(transposed(block.sc_conv1))
    expected = F.relu(block.bn2(block.conv2(inner)) + shortcut)
    assert_close(block(x, image_size=(12, 14)), expected, rtol=1e-5, atol=1e-5)


def test_a_skip_changes_its_surroundings_only() -> None:
    torch.manual_seed(2)
    block = UpProjection(3, 2, 5).eval()
    x, skip = torch.rand(1, 3, 8, 8), torch.rand(1, 2, 16, 16)
    skip.requires_grad_()
    block(x, skip)[..., 8, 8].sum().backward()
    assert skip.grad is not None
    reached = skip.grad.abs().sum(dim=(0, 1)) > 0
    rows, columns = torch.where(reached)
    assert reached.any()
    assert (rows - 8).abs().max() <= 2 and (columns - 8).abs().max() <= 2  # two 3x3


def test_the_pyramid_sees_as_far_as_its_dilations_add_up() -> None:
    torch.manual_seed(3)
    pyramid = DensePyramid(4, 2).eval()
    x = torch.rand(1, 4, 1, 161, requires_grad=True)
    pyramid(x)[..., 80].sum().backward()
    assert x.grad is not None
    reached = torch.where(x.grad.abs().sum(dim=(0, 1, 2)) > 0)[0]
    # One unit behind the other, and the last convolution.
    assert (reached - 80).abs().max() <= 3 + 6 + 12 + 18 + 24 + 1
    assert (reached - 80).abs().max() > 24 + 1


def test_depth_comes_first_but_at_the_deepest() -> None:
    image = Taps(*(torch.ones(1, 1, 1, 1) for _ in range(5)))
    depth = Taps(*(torch.zeros(1, 1, 1, 1) for _ in range(5)))
    joined = join_taps(image, depth)
    for tap in joined[:-1]:
        assert tap.flatten().tolist() == [0, 1]
    assert joined.deepest.flatten().tolist() == [1, 0]
