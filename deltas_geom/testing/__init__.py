"""Scenes, hypothesis strategies and invariants, for our tests and for yours.

``scenes`` and ``invariants`` need torch alone; ``strategies`` needs hypothesis (the extra
``test``), so it is not imported here.
"""

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
    "PosedScene",
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
