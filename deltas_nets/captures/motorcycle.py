"""The real stereo pair that scikit-image carries: for the demo and tests, never for training.

Middlebury 2014 "Motorcycle" (Scharstein et al., GCPR 2014), reduced four times.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import skimage.data
from numpy.typing import NDArray

from deltas_nets.captures.frame import Frame
from deltas_nets.captures.images import ImageMemory
from deltas_nets.errors import UserError

FOCAL = 994.978  # px
BASELINE = 0.193001  # m
DISPARITY_AT_INFINITY = -31.086  # px: the right principal point lies that much further right
# The documentation divides the full-size principal point by 4. Averaging 4 x 4 blocks puts the
# first block's centre at 1.5 full-size pixels, so with pixel centres at integers it is
# (c + 0.5) / 4 - 0.5.
CENTER = (311.193 + 0.5 / 4 - 0.5, 254.877 + 0.5 / 4 - 0.5)
SIZE = (500, 741)


class StereoPair(NamedTuple):
    """Two views and the true depth of its left image.

    Attributes:
        left: the anchor; the world is its camera.
        right: the source, a baseline to the right.
        depth: ``(H, W)`` float32 metres of the left image, 0 = unknown.
    """

    left: Frame
    right: Frame
    depth: NDArray[np.float32]


def motorcycle() -> StereoPair:
    """The pair, offline.

    Raises:
        UserError: the installed scikit-image does not carry the pictures.
    """
    folder = Path(skimage.data.__file__).parent
    disparity_file = folder / "motorcycle_disp.npz"
    if not disparity_file.is_file():
        raise UserError(
            "this scikit-image carries no stereo pair",
            disparity_file,
            'reinstall it: pip install --force-reinstall "scikit-image>=0.24"',
        )
    with np.load(disparity_file, allow_pickle=False) as content:
        disparity = content["arr_0"].astype(np.float64)
    known = np.isfinite(disparity)  # unknown is inf, not NaN as the documentation says
    depth = np.where(
        known, FOCAL * BASELINE / (np.where(known, disparity, 0) - DISPARITY_AT_INFINITY), 0
    )
    K_left = np.array([[FOCAL, 0, CENTER[0]], [0, FOCAL, CENTER[1]], [0, 0, 1]])
    K_right = K_left.copy()
    K_right[0, 2] -= DISPARITY_AT_INFINITY
    right_from_left = np.eye(4)
    right_from_left[0, 3] = -BASELINE
    left, right = (
        Frame(name, folder / f"motorcycle_{name}.png", SIZE, K, pose, memory=ImageMemory(2**24))
        for name, K, pose in (("left", K_left, np.eye(4)), ("right", K_right, right_from_left))
    )
    return StereoPair(left, right, depth.astype(np.float32))
