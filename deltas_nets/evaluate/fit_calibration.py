"""Fit the calibration of a network's standard deviations, on rooms that no training sees."""

from collections.abc import Callable, Mapping

import numpy as np
import torch

from deltas_nets.evaluate.calibration import Calibration, CalibrationMeter
from deltas_nets.evaluate.rooms import RoomViews, measure_rooms
from deltas_nets.network.deltas import Deltas
from deltas_nets.network.lite.calibration import NUM_KNOTS, Curve

LEAST_SLOPE = 0.05
"""Of the curve, log over log: where the prediction says nothing about the error, the order of
pixels is kept all the same."""
LEAST_STEP = 1e-3
LEAST_ERROR = 1e-6


def fit_curve(meter: CalibrationMeter) -> Curve:
    """The increasing curve from predicted to right standard deviations, in logs.

    A knot stands for an eighth of the pixels. Its value is sqrt(2) times the mean absolute error of
    their log depth, the estimate of greatest likelihood for the Laplace distribution that
    :meth:`deltas_nets.network.deltas.DepthPrediction.confidence` reads the deviation as. A fit to
    the root mean square would follow the one room in sixty that failed: from one half of the rooms
    to the other it varies twice as much, and it fits captures worse.
    """
    groups = meter.groups(NUM_KNOTS)
    knots, values = np.log(groups.std), np.empty(NUM_KNOTS)
    for i in range(1, NUM_KNOTS):  # a network that always says the same has one knot
        knots[i] = max(knots[i], knots[i - 1] + LEAST_STEP)
    rise = np.log(np.maximum(groups.laplace, LEAST_ERROR)) - LEAST_SLOPE * knots
    for i in range(NUM_KNOTS):
        # Isotonic regression in closed form (Robertson et al., 1988, theorem 1.4.4).
        values[i] = max(
            min(rise[start : stop + 1].mean() for stop in range(i, NUM_KNOTS))
            for start in range(i + 1)
        )
    return Curve(torch.tensor(knots).float(), torch.tensor(values + LEAST_SLOPE * knots).float())


def fit_calibration(
    model: Deltas,
    rooms: Mapping[int, RoomViews],
    *,
    depth_range: tuple[float, float] = (0.5, 10.0),
    report: Callable[[str], None] = lambda _: None,
) -> dict[int, Calibration]:
    """Calibrate a network in place; an earlier calibration is replaced.

    Args:
        model: trained; only its calibration changes.
        rooms: to fit on, for each of :data:`deltas_nets.network.lite.calibration.VIEWS` some with
            so many views. Never those that are reported on, and never real captures, whose figures
            would no longer say how the network does on captures it has not seen.
        depth_range: (near, far) metres.
        report: called after each room.

    Returns:
        How it was before, on these rooms, by number of views.

    Raises:
        ValueError: no room has depth in range.
    """
    model.calibration.reset()
    before: dict[int, Calibration] = {}
    for num_views, some in rooms.items():
        meter = CalibrationMeter()
        measure_rooms(model, some, meter, depth_range=depth_range, report=report)
        before[num_views] = meter.result()
        model.calibration.set(num_views, fit_curve(meter))
    return before
