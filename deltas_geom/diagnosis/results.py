"""What a diagnosis says, for people and for programs."""

from typing import NamedTuple

import torch
from torch import Tensor

from deltas_geom.cameras.views import PosedViews
from deltas_geom.diagnosis.causes import CURES, Cause


class Explanation(NamedTuple):
    """One cause, tried.

    Attributes:
        cause: ``ALL_WELL`` is what was given.
        cameras: those concerned; empty = all.
        factor: by which K, its focal lengths or the translation is to be multiplied, or the shift
            that pixels need, px; None for other causes.
        residual: px, mean over all pairs of views, if the cause were mended.
    """

    cause: Cause
    cameras: tuple[int, ...]
    factor: float | None
    residual: float

    def __str__(self) -> str:
        of = "".join(f" {camera}" for camera in self.cameras)
        whose = f", camera{'s' if len(self.cameras) > 1 else ''}{of}" if self.cameras else ""
        by = f", {self.factor:+g} px" if self.cause is Cause.HALF_A_PIXEL else ""
        if self.factor is not None and not by:
            by = f", times {self.factor:.4g}"
        return f"{self.cause.name}{whose}{by}: {self.residual:.3g} px"


class Mended(NamedTuple):
    """What was given, after the cure.

    Attributes:
        views: V cameras; one less where a camera is left out.
        pixels: ``(V, N, 2)``.
        mask: ``(V, N)`` bool, True = observed.
    """

    views: PosedViews
    pixels: Tensor
    mask: Tensor


class Diagnosis(NamedTuple):
    """Why matches do not fit the cameras, or that they do.

    Attributes:
        cause: the one that explains residuals best.
        sentence: that cause, with its cameras and figures.
        cure: what to do, as code where code can say it.
        camera: the one camera concerned, or the first of two exchanged; None = all.
        cameras: those concerned; empty = all.
        factor: by which K, its focal lengths or the translation is to be multiplied, or the shift
            that pixels need, px; None for other causes.
        residual_as_given: px, of the pairs of views that the cause concerns.
        residual_if_mended: px, of the same pairs after the cure; of the others where a camera is
            left out.
        camera_residuals: ``(V)`` px, as given, mean over each camera's pairs; NaN without pairs.
        alternatives: other causes that explain as much. Not empty = cannot be told apart.
        untold: causes whose cure would change no residual: whether there is one, these matches
            cannot tell. That one scale multiplies all translations never can be told.
        ranking: all that was tried, best first.
        mended: what was given, after the cure, to verify it with.
    """

    cause: Cause
    sentence: str
    cure: str
    camera: int | None
    cameras: tuple[int, ...]
    factor: float | None
    residual_as_given: float
    residual_if_mended: float
    camera_residuals: Tensor
    alternatives: tuple[Explanation, ...]
    untold: tuple[Explanation, ...]
    ranking: tuple[Explanation, ...]
    mended: Mended

    @property
    def well(self) -> bool:
        """Whether cameras and matches agree."""
        return self.cause is Cause.ALL_WELL

    def __str__(self) -> str:
        lines = [self.sentence, f"  cure: {self.cure}"]
        for other in self.alternatives:
            lines.append(f"  cannot be told from {other}, cure: {CURES[other.cause]}")
        if self.untold:
            names = ", ".join(dict.fromkeys(other.cause.name for other in self.untold))
            lines.append(f"  these matches cannot tell: {names}, one scale of all translations")
        return "\n".join(lines)

    def __repr__(self) -> str:
        return f"<Diagnosis {self.cause.name}: {self.sentence}>"


# torch.load refuses classes that it has not been told of.
torch.serialization.add_safe_globals([Cause, Diagnosis, Explanation, Mended])
