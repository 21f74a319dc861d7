"""The scenes of the conformance table: the same on every machine, smallest first."""

from functools import partial
from typing import Any

import torch
from torch import Tensor

from deltas_geom.cameras.views import PosedViews
from deltas_geom.checks import check_counts, check_image_size
from deltas_geom.testing.arguments import check_bounds, check_places
from deltas_geom.testing.planar import DepthScene, MapScene, ScoreScene
from deltas_geom.testing.registry import Invariant
from deltas_geom.testing.scenes import (
    DEGENERATE_SCENES,
    PosedScene,
    intrinsics_per_view,
    rigid,
    scene_from,
)


def seeded_scene(
    seed: int, *, num_views: int = 2, num_points: int = 1, noise: float = 0.0, skew: float = 0.0
) -> PosedScene:
    """A well-posed scene in short numbers, the same on every machine; float64.

    Cameras look ahead from 25 cm beside each other, each with its own K; points lie around
    3.5 m ahead.

    Args:
        seed: which one; 0 leaves the cameras unturned.
        num_views: V, 2 or more.
        num_points: N, 1 or more.
        noise: largest error of a pixel's coordinate, px.
        skew: of all cameras, px.

    Raises:
        ValueError: too few views or points, or a noise below 0.

    Example:
        >>> seeded_scene(0).views.cam_from_world[1, :3, 3]
        tensor([-0.2500,  0.0000,  0.0000], dtype=torch.float64)
    """
    check_counts(2, num_views=num_views)
    check_counts(1, num_points=num_points)
    check_bounds(noise=noise)
    generator = torch.Generator().manual_seed(seed)
    points = _draw(generator, num_points, 3) + torch.tensor([0, 0, 3.5])
    turn = (0.0 if seed == 0 else 0.25) * _draw(generator, num_views, 3)  # rad
    shift = torch.zeros(num_views, 3, dtype=torch.float64)  # m
    shift[:, 0] = -0.25 * torch.arange(num_views)
    K = intrinsics_per_view(num_views)
    K[:, 0, 1] = skew
    scene = scene_from(PosedViews(K, rigid(turn, shift)), points)
    return scene._replace(pixels=scene.pixels + noise * _draw(generator, num_views, num_points, 2))


def named_scene(name: str, *, dtype: torch.dtype = torch.float64) -> PosedScene:
    """One of ``DEGENERATE_SCENES``, seen by a camera of another K in each view.

    Where singular values tie, at 90 degrees and on a ring, the focal length is one, as the ties
    would go with it.

    Args:
        name: which one.
        dtype: of everything.

    Raises:
        ValueError: there is no such scene.

    Example:
        >>> named_scene("on_baseline").pixels.tolist()
        [[[320.0, 240.0]], [[304.0, 248.0]]]
    """
    if name not in DEGENERATE_SCENES:
        raise ValueError(f"name must be one of {', '.join(DEGENERATE_SCENES)}, got {name!r}")
    scene = DEGENERATE_SCENES[name](dtype=dtype)
    old = scene.views.K
    K = intrinsics_per_view(scene.views.num_views, dtype=dtype)
    if name in _TIES:
        K[:, [0, 1], [0, 1]] = old[:, [0, 1], [0, 1]]
    # Multiplied first: whole numbers stay whole.
    offset = (scene.pixels - old[:, None, :2, 2]) * K[:, None, [0, 1], [0, 1]]
    pixels = offset / old[:, None, [0, 1], [0, 1]] + K[:, None, :2, 2]
    return PosedScene(scene.views._replace(K=K), scene.points, pixels)


def seeded_map(
    seed: int, *, stride: tuple[int, int] = (1, 1), channels: int = 1, num_pixels: int = 4
) -> MapScene:
    """A map of 5 x 6 cells and pixels of its image, some beyond the outer cells; float64.

    Args:
        seed: which one.
        stride: pixels of a cell, down and across.
        channels: D.
        num_pixels: N.

    Example:
        >>> seeded_map(0, stride=(2, 4)).image_size
        (10, 24)
    """
    check_counts(1, stride=stride, channels=channels, num_pixels=num_pixels)
    generator = torch.Generator().manual_seed(seed)
    height, width = 5 * stride[0], 6 * stride[1]
    size = torch.tensor([width, height])
    return MapScene(
        _draw(generator, channels, 5, 6),
        (_draw(generator, num_pixels, 2) + 1) / 2 * size - 0.5,
        _draw(generator, num_pixels, channels),
        (height, width),
    )


def seeded_scores(
    seed: int, *, size: tuple[int, int] = (1, 3), dims: int = 1, masked: bool = False
) -> ScoreScene:
    """Logits between -3 and 3 of places between -8 and 8; float64.

    Args:
        seed: which one.
        size: (h, w) of the logits, 2 places or more.
        dims: D of the positions.
        masked: whether every fourth place is masked.

    Example:
        >>> seeded_scores(0, masked=True).mask
        tensor([[ True,  True, False]])
    """
    check_places(size)
    check_counts(1, dims=dims)
    generator = torch.Generator().manual_seed(seed)
    height, width = size
    mask = torch.arange(height * width) % 4 != 2
    return ScoreScene(
        3 * _draw(generator, height, width),
        8 * _draw(generator, height * width, dims),
        mask.reshape(size) | (not masked),
    )


def seeded_depths(
    seed: int, *, num_points: int = 2, image_size: tuple[int, int] = (2, 3)
) -> DepthScene:
    """Points in and a little around a small image, of 1, 2, ... m in some order; float64.

    Args:
        seed: which one.
        num_points: N.
        image_size: (height, width).

    Example:
        >>> seeded_depths(1, num_points=3).depth
        tensor([3., 1., 2.], dtype=torch.float64)
    """
    check_counts(1, num_points=num_points)
    check_image_size(image_size)
    generator = torch.Generator().manual_seed(seed)
    height, width = image_size
    size = torch.tensor([width, height])
    return DepthScene(
        (1.2 * _draw(generator, num_points, 2) + 1) / 2 * size - 0.5,
        1.0 + torch.randperm(num_points, generator=generator).double(),
        0.6 + 0.4 * _draw(generator, num_points),
        image_size,
    )


def _draw(generator: torch.Generator, *shape: int) -> Tensor:
    """Between -1 and 1, in steps of 1/64: short numbers."""
    return torch.randint(-64, 65, shape, generator=generator).double() / 64


_TIES = ("right_angle", "ring")
_POSED = (
    partial(seeded_scene, 0),
    partial(seeded_scene, 0, noise=1.0),
    partial(seeded_scene, 0, noise=1.0, skew=5.0),
    partial(seeded_scene, 1),
    partial(seeded_scene, 1, noise=1.0),
    partial(seeded_scene, 0, num_views=3, noise=1.0),
    partial(seeded_scene, 2, num_views=3, num_points=3, noise=1.0, skew=5.0),
    partial(seeded_scene, 3, num_views=5, num_points=4, noise=1.0),
)
_SEGMENTS = (
    *_POSED[:5],
    *(partial(named_scene, name) for name in DEGENERATE_SCENES),
    partial(seeded_scene, 2, num_points=9, skew=5.0),
)
_MAPS = (
    partial(seeded_map, 0),
    partial(seeded_map, 0, stride=(2, 2)),
    partial(seeded_map, 1, stride=(4, 8)),
    partial(seeded_map, 2, stride=(8, 4), channels=3, num_pixels=7),
)
_SCORES = (
    partial(seeded_scores, 0),
    partial(seeded_scores, 1, size=(2, 2)),
    partial(seeded_scores, 2, size=(3, 4), dims=2, masked=True),
)
_DEPTHS = (
    partial(seeded_depths, 0),
    partial(seeded_depths, 1, num_points=3),
    partial(seeded_depths, 2, num_points=9, image_size=(3, 4)),
    partial(seeded_depths, 3, num_points=24, image_size=(3, 4)),
)
_OTHERS: dict[str, tuple[partial[Any], ...]] = {
    "ties": tuple(partial(named_scene, name) for name in _TIES),
    "named": tuple(
        partial(named_scene, name, dtype=dtype)
        for name in DEGENERATE_SCENES
        for dtype in (torch.float64, torch.float32)
    ),
    "segments": _SEGMENTS,
    "maps": _MAPS,
    "scores": _SCORES,
    "depths": _DEPTHS,
}


def scenes_for(invariant: Invariant) -> list[partial[Any]]:
    """The fixed scenes of an invariant, smallest first, as the calls that make them."""
    if invariant.scenes == "posed":
        least = invariant.least_views
        return [make for make in _POSED if make.keywords.get("num_views", 2) >= least]
    return list(_OTHERS[invariant.scenes])
