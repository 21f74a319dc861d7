"""Many scenes, scored one after the other; one that fails is counted and does not stop the rest."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.opening import open_capture
from deltas_nets.captures.usable import warn_of, with_depth_only
from deltas_nets.errors import UserError
from deltas_nets.evaluate.calibration import CalibrationMeter
from deltas_nets.evaluate.protocols.view_protocol import SceneViews, ViewProtocol
from deltas_nets.evaluate.scores import CaptureScores, mean_scores
from deltas_nets.terminal import warn

__all__ = ["DatasetScores", "Scorer", "evaluate_scenes"]


class DatasetScores(NamedTuple):
    """What is said of scenes.

    Attributes:
        scenes: of each by name.
        views: the view sets of each.
        failed: why there are no scores, by the names of scenes that failed.
        total: means over the frames of all scenes, each frame as much as any other, and pooled over
            all pixels; ids are SCENE/ID, but where one scene is all that was asked for.
    """

    scenes: Mapping[str, CaptureScores]
    views: Mapping[str, SceneViews]
    failed: Mapping[str, str]
    total: CaptureScores

    @property
    def failures(self) -> int:
        """Frames and scenes that failed."""
        return len(self.failed) + sum(len(scores.failed) for scores in self.scenes.values())


class Scorer(Protocol):
    """Scores the view sets of one scene."""

    def __call__(
        self, name: str, capture: Capture, views: SceneViews, meter: CalibrationMeter
    ) -> CaptureScores:
        """Scores of a scene; the meter takes in what is said of the network's certainty.

        Raises:
            UserError: nothing of the scene can be scored.
        """


def evaluate_scenes(
    scenes: Mapping[str, Path],
    protocol: Callable[[str, Path], ViewProtocol],
    score: Scorer,
    *,
    depth_range: tuple[float, float],
) -> DatasetScores:
    """Open, choose views, and score, scene by scene.

    Args:
        scenes: captures by name.
        protocol: the rule of a scene, by name and path.
        score: one scene.
        depth_range: (near, far) of the search, for a warning where poses are hardly in metres.

    Raises:
        UserError: the only scene fails, or all of many do: what the first said.
    """
    scores: dict[str, CaptureScores] = {}
    views: dict[str, SceneViews] = {}
    failed: dict[str, UserError] = {}
    meter = CalibrationMeter()
    for name, path in scenes.items():
        try:
            capture = open_capture(path).remembering()
            rule = protocol(name, path)
            found = rule.of(capture)
            warn_of(capture, found.view_sets, rule.file or rule.predictions, depth_range)
            found = rule.some_of(with_depth_only(capture, found.view_sets), found.record)
            scores[name], views[name] = score(name, capture, found, meter), found
        except UserError as error:
            failed[name] = error
            if len(scenes) > 1:
                warn(f"{name} is not scored: {error}")
    if not scores:
        raise next(iter(failed.values()))
    reasons = {name: str(error) for name, error in failed.items()}
    return DatasetScores(scores, views, reasons, _total(scores, meter, alone=len(scenes) == 1))


def _total(
    scenes: Mapping[str, CaptureScores], meter: CalibrationMeter, *, alone: bool
) -> CaptureScores:
    if alone:
        return next(iter(scenes.values()))

    def all_of(part: str) -> dict[str, Any]:
        return {
            f"{name}/{id}": value
            for name, scores in scenes.items()
            for id, value in getattr(scores, part).items()
        }

    calibration = None if meter.empty else meter.result()
    metric = all(scores.metric for scores in scenes.values())
    total = mean_scores(all_of("maps"), calibration, failed=all_of("failed"), metric=metric)
    without = [f"{name}/{id}" for name, s in scenes.items() for id in s.without_truth]
    return total._replace(without_truth=tuple(without))
