"""How large the network sees the images of a capture: a trial on a few of its frames decides.

Larger images show finer texture, and less of the scene to what looks at so many pixels. Which
counts for more depends on the capture, and the network's own confidence tells it; see decision 26.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.spread import spread
from deltas_nets.captures.straight import straight
from deltas_nets.captures.view_sets import ViewSet
from deltas_nets.check.workers import side_by_side
from deltas_nets.predict.depth_map import PredictConfig
from deltas_nets.predict.ours import work_size_of
from deltas_nets.predict.passes import SMALL
from deltas_nets.predict.predictor import Predictor
from deltas_nets.predict.search import Found, Search

__all__ = ["LARGE_PIXELS", "TRIED", "surer", "surest_config", "with_larger_images"]

LARGE_PIXELS = 310_000
"""Pixels of an image of 480 x 640, and a few more for other aspect ratios."""
TRIED = 6
"""View sets at most, spread over the capture."""
AS_SURE = 0.01
"""Confidence by which larger images may be behind: on rooms they are as good there."""


def surest_config(
    predictor: Predictor,
    capture: Capture,
    view_sets: Sequence[ViewSet],
    config: PredictConfig,
    search: Search,
    *,
    threads: int = 1,
    report: Callable[[str], None] = lambda _: None,
) -> PredictConfig:
    """The config, with larger images if the network is as sure of them.

    Args:
        predictor: of a trained network.
        capture: the frames.
        view_sets: all anchors and sources; the choice must not depend on which are wanted now.
        config: what is asked for; a work size that it states is kept.
        search: how depth is searched.
        threads: maps computed at once.
        report: called with the id of every frame that was tried.

    Raises:
        UserError: an image cannot be read.
    """
    larger = with_larger_images(config)
    few = spread(view_sets, TRIED)

    def grows(views: ViewSet) -> bool:
        frame = straight(capture.frame(views.anchor))
        return work_size_of(frame, config) != work_size_of(frame, larger)

    if not predictor.takes_larger or not any(map(grows, few)):
        return config

    def gain(views: ViewSet) -> float:
        usual, large = (
            _confidence(search(predictor, views, replace(each, size=SMALL)))
            for each in (config, larger)
        )
        report(views.anchor)
        return large - usual

    return surer(config, list(side_by_side(gain, few, threads)))


def with_larger_images(config: PredictConfig) -> PredictConfig:
    """What is compared with the config."""
    return replace(config, work_pixels=LARGE_PIXELS)


def surer(config: PredictConfig, gains: Sequence[float]) -> PredictConfig:
    """The config, with larger images if their maps are as sure.

    Args:
        config: without them.
        gains: by how much the mean confidence of each map that was tried is higher with them.

    Example:
        >>> surer(PredictConfig(), [0.03, -0.02]).work_pixels == LARGE_PIXELS
        True
        >>> surer(PredictConfig(), [-0.02]) == PredictConfig()
        True
    """
    return with_larger_images(config) if sum(gains) / len(gains) >= -AS_SURE else config


def _confidence(found: Found) -> float:
    assert found.map.work is not None  # the network states a deviation
    return float(found.map.work.confidence().mean())
