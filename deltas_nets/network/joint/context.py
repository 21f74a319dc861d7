"""Points exchange evidence about their depth before they decide.

A point alone often has several equally good depths. In each round every point looks at the
posteriors of points that seem to lie on the same surface (attention by features and distance)
and multiplies its own evidence by theirs.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from deltas_nets.network.layers import WideLinear, WideRowConv, zero_initialised

WIDTH = 64
"""Channels of a point's embedding."""
# A neighbour's posterior never rules out a depth altogether.
_FLOOR = 3e-3
# As good as never: softmax makes a normal number of it, and processors take many times as long
# for products of numbers that are smaller.
_UNHEARD = -60.0


class Exchanged(NamedTuple):
    """What points believe after the exchange.

    Attributes:
        stages: logits ``(B, N, S)`` after each round, the given ones first.
        embedding: ``(B, N, 64)`` of the points, by which they chose whom to listen to.
    """

    stages: list[Tensor]
    embedding: Tensor


class Context(nn.Module):
    """Rounds of exchange between the N points of an image."""

    def __init__(self, feature_dim: int, *, rounds: int, heads: int) -> None:
        super().__init__()
        self.embed = nn.Sequential(
            WideLinear(feature_dim + 4, WIDTH), nn.ReLU(), WideLinear(WIDTH, WIDTH)
        )
        # Two rounds listen from the start. Further ones begin as the identity, so that weights from
        # before there were any give the depth they were trained for.
        gains = [0.7 / heads if number < 2 else 0.0 for number in range(rounds)]
        self.rounds = nn.ModuleList([_Round(WIDTH, heads, gain) for gain in gains])

    def forward(self, logits: Tensor, features: Tensor, positions: Tensor) -> Exchanged:
        """Logits after each round, and what the points are to each other.

        Args:
            logits: ``(B, N, S)`` over inverse depth.
            features: ``(B, N, C)`` of the points.
            positions: ``(B, N, 2)`` in image widths.
        """
        probability = logits.softmax(dim=-1)
        entropy = -torch.special.xlogy(probability, probability.clamp_min(1e-9)).sum(-1)
        peak = probability.amax(dim=-1)
        state = torch.stack([entropy, peak], dim=-1)
        points = self.embed(torch.cat([features, state, positions], dim=-1))
        # A point must not confirm itself.
        itself = -1e4 * torch.eye(points.shape[1], dtype=points.dtype, device=points.device)
        stages = [logits]
        for exchange in self.rounds:
            stages.append(exchange(stages[-1], points, positions, itself))
        return Exchanged(stages, points)


class _Round(nn.Module):
    def __init__(self, width: int, heads: int, gain: float) -> None:
        super().__init__()
        self.heads = heads
        self.query = WideLinear(width, 16 * heads)
        self.key = WideLinear(width, 16 * heads)
        self.trust = WideLinear(width, heads)
        # Attention falls off with distance; the heads start from near to far.
        self.log_reach = nn.Parameter(torch.linspace(-2.5, -0.7, heads))
        self.gain = nn.Parameter(torch.full((heads,), gain))
        self.mix = smooth_scores(1 + heads)

    def forward(self, logits: Tensor, points: Tensor, positions: Tensor, itself: Tensor) -> Tensor:
        attention = self.attention(points, positions, itself)
        told = attention.flatten(1, 2) @ logits.softmax(dim=-1)
        evidence = (told.view(*attention.shape[:-1], -1) + _FLOOR).log() - math.log(_FLOOR)
        correction = self.mix(torch.cat([logits[:, None] / 10, evidence], dim=1)).squeeze(1)
        told_in_all = (self.gain[:, None, None] * evidence).sum(dim=1)
        updated: Tensor = logits + told_in_all + 4 * correction
        return updated

    def attention(self, points: Tensor, positions: Tensor, itself: Tensor) -> Tensor:
        """How much each point listens to each other, ``(B, heads, N, N)``; the rows' sums are 1.

        The softmax of q k / 4 - |x - y|^2 / reach^2 + trust + itself, all of it one product in
        which the square is written out.

        Args:
            points: ``(B, N, 64)``.
            positions: ``(B, N, 2)`` in image widths.
            itself: ``(N, N)`` very negative on the diagonal, 0 elsewhere.
        """
        query = self.query(points).unflatten(-1, (self.heads, 16)).transpose(1, 2)
        key = self.key(points).unflatten(-1, (self.heads, 16)).transpose(1, 2)
        trust = self.trust(points).mT.unsqueeze(-1)
        places = (positions - 0.5)[:, None].expand(*query.shape[:-1], 2)
        fall = torch.exp(-2 * self.log_reach)[:, None, None].expand_as(trust)
        squares = places.square().sum(dim=-1, keepdim=True)
        one = torch.ones_like(trust)
        query = torch.cat([query / 4, 2 * fall * places, -fall, -fall * squares, one], dim=-1)
        key = torch.cat([key, places, squares, one, trust], dim=-1)
        product = torch.baddbmm(itself, query.flatten(0, 1), key.flatten(0, 1).mT)
        heard = torch.maximum(product, itself + _UNHEARD)
        return heard.view(*query.shape[:-1], -1).softmax(dim=-1)


def smooth_scores(inputs: int) -> nn.Sequential:
    """A correction of scores by their neighbours along the samples; it is 0 at the start."""
    return nn.Sequential(
        WideRowConv(inputs, 12, 5, padding=2),
        nn.ReLU(),
        zero_initialised(WideRowConv(12, 1, 5, padding=2)),
    )
