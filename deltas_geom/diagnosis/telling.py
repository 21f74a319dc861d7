"""A diagnosis in words, and what was given after the cure."""

import math
from typing import NamedTuple

from torch import Tensor

from deltas_geom.cameras.views import PosedViews
from deltas_geom.diagnosis.causes import CURES, Cause
from deltas_geom.diagnosis.hypotheses import COMMON_SIZES, Hypothesis, pixels_at
from deltas_geom.diagnosis.results import Diagnosis, Explanation, Mended
from deltas_geom.diagnosis.trials import Trial, level

_SENTENCES = {
    Cause.TOO_FEW_MATCHES: "{cause}",
    Cause.ALL_WELL: "{cause}: matches are {before} px off{but}",
    Cause.NO_SINGLE_CAUSE: "{cause}: matches are {before} px off ({worst} px)",
    Cause.NO_BASELINE: (
        "{cause}: rotations explain the matches to {before} px, cameras turn in one place or all "
        "is far away; translations cannot be told"
    ),
    Cause.CAMERA_DISAGREES: (
        "camera {one} disagrees with all others: its matches are {before} px off, those of the "
        "others {after} px"
    ),
    Cause.VIEWS_SWAPPED: (
        "the pixels of views {one} and {other} are exchanged: matches are {before} px off as "
        "given, {after} px with the cure"
    ),
}
_MENDED = "{cause}{alone}{by}: matches are {before} px off as given, {after} px with the cure"
_MOVING = "{cause}: all cameras stand in one place, yet matches move against it"


class Told(NamedTuple):
    """What is known before there is a cause; the residuals of ``cameras`` ``(V)`` in px."""

    views: PosedViews
    pixels: Tensor
    seen: Tensor
    given: Trial
    cameras: Tensor
    ranking: tuple[Explanation, ...] = ()

    def says(
        self,
        what: Hypothesis,
        trial: Trial | None = None,
        alternatives: tuple[Explanation, ...] = (),
        *,
        moves: bool = False,
    ) -> Diagnosis:
        """The diagnosis; ``moves``: matches have parallax though cameras have no baseline."""
        before, after = self._residuals(trial)
        return Diagnosis(
            what.cause,
            self._sentence(what, before, after, moves),
            _cure(what, self.given.what.K),
            what.cameras[0] if what.cameras else None,
            what.cameras,
            what.factor,
            before,
            after,
            self.cameras,
            alternatives,
            (),
            self.ranking,
            self._mended(what),
        )

    def _residuals(self, trial: Trial | None) -> tuple[float, float]:
        if trial is None:
            # Of all pairs; a few with wrong matches do not count.
            residual = level(self.given.residual) if len(self.given.residual) else math.nan
            return residual, residual
        before = level(self.given.residual[trial.concerned])
        if trial.what.cause is Cause.CAMERA_DISAGREES:
            return before, level(self.given.residual[~trial.concerned])
        return before, level(trial.residual[trial.concerned])

    def _sentence(self, what: Hypothesis, before: float, after: float, moves: bool) -> str:
        off = int((self.given.residual > 3 * before + 1).sum())
        order = self.cameras.argsort(descending=True)
        worst = order[~self.cameras[order].isnan()][:3].tolist()  # NaN: without pairs
        one, other = (*what.cameras, None, None)[:2]
        template = _SENTENCES.get(what.cause, _MENDED)
        return (_MOVING if moves else template).format(
            cause=what.cause.value,
            before=f"{before:.3g}",
            after=f"{after:.3g}",
            but=f", but in {off} of {len(self.given.residual)} pairs of views" if off else "",
            worst=", ".join(f"camera {view} by {self.cameras[view]:.3g}" for view in worst),
            one=one,
            other=other,
            alone=f" (camera {one} alone)" if what.cameras else "",
            by=_by(what),
        )

    def _mended(self, what: Hypothesis) -> Mended:
        views, pixels, seen = self.views, self.pixels, self.seen.to(self.pixels.device)
        order = list(range(len(seen)))
        if what.cause is Cause.POINTS_AS_VIEWS:
            return Mended(views, pixels.transpose(0, 1), seen.mT)
        if what.cause is Cause.PIXELS_NORMALIZED:
            return Mended(views, pixels_at(pixels, views.K.to(pixels)), seen)
        if what.cause is Cause.AXES_SWAPPED:
            chosen = list(what.cameras) or order
            pixels = pixels.clone()
            pixels[chosen] = pixels[chosen].flip(-1)
            return Mended(views, pixels, seen)
        if what.cause is Cause.HALF_A_PIXEL:
            return Mended(views, pixels + (what.factor or 0.0), seen)
        if what.cause is Cause.VIEWS_SWAPPED:
            one, other = what.cameras
            order[one], order[other] = other, one
            return Mended(views, pixels[order], seen[order])
        if what.cause is Cause.CAMERA_DISAGREES:
            order.remove(what.cameras[0])
            return Mended(views.select(order), pixels[order], seen[order])
        K, pose = what.K.to(views.K), what.pose.to(views.cam_from_world)
        return Mended(PosedViews(K, pose), pixels, seen)


def _by(what: Hypothesis) -> str:
    """The factor in words."""
    if what.factor is None:
        return ""
    if what.cause is Cause.K_OF_OTHER_SIZE:
        name = f"{what.factor:.4g}"
        for size in COMMON_SIZES:
            if size == what.factor and size < 1:
                name = f"1/{1 / size:.3g}"
        return f", which are {1 / what.factor:.4g} times as large (K times {name} is right)"
    if what.cause is Cause.HALF_A_PIXEL:
        return f" (pixels {what.factor:+g} px are right)"
    unit = {1e-3: ", millimetres", 0.01: ", centimetres", 0.3048: ", feet", 0.0254: ", inches"}
    return f"{unit.get(what.factor, '')} (times {what.factor:.4g} is right)"


def _cure(what: Hypothesis, K: Tensor) -> str:
    cure = CURES[what.cause]
    if what.cause is Cause.CROPPED:
        left, top = (K - what.K)[0, :2, 2].tolist()
        cure = f"views.crop(left={left:.4g}, top={top:.4g})"
    if what.cause is Cause.K_OF_OTHER_SIZE:
        cure = f"{cure}, the images {what.factor:.4g} times as large as K's"
    if what.cause is Cause.FOCAL_LENGTH:
        cure = f"K[..., :2, :2] *= {what.factor:.4g}"
    if what.cause is Cause.UNIT_OF_TRANSLATION:
        cure = f"poses[{what.cameras[0]}, :3, 3] *= {what.factor:.4g}"
    if what.cause is Cause.CAMERA_DISAGREES:
        return f"leave it out, mask[{what.cameras[0]}] = False, or find its pose anew"
    if what.cause is Cause.VIEWS_SWAPPED:
        one, other = what.cameras
        return f"pixels[[{one}, {other}]] = pixels[[{other}, {one}]], or exchange the cameras"
    if what.cameras and what.cause is not Cause.UNIT_OF_TRANSLATION:
        return f"of camera {what.cameras[0]} alone: {cure}"
    return cure
