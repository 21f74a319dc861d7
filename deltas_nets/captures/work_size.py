"""From frames to what the network sees: resized images, and cameras resized with them."""

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from deltas_geom.cameras.pixels import resize_intrinsics
from deltas_geom.cameras.views import PosedViews
from deltas_nets.captures.frame import Frame
from deltas_nets.captures.rigid import rigid_inverse

__all__ = [
    "anchor_views",
    "camera_at",
    "depth_at_image",
    "fit_work_size",
    "load_image",
    "load_views",
    "sensor_at_image",
]

SMALLEST_BASELINE = 1e-6
"""Metres; cameras nearer to each other stand in one place, as files have six digits."""
MULTIPLE = 16
"""Sides the network's coarsest stride divides, so that no feature map is cut off."""


def load_views(frames: Sequence[Frame], *, work_size: tuple[int, int]) -> tuple[Tensor, PosedViews]:
    """Images of a view set at the size the network sees, and their cameras.

    Args:
        frames: the anchor, then its sources.
        work_size: (height, width) of the result; images may differ in size before.

    Returns:
        Images ``(V, 3, H, W)`` float32 RGB in [0, 1], and views as from :func:`anchor_views`.

    Raises:
        UserError: an image cannot be read.
    """
    images = torch.stack([load_image(frame, work_size=work_size) for frame in frames])
    return images, anchor_views(frames, work_size=work_size)


def load_image(frame: Frame, *, work_size: tuple[int, int]) -> Tensor:
    """Image ``(3, H, W)`` float32 RGB in [0, 1] at the size the network sees.

    Raises:
        UserError: it cannot be read.
    """
    pixels = frame.read_resized(work_size)
    return torch.from_numpy(pixels).permute(2, 0, 1).contiguous().float() / 255


def anchor_views(frames: Sequence[Frame], *, work_size: tuple[int, int]) -> PosedViews:
    """Cameras of a view set in the anchor's coordinates, for images of a size.

    Args:
        frames: the anchor, whose ``cam_from_world`` becomes the identity, then its sources.
        work_size: (height, width) that the images are resized to.

    Returns:
        K ``(V, 3, 3)``, poses ``(V, 4, 4)``, float32.
    """
    intrinsics, poses = [], []
    world_from_anchor = rigid_inverse(frames[0].cam_from_world)
    for frame in frames:
        K = torch.from_numpy(frame.K.copy())
        intrinsics.append(resize_intrinsics(K, old_size=frame.image_size, new_size=work_size))
        # In float64, before the cast: float32 keeps 6 cm at 1000 km and 0.06 mm at 1 km, and
        # the baseline is what is left when two such numbers are subtracted.
        cam_from_anchor = frame.cam_from_world @ world_from_anchor
        if np.linalg.norm(cam_from_anchor[:3, 3]) < SMALLEST_BASELINE:
            cam_from_anchor[:3, 3] = 0  # rounding, which would pass for parallax
        poses.append(torch.from_numpy(cam_from_anchor))
    poses[0] = torch.eye(4, dtype=torch.float64)  # exactly, not but for rounding
    return PosedViews(torch.stack(intrinsics).float(), torch.stack(poses).float())


def camera_at(frame: Frame, size: tuple[int, int]) -> PosedViews:
    """The camera ``(1)`` of a frame, for its image at a size, where it stands; float64."""
    K = resize_intrinsics(torch.tensor(frame.K), old_size=frame.image_size, new_size=size)
    return PosedViews(K[None], torch.tensor(frame.cam_from_world)[None])


def fit_work_size(
    image_size: tuple[int, int], *, max_pixels: int = 240 * 320, enlarged: float = 1.0
) -> tuple[int, int]:
    """The size to work at: the aspect ratio of the image, at most so many pixels.

    Both sides are multiples of ``MULTIPLE``; among those that fit the one that keeps the
    aspect ratio best for its area.

    Args:
        image_size: (height, width).
        max_pixels: of the result.
        enlarged: how many times as long its sides may be; by 1 no image is enlarged, except to
            one multiple.

    Raises:
        ValueError: no size fits.

    Example:
        >>> fit_work_size((480, 640))
        (240, 320)
        >>> fit_work_size((360, 540))
        (224, 336)
        >>> fit_work_size((120, 160), enlarged=2.0)
        (240, 320)
    """
    height, width = image_size
    if height < 1 or width < 1 or max_pixels < MULTIPLE * MULTIPLE:
        raise ValueError(f"no size with multiples of {MULTIPLE} fits {image_size=}, {max_pixels=}")
    scale = min(enlarged, (max_pixels / (height * width)) ** 0.5)
    best: tuple[float, tuple[int, int]] | None = None
    for rows in _multiples_around(height * scale):
        for columns in _multiples_around(width * scale):
            if rows * columns > max_pixels:
                continue
            stretch = abs(np.log(rows / columns * width / height))
            shrink = abs(np.log(rows * columns / (height * width * scale**2)))
            # A pixel stretched costs more than one fewer: both axes share one encoder.
            cost = 2 * stretch + 0.5 * shrink
            if best is None or cost < best[0]:
                best = (cost, (rows, columns))
    if best is None:  # an image so long and thin that one multiple across is already too much
        longest = max_pixels // MULTIPLE // MULTIPLE * MULTIPLE
        return (MULTIPLE, longest) if width > height else (longest, MULTIPLE)
    return best[1]


def depth_at_image(
    frame: Frame, *, work_size: tuple[int, int] | None = None
) -> NDArray[np.float32]:
    """Sensor depth on the pixel grid of the colour image, or of that image resized.

    Nearest neighbour: between a near and a far surface there is nothing at their mean. The
    depth camera is taken to stand where the colour camera stands; without intrinsics of its
    own it sees the same field of view.

    Args:
        frame: one that has depth.
        work_size: (height, width) of the resized image; ``frame.image_size`` if not given.

    Returns:
        ``(H, W)`` float32 metres, 0 where unknown or not seen.

    Raises:
        UserError: the frame has no depth, or it cannot be read.
    """
    return sensor_at_image(frame, frame.read_depth(), work_size=work_size)


def sensor_at_image(
    frame: Frame, depth: NDArray[np.float32], *, work_size: tuple[int, int] | None = None
) -> NDArray[np.float32]:
    """What :func:`depth_at_image` makes of a frame's sensor depth ``(h, w)`` that was read."""
    depth_size = (depth.shape[0], depth.shape[1])
    height, width = size = frame.image_size if work_size is None else work_size
    image_K = torch.from_numpy(frame.K.copy())
    K = resize_intrinsics(image_K, old_size=frame.image_size, new_size=size).numpy()
    seen_K = resize_intrinsics(image_K, old_size=frame.image_size, new_size=depth_size).numpy()
    depth_K = seen_K if frame.depth_K is None else frame.depth_K
    columns = _nearest(depth_K[0, 0] / K[0, 0], K[0, 2], depth_K[0, 2], width)
    rows = _nearest(depth_K[1, 1] / K[1, 1], K[1, 2], depth_K[1, 2], height)
    seen_columns = (columns >= 0) & (columns < depth_size[1])
    seen_rows = (rows >= 0) & (rows < depth_size[0])
    columns, rows = columns.clip(0, depth_size[1] - 1), rows.clip(0, depth_size[0] - 1)
    seen = seen_rows[:, None] & seen_columns[None, :]
    return np.where(seen, depth[rows[:, None], columns[None, :]], np.float32(0))


def _nearest(scale: float, centre: float, depth_centre: float, size: int) -> NDArray[np.intp]:
    """Nearest depth pixel of each colour pixel along one axis; may lie outside the image."""
    position = scale * (np.arange(size) - centre) + depth_centre
    # Ties (every pixel, at twice the size) go one way, not as rounding errors fall.
    nearest: NDArray[np.intp] = np.floor(position + 0.5 - 1e-6).astype(np.intp)
    return nearest


def _multiples_around(length: float) -> tuple[int, ...]:
    below = max(1, int(length // MULTIPLE))
    return tuple(MULTIPLE * count for count in (below - 1, below, below + 1) if count > 0)
