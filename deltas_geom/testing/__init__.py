"""Scenes, hypothesis strategies and invariants, for our tests and for yours.

Scenes have cameras (``scenes``) or are of the image plane alone (``planar``); ``fixed_scenes``
makes those of the conformance table. ``target`` says what an implementation under test offers,
``targets`` has ready-made ones, ``invariants`` what is true of every right one, ``conformance``
asks all of all. ``strategies`` needs hypothesis and the target ``opencv`` needs OpenCV (the extra
``test``), so they are not imported here.
"""

from deltas_geom.testing.fixed_scenes import (
    named_scene,
    seeded_depths,
    seeded_map,
    seeded_scene,
    seeded_scores,
)
from deltas_geom.testing.invariants import INVARIANTS
from deltas_geom.testing.planar import DepthScene, MapScene, ScoreScene
from deltas_geom.testing.scenes import (
    DEGENERATE_SCENES,
    PosedScene,
    at_infinity,
    behind_camera,
    default_intrinsics,
    forward_motion,
    intrinsics_per_view,
    on_baseline,
    pure_rotation,
    right_angle,
    rigid,
    ring,
    scene_from,
    zero_baseline,
)
from deltas_geom.testing.target import Target

__all__ = [
    "DEGENERATE_SCENES",
    "INVARIANTS",
    "DepthScene",
    "MapScene",
    "PosedScene",
    "ScoreScene",
    "Target",
    "at_infinity",
    "behind_camera",
    "default_intrinsics",
    "forward_motion",
    "intrinsics_per_view",
    "named_scene",
    "on_baseline",
    "pure_rotation",
    "right_angle",
    "rigid",
    "ring",
    "scene_from",
    "seeded_depths",
    "seeded_map",
    "seeded_scene",
    "seeded_scores",
    "zero_baseline",
]
