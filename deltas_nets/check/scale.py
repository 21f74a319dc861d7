"""The unit of poses, by what matches triangulate to and a sensor measured."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from deltas_geom import PosedViews, triangulate
from deltas_geom.cameras.poses import camera_centers
from deltas_geom.diagnosis.evidence import Evidence
from deltas_nets.captures.capture import Capture
from deltas_nets.captures.depth_files import holds_floats
from deltas_nets.captures.frame import FloatArray, Frame
from deltas_nets.check.finding import Fault, Finding
from deltas_nets.check.matched import Matched
from deltas_nets.check.mending import changing_frames, scaling_poses
from deltas_nets.check.sensor import Sensor
from deltas_nets.check.trying import ENOUGH
from deltas_nets.check.units import hardly_metres

__all__ = ["triangulated_depths", "wrong_scale"]

UNITS = {1.0: "metres", 1e-3: "millimetres", 0.01: "centimetres", 0.3048: "feet", 0.0254: "inches"}
TOLERANCE = 0.12  # relative
FAR = 300.0  # metres, where photos are usually not taken
APART = 5.0
"""Metres between views, of which deltas depth warns as well: half of how far it searches."""
SCALES = (1000.0, 4000.0, 5000.0, 6553.5, 10000.0)
"""Steps in a metre that depth cameras and data sets write."""
_SAME_SCALE = 0.04  # relative
_AS_WELL = 0.2
"""Relative: nine in ten points of a sensor whose unit alone is wrong are so near to the median."""
_PARALLAX = np.radians(1.0)
_LEAST = 60  # points


def triangulated_depths(views: PosedViews, evidence: Evidence) -> Tensor:
    """Depth ``(P, M)`` in the first view of each pair, NaN where parallax or residual is bad."""
    first, second = evidence.pairs.unbind(dim=-1)
    proj = torch.stack([views.proj[first], views.proj[second]], dim=1)
    pixels = torch.stack([evidence.first, evidence.second], dim=1)
    seen = pixels.isfinite().all(dim=-1)
    found = triangulate(proj, pixels.nan_to_num(), mask=seen)
    good = found.valid & (found.residual <= ENOUGH) & (found.parallax >= _PARALLAX)
    return torch.where(good, found.depth[:, 0], torch.nan)


def wrong_scale(
    capture: Capture, matched: Matched, evidence: Evidence, known: Mapping[int, Sensor]
) -> list[Finding]:
    """A finding where triangulated and measured depth differ, or nothing is that far away."""
    depths = triangulated_depths(matched.views(capture.frames), evidence)
    ratios = _ratios(matched, evidence, depths, known)
    if len(ratios) >= _LEAST:
        factor = 1 / float(np.median(ratios))
        if abs(np.log(factor)) <= TOLERANCE:
            return []
        if np.mean(np.abs(np.log(ratios * factor)) < _AS_WELL) < 0.5:
            return [_of_no_factor(ratios)]
        steps, unit = _steps_meant(capture, known, factor), _unit_meant(capture, known, factor)
        if steps is not None:
            return [_of_steps(steps, factor, len(ratios), capture.layout)]
        if unit is not None:
            return [_of_floats(unit, factor, len(ratios), capture.layout)]
        return [_of_sensor(factor, len(ratios))]
    return (
        _without_sensor(matched.views(capture.frames), evidence, depths) if capture.metric else []
    )


def _without_sensor(views: PosedViews, evidence: Evidence, depths: Tensor) -> list[Finding]:
    """A finding where things or cameras are too far away for metres."""
    usual = float(depths.nanmedian())
    if usual > FAR:
        return [hardly_metres("what matches triangulate to is away by", usual)]
    centres = camera_centers(views.cam_from_world)
    first, second = evidence.pairs.unbind(dim=-1)
    apart = float((centres[first] - centres[second]).norm(dim=-1).median())
    if apart > APART:
        words = "frames that see the same stand apart by"
        return [hardly_metres(words, apart, severity="warning")]
    return []


def _ratios(
    matched: Matched, evidence: Evidence, depths: Tensor, known: Mapping[int, Sensor]
) -> FloatArray:
    """Triangulated by measured depth of all points that have both."""
    found = [np.zeros(0)]
    for pair, pixels, triangulated in zip(evidence.pairs, evidence.first, depths, strict=True):
        view = int(pair[0])
        sensor = known.get(matched.positions[view])
        if sensor is None:
            continue
        good = triangulated.isfinite()
        measured = _read(sensor, pixels[good].numpy(), matched.sizes[view])
        ratio = triangulated[good].numpy()[measured > 0] / measured[measured > 0]
        found.append(ratio)
    return np.concatenate(found)


def _read(sensor: Sensor, pixels: FloatArray, size: tuple[int, int]) -> FloatArray:
    """Measured depth at pixels ``(N, 2)`` of the colour image at a size; 0 where unknown."""
    height, width = sensor.depth.shape
    x = (pixels[:, 0] + 0.5) * width / size[1] - 0.5
    y = (pixels[:, 1] + 0.5) * height / size[0] - 0.5
    seen = sensor.K @ np.linalg.inv(sensor.image_K) @ np.stack([x, y, np.ones(len(x))])
    column, row = np.round(seen[:2] / seen[2]).astype(int)
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    depth = sensor.depth[row.clip(0, height - 1), column.clip(0, width - 1)]
    return np.where(inside, depth, 0.0).astype(np.float64)


def _holds_floats(capture: Capture, known: Mapping[int, Sensor]) -> bool:
    """Whether depth is stored as floats, of which no number of steps that is stated counts."""
    files = [capture.frames.at(position).depth_path for position in known]
    return any(file is not None and holds_floats(file) for file in files)


def _of_no_factor(ratios: FloatArray) -> Finding:
    """Depth that no unit explains: poses are not to blame, whose matches fit."""
    low, high = np.percentile(ratios, (25, 75))
    evidence = (
        f"what matches triangulate to is {low:.3g} to {high:.3g} times as far as the sensor "
        f"measured (half of {len(ratios)} points): no unit explains that"
    )
    cure = "see what the files hold: depth along the view, of these frames, no inverse depth"
    return Finding(Fault.DEPTH_UNREADABLE, evidence, (), cure, "error")


def _unit(factor: float) -> float | None:
    return next((unit for unit in UNITS if abs(np.log(factor / unit)) < TOLERANCE), None)


def _unit_meant(
    capture: Capture, known: Mapping[int, Sensor], factor: float
) -> tuple[float, float] | None:
    """Metres in a unit of floats as stated, and with which poses in metres fit; None if none do."""
    stated = {capture.frames.at(position).depth_unit for position in known}
    if not capture.metric or len(stated) != 1 or not _holds_floats(capture, known):
        return None
    (unit,) = stated
    meant = _unit(unit / factor)
    return None if meant is None or meant == unit else (unit, meant)


def _of_floats(units: tuple[float, float], factor: float, points: int, layout: str) -> Finding:
    stated, meant = units
    evidence = f"{_compared(factor, points)}: depth is in {UNITS[meant]}"
    cure = f"multiply the numbers of depth files by {meant / stated:g}"
    if layout.startswith("transforms"):
        cure = f"state a depth_unit_scale_factor of {meant:g}"

    def change(_: int, frame: Frame) -> Frame:
        return replace(frame, depth_unit=meant)

    return Finding(Fault.DEPTH_SCALE, evidence, (), cure, "error", changing_frames(change))


def _compared(factor: float, points: int) -> str:
    return (
        f"what matches triangulate to is {1 / factor:.4g} times as far as the sensor measured "
        f"(median of {points} points)"
    )


def _steps_meant(
    capture: Capture, known: Mapping[int, Sensor], factor: float
) -> tuple[float, float] | None:
    """Steps in a metre as stated, and those with which poses in metres fit; None if none do."""
    stated = {capture.frames.at(position).depth_scale for position in known}
    if not capture.metric or len(stated) != 1 or _holds_floats(capture, known):
        return None
    (scale,) = stated
    meant = scale * factor
    near = next((s for s in SCALES if abs(np.log(s / meant)) < _SAME_SCALE), None)
    return None if near is None else (scale, near)


def _of_steps(steps: tuple[float, float], factor: float, points: int, layout: str) -> Finding:
    stated, meant = steps
    evidence = f"{_compared(factor, points)}: depth is in 1/{meant:g} m, not in 1/{stated:g} m"

    def change(_: int, frame: Frame) -> Frame:
        return replace(frame, depth_scale=meant)

    cure = _cure_of_steps(stated, meant, layout)
    return Finding(Fault.DEPTH_SCALE, evidence, (), cure, "error", changing_frames(change))


def _cure_of_steps(stated: float, meant: float, layout: str) -> str:
    """In the words of the files, if their format has any; most have one number of steps."""
    if layout.startswith("frames."):
        return f"state a depth_scale of {meant:g}"
    if layout.startswith("transforms"):
        said = f"state a depth_unit_scale_factor of {1 / meant:g}"
        return f"{said} (integer_depth_scale, if frames have depth_path)"
    return f"multiply the numbers of depth files by {stated / meant:g}"


def _of_sensor(factor: float, points: int) -> Finding:
    unit = _unit(factor)
    evidence = _compared(factor, points)
    if unit is not None:
        evidence += f": poses are in {UNITS[unit]}"
        factor = unit
    cure = f"multiply the translations of poses by {factor:.4g}"
    if unit is None:
        cure += f"; or, if poses are right, depth by {1 / factor:.4g}"
    cause = Fault.NOT_METRES if unit is not None else Fault.WRONG_SCALE
    return Finding(cause, evidence, (), cure, "error", scaling_poses(factor))
