"""Table 1 on the view sets of a capture with depth."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.frame import Frame
from deltas_nets.captures.view_sets import ViewSet
from deltas_nets.captures.work_size import anchor_views, depth_at_image, fit_work_size, load_image
from deltas_nets.errors import UserError
from deltas_nets.evaluate.detectors.config import WORK_PIXELS, TableConfig
from deltas_nets.evaluate.detectors.features import Features
from deltas_nets.evaluate.detectors.registry import NamedExtractor
from deltas_nets.evaluate.detectors.scores import DetectorScores, PairScores, pool, score_pair

__all__ = ["pairs_of", "score_capture"]


def pairs_of(capture: Capture, view_sets: Sequence[ViewSet]) -> list[tuple[str, str]]:
    """Every anchor with each of its sources, where both have sensor depth.

    Raises:
        UserError: there is no such pair, or an image was taken through a lens that bends lines.
    """
    pairs = [(views.anchor, source) for views in view_sets for source in views.sources]
    pairs = [p for p in pairs if all(capture.frame(id).depth_path is not None for id in p)]
    if not pairs:
        raise UserError("no two views with sensor depth", capture.path, "add depth/N.png")
    for id in dict.fromkeys(id for pair in pairs for id in pair):
        if capture.frame(id).lens is not None:
            what = "detectors are compared on images without distortion"
            raise UserError(what, capture.frame(id).image_path, "name an undistorted capture")
    return pairs


@torch.inference_mode()
def score_capture(
    extractors: Sequence[NamedExtractor],
    capture: Capture,
    pairs: Sequence[tuple[str, str]],
    config: TableConfig,
    *,
    report: Callable[[str], None] = lambda _: None,
) -> dict[str, DetectorScores]:
    """Every detector on every pair, by name.

    Args:
        extractors: the detectors.
        capture: frames with sensor depth.
        pairs: ids, from :func:`pairs_of`.
        config: the protocol.
        report: called with the ids of every finished pair.

    Raises:
        UserError: an image or depth cannot be read.
    """
    work_size = config.work_size or fit_work_size(
        capture.frame(pairs[0][0]).image_size, max_pixels=WORK_PIXELS
    )
    seen = _Seen(extractors, work_size, config)
    scored: dict[str, list[PairScores]] = {one.name: [] for one in extractors}
    last = {id: number for number, pair in enumerate(pairs) for id in pair}
    for number, pair in enumerate(pairs):
        frames = [capture.frame(id) for id in pair]
        views = anchor_views(frames, work_size=work_size)
        depth = torch.stack([seen.depth(frame) for frame in frames])
        for name, scores in scored.items():
            first, second = (seen.features(name, frame) for frame in frames)
            scores.append(
                score_pair(
                    views,
                    depth,
                    first,
                    second,
                    tolerance=config.tolerance,
                    consensus=config.pnp,
                )
            )
        seen.forget([id for id in pair if last[id] == number])
        report(" ".join(pair))
    return {name: pool(scores, seen.mean_points(name)) for name, scores in scored.items()}


class _Seen:
    """Features and depth of frames, found once each and kept until they are not needed."""

    def __init__(
        self, extractors: Sequence[NamedExtractor], size: tuple[int, int], config: TableConfig
    ) -> None:
        self._extractors = {one.name: one.extract for one in extractors}
        self._size, self._config = size, config
        self._features: dict[tuple[str, str], Features] = {}
        self._depth: dict[str, Tensor] = {}
        self._points: dict[str, list[int]] = {one.name: [] for one in extractors}

    def features(self, name: str, frame: Frame) -> Features:
        """Of one detector on one frame."""
        key = (name, frame.id)
        if key not in self._features:
            image = load_image(frame, work_size=self._size)
            self._features[key] = self._extractors[name](image, self._config.detection)
            self._points[name].append(len(self._features[key].pixels))
        return self._features[key]

    def depth(self, frame: Frame) -> Tensor:
        """``(H, W)`` metres."""
        if frame.id not in self._depth:
            depth = depth_at_image(frame, work_size=self._size)
            self._depth[frame.id] = torch.from_numpy(depth)
        return self._depth[frame.id]

    def mean_points(self, name: str) -> float:
        """In an image."""
        return sum(self._points[name]) / len(self._points[name])

    def forget(self, ids: Sequence[str]) -> None:
        """Frames that no pair needs any more: a capture may have thousands."""
        for id in set(ids):
            self._depth.pop(id, None)
            for name in self._extractors:
                self._features.pop((name, id), None)
