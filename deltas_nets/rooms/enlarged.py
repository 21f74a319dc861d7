"""Close-ups as the network sees them: so much larger that their surfaces are as far as a room's."""

import numpy as np

from deltas_geom.cameras.views import PosedViews
from deltas_nets.captures.posed_images import PosedImages
from deltas_nets.network.unit import AS_IN_ROOMS, unit_of

APART = (-0.5, 0.6)
"""By how much, in log, a view may be nearer or farther than what its capture is enlarged for."""


def as_large_as_rooms(close_up: PosedImages, seed: int) -> PosedImages:
    """Enlarge a scene as prediction enlarges a capture that is nearer than rooms are.

    Args:
        close_up: V views, the anchor first, in metres.
        seed: of how large exactly.
    """
    median = float(close_up.depth[0].median())
    if median >= AS_IN_ROOMS[0]:
        return close_up
    unit = unit_of(median, metric=True)
    unit *= float(np.exp(np.random.default_rng([seed, 3]).uniform(*APART)))
    cam_from_world = close_up.views.cam_from_world.clone()
    cam_from_world[..., :3, 3] *= unit
    return PosedImages(
        close_up.images, PosedViews(close_up.views.K, cam_from_world), close_up.depth * unit
    )
