"""A convolution and its batch norm as one, and padding as TensorFlow has it."""

import copy

import pytest
import torch
import torch.nn.functional as F
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor, nn
from torch.testing import assert_close

from deltas_nets.network.conv_norm import Affine, SameConv, conv_norm, with_affine_norms
from deltas_nets.network.layers import ConvBlock, WideRowConv


def trained_norm(channels: int, *, dtype: torch.dtype = torch.float64) -> nn.BatchNorm2d:
    """With statistics, factors and shifts that are all unlike those of a new one."""
    random = torch.Generator().manual_seed(channels)
    norm = nn.BatchNorm2d(channels, eps=1e-3)
    for tensor in (norm.weight.data, norm.bias.data, norm.running_mean, norm.running_var):
        assert tensor is not None
        tensor.copy_(0.3 + torch.rand(channels, generator=random))
    return norm.to(dtype).eval()


def conv_of(groups: int, stride: int) -> nn.Conv2d:
    torch.manual_seed(0)
    return nn.Conv2d(4, 8, 3, stride, padding=1, groups=groups, bias=False).double()


@pytest.mark.parametrize("groups", [1, 4])
@pytest.mark.parametrize("stride", [1, 2])
def test_as_one_they_give_what_one_after_the_other_gives(groups: int, stride: int) -> None:
    conv, norm = conv_of(groups, stride), trained_norm(8)
    x = torch.randn(2, 4, 7, 9, dtype=torch.float64)
    assert_close(conv_norm(x, conv, norm), norm(conv(x)))


def test_gradients_are_those_of_the_two() -> None:
    conv, norm = conv_of(1, 1), trained_norm(8)
    x = torch.randn(2, 4, 5, 6, dtype=torch.float64, requires_grad=True)
    inputs = [x, conv.weight, norm.weight, norm.bias]
    loss, wanted = (y.sin().sum() for y in (conv_norm(x, conv, norm), norm(conv(x))))
    pairs = zip(torch.autograd.grad(loss, inputs), torch.autograd.grad(wanted, inputs), strict=True)
    for found, expected in pairs:
        assert_close(found, expected)


def test_a_norm_in_training_sees_the_batch() -> None:
    conv, norm = conv_of(1, 1), trained_norm(8).train()
    before, other = copy.deepcopy(norm), copy.deepcopy(norm)
    x = torch.randn(2, 4, 5, 6, dtype=torch.float64)
    assert_close(conv_norm(x, conv, norm), other(conv(x)))
    assert_close(norm.running_mean, other.running_mean)
    assert not torch.equal(norm.running_mean, before.running_mean)


def test_half_precision_folds_in_single() -> None:
    block = ConvBlock(3, 8)
    block[1] = trained_norm(8, dtype=torch.float32)
    block.eval()
    half = copy.deepcopy(block).bfloat16()
    x = torch.rand(1, 3, 12, 16)
    found = half(x.bfloat16())
    assert found.dtype == torch.bfloat16
    assert_close(found.float(), block(x), rtol=0.03, atol=0.03)


def padded_as_tensorflow(x: Tensor, conv: nn.Conv2d) -> Tensor:
    """Output i looks at inputs from i times the stride on, minus half of what is missing."""
    missing = [
        max((-(-size // conv.stride[0]) - 1) * conv.stride[0] + conv.kernel_size[0] - size, 0)
        for size in x.shape[-2:]
    ]
    (top, left) = (count // 2 for count in missing)
    padded = F.pad(x, (left, missing[1] - left, top, missing[0] - top))
    return F.conv2d(padded, conv.weight, conv.bias, conv.stride, 0, 1, conv.groups)


@given(
    height=st.integers(1, 11),
    width=st.integers(1, 11),
    kernel=st.sampled_from([1, 3, 5]),
    stride=st.sampled_from([1, 2, 3]),
    groups=st.sampled_from([1, 2]),
)
def test_same_padding_at_any_size(
    height: int, width: int, kernel: int, stride: int, groups: int
) -> None:
    torch.manual_seed(0)
    conv = SameConv(2, 4, kernel, stride, groups=groups).double()
    x = torch.randn(1, 2, height, width, dtype=torch.float64)
    found = conv(x)
    assert found.shape[-2:] == (-(-height // stride), -(-width // stride))
    assert_close(found, padded_as_tensorflow(x, conv))


def test_rows_are_convolved_one_by_one() -> None:
    torch.manual_seed(0)
    layer = WideRowConv(3, 2, 5, padding=2).double()
    maps = torch.randn(2, 3, 4, 9, dtype=torch.float64)
    rows = [F.conv1d(maps[:, :, row], layer.weight, layer.bias, padding=2) for row in range(4)]
    assert_close(layer(maps), torch.stack(rows, dim=2))


def test_a_copy_whose_norms_are_affine_gives_the_same() -> None:
    conv, norm = conv_of(1, 1), trained_norm(8)
    block = ConvBlock(4, 8).double().eval()
    block[0], block[1] = conv, norm
    x = torch.randn(2, 4, 7, 9, dtype=torch.float64)
    copied = with_affine_norms(block)
    assert_close(copied(x), block(x))
    assert block[1] is norm and not any(isinstance(m, nn.BatchNorm2d) for m in copied.modules())
    # Where no convolution is before it, and in half precision.
    assert_close(Affine(norm)(x[:, :1].expand(-1, 8, -1, -1)), norm(x[:, :1].expand(-1, 8, -1, -1)))
    half = trained_norm(8, dtype=torch.bfloat16)
    assert Affine(half)(torch.ones(1, 8, 1, 1, dtype=torch.bfloat16)).dtype == torch.bfloat16
