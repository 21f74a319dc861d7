"""Where cameras stand."""

from deltas_nets.captures.frame import FloatArray

__all__ = ["camera_centres"]


def camera_centres(cam_from_world: FloatArray) -> FloatArray:
    """Centres ``(*B, 3)`` of cameras ``(*B, 4, 4)``, in the world.

    Example:
        >>> import numpy as np
        >>> pose = np.eye(4)
        >>> pose[:3, 3] = 1, 0, -2
        >>> camera_centres(pose)
        array([-1., -0.,  2.])
    """
    turned = cam_from_world[..., :3, :3].swapaxes(-1, -2)
    centres: FloatArray = -(turned @ cam_from_world[..., :3, 3:])[..., 0]
    return centres
