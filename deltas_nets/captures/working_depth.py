"""How far away surfaces are that views should go together for, in the capture's unit."""

import numpy as np

from deltas_nets.captures.capture import Capture, FloatArray
from deltas_nets.captures.centres import camera_centres
from deltas_nets.captures.known_depths import typical_depths

__all__ = ["guessed_depth", "knows_its_scale", "working_depths"]

IN_ROOMS = 2.5
"""Metres to typical surfaces of rooms."""
CONVERGING = (np.radians(4), np.radians(60))
"""Angles between optical axes that meet where something is looked at."""
SPACINGS = 8.0
"""Working depths are so many times the way to the nearest other camera where axes do not meet:
photos for structure from motion are taken about that far apart."""


def knows_its_scale(capture: Capture) -> bool:
    """Whether working depths follow from the capture itself: nobody need look first."""
    return capture.depth_ranges is not None or bool(np.isfinite(typical_depths(capture)).any())


def working_depths(capture: Capture) -> FloatArray:
    """``(F,)`` for each frame: of its sparse points, of its stated range, else as in rooms.

    Where the capture has no metres either, all are :func:`guessed_depth`.
    """
    depths = typical_depths(capture)
    if capture.depth_ranges is not None:
        # Of inverse depths the mean: most of a range is far away.
        stated = 2 / (1 / capture.depth_ranges).sum(axis=-1)
        depths = np.where(np.isfinite(depths), depths, stated)
    known = np.isfinite(depths)
    if known.any():
        return np.where(known, depths, np.median(depths[known]))
    return np.full(len(depths), IN_ROOMS if capture.metric else guessed_depth(capture))


def guessed_depth(capture: Capture) -> float:
    """Distance to what cameras look at together, or a multiple of their spacing."""
    poses = capture.frames.cam_from_world
    centres = camera_centres(poses)
    axes, met, spacings = poses[:, 2, :3], [], []
    for position, (centre, axis) in enumerate(zip(centres, axes, strict=True)):
        ways = np.delete(centres, position, axis=0) - centre
        lengths = np.linalg.norm(ways, axis=-1)
        if (lengths > 0).any():
            spacings.append(lengths[lengths > 0].min())
        met.append(_meeting(ways, np.delete(axes, position, axis=0), axis))
    found = np.concatenate([np.zeros(0), *met])
    if len(found) >= len(centres):
        return float(np.median(found))
    return SPACINGS * float(np.median(spacings)) if spacings else IN_ROOMS


def _meeting(ways: FloatArray, axes: FloatArray, axis: FloatArray) -> FloatArray:
    """How far along an axis others come nearest to it, of those that converge with it."""
    cosine = axes @ axis
    # The points axis * s and way + other * t are nearest where both are perpendicular to it.
    along, across = ways @ axis, (ways * axes).sum(axis=-1)
    sine = 1 - cosine**2
    turned = (cosine < np.cos(CONVERGING[0])) & (cosine > np.cos(CONVERGING[1]))
    sine = np.where(turned, sine, 1.0)
    ahead, theirs = (along - cosine * across) / sine, (cosine * along - across) / sine
    met: FloatArray = ahead[turned & (ahead > 0) & (theirs > 0)]
    return met
