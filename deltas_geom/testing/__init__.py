"""Scenes, hypothesis strategies and invariants, for our tests and for yours.

Scenes have cameras (``scenes``) or are of the image plane alone (``planar``). ``target`` says what
an implementation under test offers, ``targets`` has ready-made ones, ``invariants`` what is true of
every right one, ``conformance`` asks all of all. ``strategies`` needs hypothesis and the target
``opencv`` needs OpenCV (the extra ``test``), so they are not imported here.
"""

from deltas_geom.testing.planar import DepthScene, MapScene, ScoreScene
from deltas_geom.testing.scenes import (
    DEGENERATE_SCENES,
    PosedScene,
    at_infinity,
    behind_camera,
    default_intrinsics,
    forward_motion,
    on_baseline,
    pure_rotation,
    right_angle,
    rigid,
    ring,
    scene_from,
    zero_baseline,
)

__all__ = [
    "DEGENERATE_SCENES",
    "DepthScene",
    "MapScene",
    "PosedScene",
    "ScoreScene",
    "at_infinity",
    "behind_camera",
    "default_intrinsics",
    "forward_motion",
    "on_baseline",
    "pure_rotation",
    "right_angle",
    "rigid",
    "ring",
    "scene_from",
    "zero_baseline",
]
