"""Hypotheses tried on the evidence."""

from collections.abc import Iterator
from itertools import combinations
from typing import NamedTuple

import torch
from torch import Tensor

from deltas_geom.diagnosis.causes import Cause
from deltas_geom.diagnosis.evidence import Evidence, distances, gather_evidence, residuals
from deltas_geom.diagnosis.hypotheses import Hypothesis, cropped, exchanged, of_all, of_one
from deltas_geom.diagnosis.results import Explanation

_EXACT = 0.02  # px: rounding of float32
_SUSPECTS = 3


class Trial(NamedTuple):
    """A hypothesis and what it makes of every pair.

    Attributes:
        what: the hypothesis; as given, ALL_WELL.
        residual: ``(P)`` px.
        concerned: ``(P)`` bool, the pairs that it changes.
    """

    what: Hypothesis
    residual: Tensor
    concerned: Tensor

    def explanation(self) -> Explanation:
        """In short."""
        cause, cameras, factor, *_ = self.what
        return Explanation(cause, cameras, factor, float(self.residual.mean()))


def tried(what: Hypothesis, evidence: Evidence, given: Trial | None = None) -> Trial:
    """A hypothesis on the evidence; what it leaves alone is taken from ``given``."""
    if given is None or not what.cameras:
        found = residuals(evidence, what.K, what.pose)
        return Trial(what, found, torch.ones_like(found, dtype=torch.bool))
    concerned = evidence.with_camera(*what.cameras)
    found = given.residual.clone()
    found[concerned] = residuals(evidence.of(concerned), what.K, what.pose)
    return Trial(what, found, concerned)


def all_trials(
    given: Trial, evidence: Evidence, pixels: Tensor, seen: Tensor, threshold: float
) -> Iterator[Trial]:
    """Everything tried. Single cameras only where some pair is off: that takes longest."""
    K, pose = given.what.K, given.what.pose
    explained, off = False, float(given.residual.max()) > threshold
    crop = [cropped(K, pose, evidence)] if off else []
    for what in [*_told_apart(of_all(K, pose, evidence)), *crop]:
        trial = tried(what, evidence)
        explained |= explains(given, trial, threshold) and bool(
            (trial.residual <= max(threshold, float(given.residual.mean()) / 10)).all()
        )
        yield trial
    if len(K) == seen.shape[1]:
        turned = gather_evidence(pixels.transpose(0, 1), seen.mT)
        if len(turned.pairs):
            what = Hypothesis(Cause.POINTS_AS_VIEWS, (), None, K, pose)
            alike = torch.full_like(given.residual, float(residuals(turned, K, pose).mean()))
            yield Trial(what, alike, given.concerned)
    # What mends all pairs of many cameras is no single camera's.
    if not off or (explained and len(K) > 3):
        return
    worst = by_camera(given.residual, evidence, len(K)).nan_to_num(-1.0).argsort(descending=True)
    few = range(len(K)) if len(K) <= 6 else sorted(worst[: _SUSPECTS + 1].tolist())
    for one, other in combinations(few, 2):
        yield tried(exchanged(K, pose, one, other), evidence, given)
    for camera in worst[:_SUSPECTS].tolist():
        of_camera = evidence.of(evidence.with_camera(camera))
        if len(of_camera.pairs):
            for what in _told_apart(of_one(K, pose, of_camera, camera)):
                yield tried(what, evidence, given)


def _told_apart(hypotheses: Iterator[Hypothesis]) -> Iterator[Hypothesis]:
    """Without factors next to 1: a lens or a pose that is a little wrong is no other unit."""
    for what in hypotheses:
        if what.cause is Cause.HALF_A_PIXEL or not 0.93 < (what.factor or 0.0) < 1.08:
            yield what


def explains(given: Trial, trial: Trial, threshold: float, *, on: Tensor | None = None) -> bool:
    """Whether a trial leaves so much less than what was given that it is no accident.

    On the pairs ``(P)`` that it concerns, or on others.
    """
    on = trial.concerned if on is None else on
    # All matches of some of many pairs may be wrong; of one camera's few pairs all count.
    of = level if bool(on.all()) else torch.mean
    before, after = float(of(given.residual[on])), float(of(trial.residual[on]))
    if before > threshold and after <= min(0.5 * before, threshold):
        return True
    # However large residuals were, what is left must be what cameras leave that fit.
    enough = after <= min(0.25 * before, threshold) and before - after > 0.5 * threshold
    return enough or (before > _EXACT and after <= min(0.1 * before, threshold))


def share_fitting(trial: Trial, evidence: Evidence, limit: float) -> tuple[float, int]:
    """Which share of the matches that a trial concerns is within ``limit`` px, and of how many.

    Of the best four fifths of pairs, as of :func:`level`.
    """
    concerned = evidence.of(trial.concerned)
    off = distances(concerned, trial.what.K, trial.what.pose)
    shares = (off <= limit).sum(dim=-1) / concerned.counts
    best = shares.argsort(descending=True)[: -(-4 * len(shares) // 5)]
    return float(shares[best].mean()), int(concerned.counts[best].sum())


def level(residual: Tensor) -> float:
    """Mean of the best four fifths of pairs, px: all matches of some may be wrong."""
    kept = -(-4 * len(residual) // 5)
    return float(residual.sort().values[:kept].mean())


def by_camera(residual: Tensor, evidence: Evidence, views: int) -> Tensor:
    """``(V)`` px, the mean of each camera's pairs."""
    # The mean of none is NaN.
    return torch.stack([residual[evidence.with_camera(view)].mean() for view in range(views)])
