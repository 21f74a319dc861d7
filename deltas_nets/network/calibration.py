"""A monotone correction of the predicted standard deviation, fitted after training.

A spread that was learned with the network's own training errors is off where rooms or errors are
others than in training. A curve of few points, from the log of the predicted standard deviation to
the log of the right one, mends it; depth, and which pixel is more certain than which, stay.
"""

from typing import Any

import torch
from torch import Tensor, nn

NUM_KNOTS = 8
RANGE = (-6.0, 2.0)
"""Log standard deviations between which the knots of the identity lie."""


class SpreadCalibration(nn.Module):
    """Piecewise linear and increasing; a constant factor beyond the first and the last knot.

    Attributes:
        knots: ``(8,)`` log of predicted relative standard deviations, increasing.
        values: ``(8,)`` what each becomes, increasing. Both are buffers: no training moves them.

    Weights without them, from before a calibration was fitted, load as the identity.
    """

    knots: Tensor
    values: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("knots", torch.linspace(*RANGE, NUM_KNOTS))
        self.register_buffer("values", torch.linspace(*RANGE, NUM_KNOTS))
        self.register_load_state_dict_pre_hook(_identity_if_missing)  # type: ignore[no-untyped-call]

    def forward(self, log_std: Tensor) -> Tensor:
        """Correct log standard deviations of any shape."""
        widths = self.knots.diff()
        slopes = self.values.diff() / widths
        # How far each value climbs up each of the segments.
        climbed = (log_std[..., None] - self.knots[:-1]).clamp_min(0).minimum(widths)
        below = (log_std - self.knots[0]).clamp_max(0)
        above = (log_std - self.knots[-1]).clamp_min(0)
        return self.values[0] + (climbed * slopes).sum(dim=-1) + below + above

    def set(self, knots: Tensor, values: Tensor) -> None:
        """Take over a fitted curve.

        Raises:
            ValueError: there are not 8 of each, or they don't increase: the order of pixels by
                certainty would be lost.
        """
        for name, points in (("knots", knots), ("values", values)):
            if points.shape != (NUM_KNOTS,) or not bool((points.diff() > 0).all()):
                raise ValueError(f"{name} must be {NUM_KNOTS} increasing numbers, got {points}")
        self.knots.copy_(knots)
        self.values.copy_(values)

    def reset(self) -> None:
        """Back to the identity: the spread as the network predicts it."""
        identity = torch.linspace(*RANGE, NUM_KNOTS)
        self.set(identity, identity)


def _identity_if_missing(module: nn.Module, state: dict[str, Any], prefix: str, *_: Any) -> None:
    """Give a state of before there were calibrations the identity."""
    names = [prefix + "knots", prefix + "values"]
    if not any(name in state for name in names):
        for name in names:
            state[name] = torch.linspace(*RANGE, NUM_KNOTS)
