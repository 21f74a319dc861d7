"""What a matcher returns: matches, what they rest on, and how it decided."""

from typing import NamedTuple

from torch import Tensor

from deltas_geom import Matches
from deltas_geom.records import Record


class Posterior(Record):
    """Belief over inverse depth, as the cross-entropy loss wants it.

    Attributes:
        stages: logits ``(B, V-1 or 1, N, S)`` after each round; the last one decides.
        inv_depth: ``(B, V-1 or 1, N, S)`` or broadcastable, 1/m.
        mask: ``(B, V-1 or 1, N, S)`` bool.
    """

    stages: tuple[Tensor, ...]
    inv_depth: Tensor
    mask: Tensor


class Chosen(NamedTuple):
    """The depth that the joint matcher chose, and why; the judge looks at what comes of it.

    Attributes:
        inv_depth: ``(B, N)`` chosen, 1/m.
        logit: ``(B, N)`` of the confidence where a source can see the point at some depth.
        seen: ``(B, N)`` bool, whether one can.
        evidence: ``(B, N, 4)`` what the logit rests on.
        embedding: ``(B, N, 64)`` of the points among each other.
        moved: ``(B, V-1, N)`` how far each source moved its match after that, px.
    """

    inv_depth: Tensor
    logit: Tensor
    seen: Tensor
    evidence: Tensor
    embedding: Tensor
    moved: Tensor


class Matched(NamedTuple):
    """What a matcher found.

    Attributes:
        matches: of all views, ready to triangulate.
        confidence: ``(B, N)`` probability that the depth is right.
        posterior: where it comes from.
        chosen: of the joint matcher; None where each view decides alone.
    """

    matches: Matches
    confidence: Tensor
    posterior: Posterior
    chosen: Chosen | None
