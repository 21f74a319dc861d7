"""Points that listen to each other: attention written out, and what it must never do."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch.testing import assert_close

from deltas_nets.network.joint.context import Context, _Round

SAMPLES = 16


def listening_round(seed: int = 0) -> _Round:
    """With weights that all do something."""
    torch.manual_seed(seed)
    exchange = _Round(64, heads=4, gain=0.2).double()
    for parameter in exchange.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    return exchange


def points_of(count: int, seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """Logits, embeddings and positions of a batch of two."""
    random = torch.Generator().manual_seed(seed)

    def draw(*shape: int) -> Tensor:
        return torch.randn(2, count, *shape, generator=random, dtype=torch.float64)

    return draw(SAMPLES), draw(64), 0.5 + 0.2 * draw(2)


def itself(count: int) -> Tensor:
    return -1e4 * torch.eye(count, dtype=torch.float64)


def written_out(exchange: _Round, points: Tensor, positions: Tensor) -> Tensor:
    """Query by key, less the squared distance by the reach, plus trust; nobody hears itself."""
    query = exchange.query(points).unflatten(-1, (exchange.heads, 16))
    key = exchange.key(points).unflatten(-1, (exchange.heads, 16))
    logits = torch.einsum("bnhd,bmhd->bhnm", query, key) / 4
    squared = (positions[:, :, None] - positions[:, None]).square().sum(dim=-1)
    logits = logits - squared[:, None] / exchange.log_reach.exp().square()[:, None, None]
    logits = logits + exchange.trust(points).mT[:, :, None]
    own = torch.eye(points.shape[1], dtype=torch.bool)
    return logits.masked_fill(own, -torch.inf).softmax(dim=-1)


@given(count=st.integers(2, 9), seed=st.integers(0, 99))
def test_attention_is_what_its_formula_says(count: int, seed: int) -> None:
    exchange = listening_round(seed)
    _, points, positions = points_of(count, seed)
    found = exchange.attention(points, positions, itself(count))
    assert_close(found, written_out(exchange, points, positions))


def test_attention_in_single_precision_at_the_shortest_reach() -> None:
    exchange = listening_round()
    exchange.log_reach.data.fill_(-3.0)  # 5 % of the image's width
    _, points, positions = points_of(40)
    wanted = written_out(exchange, points, positions)
    found = exchange.float().attention(points.float(), positions.float(), itself(40).float())
    assert_close(found.double(), wanted, rtol=0, atol=1e-4)


def test_points_however_far_apart_are_told_finite_things_and_never_by_themselves() -> None:
    exchange = listening_round()
    _, points, _ = points_of(6)
    positions = 1e3 * torch.arange(12, dtype=torch.float64).view(1, 6, 2).expand(2, -1, -1)
    found = exchange.attention(points, positions, itself(6))
    assert found.isfinite().all()
    assert found.diagonal(dim1=-2, dim2=-1).max() == 0
    assert_close(found.sum(dim=-1), torch.ones_like(found[..., 0]))


def test_attention_has_no_numbers_that_slow_processors_down() -> None:
    exchange = listening_round().float()
    exchange.log_reach.data.fill_(-2.5)
    _, points, positions = points_of(40)
    found = exchange.attention(points.float(), positions.float(), itself(40).float())
    assert not ((found > 0) & (found < torch.finfo(torch.float32).tiny)).any()


def test_what_a_point_believes_does_not_come_back_to_it() -> None:
    exchange = listening_round()
    torch.nn.init.zeros_(exchange.mix[-1].weight)
    torch.nn.init.zeros_(exchange.mix[-1].bias)
    logits, points, positions = points_of(5)
    apart = itself(5)
    told = exchange(logits, points, positions, apart) - logits
    logits[:, 2] = torch.randn(SAMPLES, dtype=torch.float64)
    again = exchange(logits, points, positions, apart) - logits
    assert_close(again[:, 2], told[:, 2])
    assert not torch.allclose(again[:, 3], told[:, 3])


def test_a_point_alone_is_told_something_finite() -> None:
    logits, points, positions = points_of(1)
    for tensor in (logits, points, positions):
        tensor.requires_grad_()
    updated = listening_round()(logits, points, positions, itself(1))
    updated.square().sum().backward()
    assert updated.isfinite().all()
    assert logits.grad is not None and logits.grad.isfinite().all()


@pytest.mark.parametrize("peak", [0.0, 200.0])
def test_nobody_can_rule_a_depth_out(peak: float) -> None:
    # Told by all that it is certain of one depth, a point keeps its own evidence for another.
    exchange = listening_round()
    torch.nn.init.zeros_(exchange.mix[-1].weight)
    torch.nn.init.zeros_(exchange.mix[-1].bias)
    exchange.gain.data.fill_(0.25)
    logits, points, positions = points_of(6)
    apart = itself(6)
    logits[:, :, 3] += peak
    change = exchange(logits, points, positions, apart) - logits
    assert change.min() >= 0
    assert change.max() <= math.log(1 / 3e-3 + 1) + 1e-9


def test_rounds_follow_each_other_from_the_given_logits() -> None:
    torch.manual_seed(0)
    context = Context(10, rounds=3, heads=4).double()
    logits, points, positions = points_of(7)
    stages, embedding = context(logits, points[..., :10], positions)
    assert len(stages) == 4 and stages[0] is logits
    assert embedding.shape == (2, 7, 64)
    assert_close(stages[2], context.rounds[1](stages[1], embedding, positions, itself(7)))
    assert_close(stages[3], stages[2])  # a third round begins as the identity
