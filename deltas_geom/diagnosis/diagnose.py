"""Which single cause explains residuals best."""

from functools import partial

import torch
from torch import Tensor

from deltas_geom.cameras.poses import camera_centers
from deltas_geom.cameras.views import PosedViews
from deltas_geom.checks import ShapeError, check_batch, check_kind, check_positive
from deltas_geom.diagnosis.causes import Cause
from deltas_geom.diagnosis.evidence import CHANCE, SHARE, Evidence, displacements, gather_evidence
from deltas_geom.diagnosis.hypotheses import Hypothesis, pixels_at, resized, shifted
from deltas_geom.diagnosis.results import Diagnosis
from deltas_geom.diagnosis.telling import Told
from deltas_geom.diagnosis.threes import off_in_threes
from deltas_geom.diagnosis.trials import (
    Trial,
    all_trials,
    by_camera,
    explains,
    level,
    share_fitting,
    tried,
)

_SAME = 1.25  # times as much is as good
_JUDGED_OTHERWISE = (Cause.CAMERA_DISAGREES, Cause.POINTS_AS_VIEWS)  # not by the pairs as given


def diagnose(
    views: PosedViews, pixels: Tensor, *, mask: Tensor | None = None, threshold: float = 2.0
) -> Diagnosis:
    """Which single cause explains best why matches do not fit the cameras, and its cure.

    Poses inverted or with OpenGL's axes, rotations or K transposed, K of images of another size
    or with wrong focal lengths, half a pixel, a crop, axes or views of pixels exchanged, one camera
    with another unit, or one that disagrees with all others: each is mended in turn, for all
    cameras and for the worst, and residuals are compared. They are distances in px of matches from
    what a view sees of another view's ray, which ends at the epipole and at infinity, so that
    points behind cameras count as wrong; a quarter of the matches of a pair of views must fit, and
    more of few matches, of which a quarter fits by accident. So up to 30 % of the pixels may be
    wrong. Pairs do not see an error along their lines: where they fit, the points of three views
    and more must fit, too, each camera a tenth of its own. For people and commands: it looks at
    values, computes in float64 on the CPU, and has no gradients.

    What matches cannot tell is not guessed: causes that explain as much are all named
    (``alternatives``), and where all is well, those whose cure would change nothing (``untold``).
    Cameras that do not turn say nothing of K and little of poses. Matches must have been found
    without the cameras: those searched on epipolar lines always fit the cameras of these lines.

    Args:
        views: V cameras without batch dims.
        pixels: ``(V, N, 2)`` matches: ``pixels[:, n]`` show one point. NaN = not observed.
        mask: ``(V, N)`` bool, True = observed.
        threshold: px, a residual with which all is well. Raise it for rough poses.

    Raises:
        ShapeError: a shape differs, there are batch dims, or fewer than two views.
        TypeError: not tensors, or the mask is not bool.
        ValueError: a camera is not finite, or the threshold not positive.

    Source: Hartley and Zisserman, 2nd ed., sections 9.2 and 21.6 (cheirality).

    Example:
        >>> from deltas_geom.testing import seeded_scene
        >>> views, _, pixels = seeded_scene(3, num_views=4, num_points=50)
        >>> wrong = PosedViews.from_world_from_cam(*views)  # which they were not
        >>> found = diagnose(wrong, pixels)
        >>> found.cause.name, found.residual_if_mended < 1e-6
        ('POSES_INVERTED', True)
        >>> diagnose(*found.mended[:2]).well
        True
    """
    seen = _checked(views, pixels, mask, threshold)
    K, pose = (tensor.detach().cpu().double() for tensor in views)
    where = pixels.detach().cpu().double().nan_to_num()
    evidence = gather_evidence(where, seen)
    given = tried(Hypothesis(Cause.ALL_WELL, (), None, K, pose), evidence)
    told = Told(views, pixels, seen, given, by_camera(given.residual, evidence, len(K)))
    if not len(evidence.pairs):
        return told.says(Hypothesis(Cause.TOO_FEW_MATCHES, (), None, K, pose))
    if float(where[seen].abs().median()) < min(2.0, float(K[:, 0, 0].abs().median()) / 50):
        what = Hypothesis(Cause.PIXELS_NORMALIZED, (), None, K, pose)
        return told.says(what, tried(what, gather_evidence(pixels_at(where, K), seen)))
    trials = list(all_trials(given, evidence, where, seen, threshold))
    chosen = _chosen(given, trials, evidence, threshold)
    ranked = sorted([given, *trials], key=lambda trial: float(trial.residual.mean()))
    told = told._replace(ranking=tuple(trial.explanation() for trial in ranked))
    if chosen is None:
        return _without_cause(told, trials, evidence, where, threshold)
    if chosen.what.cause in _JUDGED_OTHERWISE:
        return told.says(chosen.what, chosen)
    fitting = partial(share_fitting, evidence=evidence, limit=2 * threshold)
    share, count = fitting(chosen)
    if share < SHARE + CHANCE / count**0.5:
        return told.says(given.what._replace(cause=Cause.NO_SINGLE_CAUSE))
    limit = _SAME * float(chosen.residual[chosen.concerned].mean()) + 0.05
    same = [
        trial.explanation()
        for trial in trials
        if trial is not chosen
        and explains(given, trial, threshold)
        and (
            float(trial.residual[chosen.concerned].mean()) <= limit
            or (trial.what.cause not in _JUDGED_OTHERWISE and fitting(trial)[0] >= share)
        )
    ]
    return told.says(chosen.what, chosen, tuple(same))


def _checked(views: PosedViews, pixels: Tensor, mask: Tensor | None, threshold: float) -> Tensor:
    """``(V, N)`` what is observed and finite."""
    check_kind("views", views, PosedViews, "PosedViews(K, cam_from_world)")
    seen = {"pixels": (pixels, "V N 2"), "mask": (mask, "V N")}
    if views.check_shapes() or check_batch(K=(views.K, "V 3 3"), **seen):
        raise ShapeError("diagnose takes one set of views: no batch dims")
    if views.num_views < 2:
        raise ShapeError(f"diagnose needs 2 views or more, got {views.num_views}")
    check_positive(threshold=threshold)
    for name, tensor in zip(("K", "cam_from_world"), views, strict=True):
        bad = ~tensor.isfinite().flatten(1).all(dim=-1)
        if bool(bad.any()):
            raise ValueError(f"{name} of camera {int(bad.nonzero()[0])} is not finite")
    finite = pixels.isfinite().all(dim=-1)
    return (finite if mask is None else finite & mask).cpu()


def _chosen(
    given: Trial, trials: list[Trial], evidence: Evidence, threshold: float
) -> Trial | None:
    good = [trial for trial in trials if explains(given, trial, threshold)]
    # Of equals the first: rounding does not count.
    best = min(good, key=lambda trial: round(float(trial.residual.mean()), 3), default=None)
    alone = _disagreeing(given, evidence, threshold)
    limit = 0.0 if best is None else _SAME * level(best.residual[best.concerned]) + 0.05
    if alone is not None:
        rest = 2 * level(given.residual[~alone.concerned]) + 0.25
        if best is None or level(best.residual[alone.concerned]) > rest:
            best, limit = alone, rest
    if best is None or len(best.what.cameras) != 1:
        return best
    # One camera is concerned, but if all were, it would be as well: the simpler is right.
    on = best.concerned
    rivals = [
        trial
        for trial in trials
        if not trial.what.cameras
        and explains(given, trial, threshold, on=on)
        and level(trial.residual[on]) <= limit
        and float(trial.residual[~on].sum()) <= float(_SAME * given.residual[~on].sum()) + 0.05
    ]
    return min(rivals, key=lambda trial: float(trial.residual.mean()), default=best)


def _disagreeing(given: Trial, evidence: Evidence, threshold: float) -> Trial | None:
    """The one camera without which all others agree."""
    for camera in range(len(given.what.K)):
        concerned = evidence.with_camera(camera)
        if not bool(concerned.any()) or bool(concerned.all()):
            continue
        own, rest = given.residual[concerned], given.residual[~concerned]
        limit = max(threshold, 3 * level(rest))
        apart = level(own) > limit and float((own > limit).double().mean()) > 0.6
        agree = level(rest) <= threshold and _well(
            rest, evidence.of(~concerned), len(given.what.K), limit
        )
        if apart and agree:
            what = given.what._replace(cause=Cause.CAMERA_DISAGREES, cameras=(camera,))
            return Trial(what, torch.where(concerned, torch.nan, given.residual), concerned)
    return None


def _without_cause(
    told: Told, trials: list[Trial], evidence: Evidence, pixels: Tensor, threshold: float
) -> Diagnosis:
    """All is well, nothing has parallax, or nothing explains it."""
    given = told.given
    residual = level(given.residual)
    K, pose = given.what.K, given.what.pose
    centers = camera_centers(pose)
    one_place = float((centers - centers[0]).abs().max()) <= 1e-9 * float(1 + centers.abs().max())
    off = displacements(evidence, K, pose)
    still = float((off <= min(threshold, max(4 * residual, 0.1))).double().mean()) >= 0.9
    if still or one_place:
        moves = not still and residual > threshold
        return told.says(given.what._replace(cause=Cause.NO_BASELINE), moves=moves)
    if not _well(given.residual, evidence, len(K), threshold):
        return told.says(given.what._replace(cause=Cause.NO_SINGLE_CAUSE))
    apart = off_in_threes(K, pose, pixels, told.seen, 2 * threshold)
    if bool((apart > 0).any()):
        return _contradicted(told, evidence, apart)
    trials = [trial for trial in trials if not trial.what.cameras]
    trials.append(tried(Hypothesis(Cause.CROPPED, (), None, shifted(K, 20.0), pose), evidence))
    for factor in (0.5, 2.0):
        what = Hypothesis(Cause.K_OF_OTHER_SIZE, (), factor, resized(K, factor), pose)
        trials.append(tried(what, evidence))
    limit = _SAME * residual + 0.05
    untold = [trial.explanation() for trial in trials if level(trial.residual) <= limit]
    return told.says(given.what)._replace(untold=tuple(untold))


def _contradicted(told: Told, evidence: Evidence, apart: Tensor) -> Diagnosis:
    """Pairs of views agree, but cameras are off ``(V)`` px from the points of the others."""
    given = told.given
    residual = torch.maximum(given.residual, apart[evidence.pairs].amax(dim=-1))
    cameras = tuple((apart > 0).nonzero().flatten().tolist())
    concerned = evidence.with_camera(*cameras)
    given = given._replace(residual=residual)
    told = told._replace(given=given, cameras=by_camera(residual, evidence, len(apart)))
    if len(cameras) > 1 or bool(concerned.all()):
        return told.says(given.what._replace(cause=Cause.NO_SINGLE_CAUSE))
    what = given.what._replace(cause=Cause.CAMERA_DISAGREES, cameras=cameras)
    return told.says(what, Trial(what, residual, concerned))


def _well(residual: Tensor, evidence: Evidence, views: int, limit: float) -> bool:
    """Four fifths of the pairs fit, and a third of each camera's: no camera is out of place."""
    fit = residual <= limit
    each = [fit[evidence.with_camera(camera)] for camera in range(views)]
    shares = [float(own.double().mean()) for own in each if len(own)]
    return float(fit.double().mean()) >= 0.8 and min(shares) >= 0.3
