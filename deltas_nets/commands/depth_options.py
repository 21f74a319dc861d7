"""What `deltas depth` knows before it starts: how far surfaces are, in which steps it writes."""

import os
from dataclasses import replace
from typing import TYPE_CHECKING, Literal

from deltas_nets.commands.flags import sensible
from deltas_nets.errors import UserError
from deltas_nets.extras import usable_device
from deltas_nets.terminal import progress

if TYPE_CHECKING:
    from deltas_nets.captures.capture import Capture
    from deltas_nets.outputs.products import OutputOptions
    from deltas_nets.predict.depth_map import PredictConfig
    from deltas_nets.predict.predictor import Predictor


def asked_options(
    depth_scale: float | None, format: Literal["png", "npz", "tiff", "pfm"]
) -> "OutputOptions":
    """The options as flags have them, before there is a capture.

    Raises:
        UserError: steps are asked for where there are none.
    """
    from deltas_nets.outputs.products import OutputOptions

    if depth_scale is not None and format != "png":
        what = f"depth is written as float32 in {format}"
        raise UserError(what, "--depth-scale", "leave it out")
    given = {} if depth_scale is None else {"depth_scale": depth_scale}
    return sensible(OutputOptions, depth_format=format, **given)


def fitting_options(
    options: "OutputOptions",
    capture: "Capture",
    depth: float | None,
    depth_scale: float | None,
    depth_range: tuple[float, float] | None,
) -> "OutputOptions":
    """The options with the capture's unit, and steps that are fine and reach far enough.

    Args:
        options: as asked.
        capture: the frames.
        depth: how far typical surfaces are, if a first look told it.
        depth_scale: as asked, if it was.
        depth_range: as asked, if it was.

    Raises:
        UserError: the steps that are asked for do not reach as far as depth is searched.
    """
    from deltas_nets.captures.known_depths import farthest_depth
    from deltas_nets.captures.working_depth import working_depths
    from deltas_nets.outputs.products import OWN_UNIT, check_depth_fits, steps_to

    far = depth_range[1] if depth_range else farthest_depth(capture)
    if depth is not None and not depth_range:
        far = max(far, 4 * depth)  # as much farther as a room is searched
    if not capture.metric:
        options = replace(options, unit=OWN_UNIT)
        usual = float(working_depths(capture).max()) if depth is None else depth
        if depth_scale is None:
            return replace(options, depth_scale=steps_to(max(far, 4 * usual)))
    check_depth_fits((0.0, far), options)
    return options


def look_first(
    predictor: "Predictor",
    capture: "Capture",
    config: "PredictConfig",
    workers: int | None,
    device: str,
) -> float | None:
    """How far surfaces are, by a few maps; None where the capture says so or is of a usual room.

    Args:
        predictor: of a trained network.
        capture: the frames.
        config: all but the range.
        workers: maps computed at once, if that was said.
        device: where.
    """
    from deltas_nets.captures.working_depth import knows_its_scale
    from deltas_nets.predict.first_look import (
        ANCHORS,
        ENOUGH_FOR_ROOMS,
        ROUNDS,
        depth_unlike_rooms,
    )

    if knows_its_scale(capture):  # no bar for what takes no time
        return None
    threads = maps_at_once(ANCHORS, workers, device)
    looks = ANCHORS + (ENOUGH_FOR_ROOMS if capture.metric else 0)
    with progress("first look", ROUNDS * looks) as report:
        return depth_unlike_rooms(predictor, capture, config, threads=threads, report=report)


def maps_at_once(maps: int, workers: int | None, device: str) -> int:
    """Maps computed at once: a core each, as cores that share a map wait for each other."""
    from deltas_nets.predict.capture import FEWEST

    if workers is not None or usable_device(device) != "cpu" or maps < FEWEST:
        return workers or 1
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return min(cores or 1, maps)
