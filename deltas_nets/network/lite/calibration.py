"""A monotone correction of the predicted standard deviation, fitted after training.

A spread that was learned with the network's own training errors is off where rooms or errors are
others than in training, and it is learned with all numbers of views together. A curve of few
points for some numbers of views, from the log of the predicted standard deviation to the log of
the right one, mends both; depth, and which pixel of a map is more certain than which, stay.
"""

import math
from bisect import bisect_right
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from deltas_geom.numerics.arithmetic import at_least_single

VIEWS = (2, 3, 5, 8)
"""Numbers of views, the anchor included, that have a curve of their own."""
NUM_KNOTS = 8
RANGE = (-6.0, 2.0)
"""Log standard deviations between which the knots of the identity lie."""


class Curve(NamedTuple):
    """What predicted log standard deviations become, so that they are right.

    Attributes:
        knots: ``(8,)`` log of predicted relative standard deviations, increasing.
        values: ``(8,)`` what each becomes, increasing.
    """

    knots: Tensor
    values: Tensor

    def __call__(self, log_std: Tensor) -> Tensor:
        """Correct log standard deviations of any shape; beyond the ends by a constant factor."""
        # In half precision neighbours may be rounded to the same knot: a step.
        widths = self.knots.diff().clamp_min(1e-4)
        slopes = self.values.diff() / widths
        # How far each value climbs up each of the segments.
        climbed = (log_std[..., None] - self.knots[:-1]).clamp_min(0).minimum(widths)
        below = (log_std - self.knots[0]).clamp_max(0)
        above = (log_std - self.knots[-1]).clamp_min(0)
        return self.values[0] + (climbed * slopes).sum(dim=-1) + below + above


class SpreadCalibration(nn.Module):
    """One curve for each of ``VIEWS``; between two of them their mean, by the log of the number.

    Attributes:
        knots: ``(4, 8)`` of the curves.
        values: ``(4, 8)``. Both are buffers: no training moves them.

    Weights with one curve for any number of views load as four of it; those without any, from
    before a calibration was fitted, as the identity.
    """

    knots: Tensor
    values: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("knots", _identity())
        self.register_buffer("values", _identity())
        self.register_load_state_dict_pre_hook(_of_older_weights)  # type: ignore[no-untyped-call]

    def forward(self, log_std: Tensor, num_views: int) -> Tensor:
        """Correct log standard deviations of any shape, predicted from so many views."""
        return self.curve(num_views)(log_std)

    def curve(self, num_views: int) -> Curve:
        """The curve for a number of views; beyond those of ``VIEWS``, that of the nearest."""
        count = min(max(num_views, VIEWS[0]), VIEWS[-1])
        upper = min(bisect_right(VIEWS, count), len(VIEWS) - 1)
        few, many = VIEWS[upper - 1], VIEWS[upper]
        # Increasing whatever the share is: the mean of two increasing sequences.
        share = math.log(count / few) / math.log(many / few)
        of_few, of_many = Curve(*self._row(upper - 1)), Curve(*self._row(upper))
        pairs = zip(map(at_least_single, of_few), map(at_least_single, of_many), strict=True)
        return Curve(*(torch.lerp(few, many, share) for few, many in pairs))

    def set(self, num_views: int, curve: Curve) -> None:
        """Take over a fitted curve.

        Args:
            num_views: one of ``VIEWS``.
            curve: for it.

        Raises:
            ValueError: there is no curve for this number; or there are not 8 knots and values, or
                they don't increase: the order of pixels by certainty would be lost.
        """
        if num_views not in VIEWS:
            raise ValueError(f"num_views must be one of {VIEWS}, got {num_views}")
        for name, points in curve._asdict().items():
            if points.shape != (NUM_KNOTS,) or not bool((points.diff() > 0).all()):
                raise ValueError(f"{name} must be {NUM_KNOTS} increasing numbers, got {points}")
        knots, values = self._row(VIEWS.index(num_views))
        knots.copy_(curve.knots)
        values.copy_(curve.values)

    def reset(self) -> None:
        """Make it the identity: the spread stays as the network predicts it."""
        self.knots.copy_(_identity())
        self.values.copy_(_identity())

    def _row(self, index: int) -> tuple[Tensor, Tensor]:
        return self.knots[index], self.values[index]


def _identity() -> Tensor:
    return torch.linspace(*RANGE, NUM_KNOTS).repeat(len(VIEWS), 1)


def _of_older_weights(module: nn.Module, state: dict[str, Any], prefix: str, *_: Any) -> None:
    """Give a state of before there were calibrations the identity, and repeat a lone curve."""
    names = [prefix + "knots", prefix + "values"]
    if not any(name in state for name in names):
        state.update(dict.fromkeys(names, _identity()))
    for name in names:
        if name in state and state[name].shape == (NUM_KNOTS,):
            state[name] = state[name].repeat(len(VIEWS), 1)
