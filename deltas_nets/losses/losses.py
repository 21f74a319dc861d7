"""All loss terms, each visible, and their weighted sum.

Which there are, and what they weigh, is in the table of `deltas_nets.config.losses`.
"""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

from torch import Tensor

from deltas_geom import PosedViews
from deltas_nets.config import LOSS_FUNCTIONS, MAP_TERMS, LossConfig
from deltas_nets.config.lookup import look_up
from deltas_nets.losses.divisors import WHOLE, Divisors
from deltas_nets.losses.seen import MapAlone, Seen
from deltas_nets.losses.targets import detector_labels, keypoint_targets
from deltas_nets.network.lite.densifier import DenseDepth
from deltas_nets.network.origin import moved_to_anchor
from deltas_nets.network.prediction import DepthPrediction


class Losses(NamedTuple):
    """What training makes small.

    Attributes:
        terms: scalars without their weights, by name in the order of the table.
        total: their weighted sum, a scalar.
    """

    terms: dict[str, Tensor]
    total: Tensor


@cache
def loss_functions() -> dict[str, Callable[[Any], Tensor]]:
    """The functions that the table names."""
    return {name: look_up("deltas_nets.losses", place) for name, place in LOSS_FUNCTIONS.items()}


def training_losses(
    prediction: DepthPrediction,
    images: Tensor,
    views: PosedViews,
    depth: Tensor,
    config: LossConfig,
    *,
    depth_range: tuple[float, float],
    labels: Tensor | None = None,
    divisors: Divisors = WHOLE,
) -> Losses:
    """All terms for a batch, or for this process's part of one.

    Args:
        prediction: of the network, whose poses may have been noisy.
        images: ``(B, V, 3, H, W)`` as the network saw them.
        views: the true poses.
        depth: ``(B, V, H, W)`` metres, 0 = unknown.
        config: weights of the terms.
        depth_range: as given to the network.
        labels: of the detector, as for :class:`Seen`; Shi-Tomasi corners of the anchors
            if not given.
        divisors: how the number of places that a term is averaged over becomes that of the batch.
    """
    pixels = prediction.keypoints.pixels
    views, origin = moved_to_anchor(views, views.cam_from_world.dtype)
    points = prediction.points._replace(points=prediction.points.points - origin)
    prediction = prediction._replace(points=points)
    seen = Seen(
        prediction,
        images[:, 0],
        depth[:, :1],
        keypoint_targets(views, depth, pixels, depth_range=depth_range),
        detector_labels(images[:, 0]) if labels is None else labels,
        depth_range,
        config.scale_decay,
        divisors,
    )
    return _weighed({name: _term(name, seen) for name in LOSS_FUNCTIONS}, config, depth)


def map_losses(
    dense: DenseDepth,
    images: Tensor,
    depth: Tensor,
    config: LossConfig,
    *,
    depth_range: tuple[float, float],
) -> Losses:
    """The terms of dense maps alone.

    Args:
        dense: maps of B images.
        images: ``(B, 3, H, W)`` as the network saw them.
        depth: ``(B, 1, H, W)`` metres, 0 = unknown.
        config: weights of the terms.
        depth_range: within which the truth counts.
    """
    seen = MapAlone(dense, images, depth, depth_range, config.scale_decay)
    return _weighed({name: _term(name, seen) for name in MAP_TERMS}, config, depth)


def _term(name: str, seen: Seen | MapAlone) -> Tensor:
    """A term, which must be a scalar: anything else fails far from the loss that returned it."""
    term = loss_functions()[name](seen)
    if not isinstance(term, Tensor) or term.shape != ():
        got = f"shape {tuple(term.shape)}" if isinstance(term, Tensor) else type(term).__name__
        place = LOSS_FUNCTIONS[name]
        raise TypeError(f"the loss {name} ({place}) must return a scalar tensor, got {got}")
    return term


def _weighed(terms: dict[str, Tensor], config: LossConfig, like: Tensor) -> Losses:
    weighted = (getattr(config, name) * term for name, term in terms.items())
    return Losses(terms, sum(weighted, like.new_zeros(())))
