"""Captures with one planted fault each, for the tests of ``diagnose``."""

from collections.abc import Callable

import pytest
import torch
from hypothesis import strategies as st
from torch import Tensor

from deltas_geom import PosedViews, diagnose, invert_pose, project, to_homogeneous
from deltas_geom.diagnosis.causes import Cause
from deltas_geom.diagnosis.results import Diagnosis
from deltas_geom.testing import intrinsics_per_view, rigid
from deltas_geom.testing.strategies import vectors

Capture = tuple[Tensor, Tensor, Tensor]
"""K (V, 3, 3), cam_from_world (V, 4, 4), pixels (V, N, 2)."""
Fault = Callable[[Tensor, Tensor, Tensor], Capture]

FLIP = torch.diag(torch.tensor([1.0, -1, -1, 1]).double())
SIZE = torch.tensor([640.0, 480.0]).double()


def seen_by(turn: Tensor, center: Tensor, *, num_points: int = 150, one_K: bool = False) -> Capture:
    """Cameras ``(V, 3)`` rad and ``(V, 3)`` m, and a cloud 2 to 8 m ahead of the first.

    The world's frame is elsewhere, as it is in captures.
    """
    world = rigid(torch.tensor([0.7, -1.1, 0.4]).double(), torch.tensor([2.0, -1.0, 3.0]).double())
    pose = rigid(turn, torch.zeros_like(turn))
    pose[:, :3, 3:] = -pose[:, :3, :3] @ center[..., None]
    generator = torch.Generator().manual_seed(0)
    x, y, depth = torch.rand(3, num_points, generator=generator).double()
    depth = 2 + 6 * depth
    points = torch.stack([(1.2 * x - 0.6) * depth, (y - 0.5) * depth, depth], dim=-1)
    K = intrinsics_per_view(len(turn))
    if one_K:
        K = K[:1].repeat(len(turn), 1, 1)
    return K, pose @ world, project(PosedViews(K, pose), points).pixels


@st.composite
def captures(draw: st.DrawFn, kind: str, num_views: int = 5) -> Capture:
    """Cameras of a kind of motion, each up to 3 degrees and some cm from a pattern."""
    step = torch.arange(num_views).double()
    turn = torch.stack(
        [0.2 * (1.9 * step).sin(), 0.2 * (1.3 * step).cos(), 0.15 * (2.3 * step).sin()], -1
    )
    if kind == "general":
        center = torch.stack(
            [0.5 * step.sin(), 0.4 * (1.7 * step).cos(), 0.4 * (2.9 * step).sin()], -1
        )
    elif kind == "forward":
        center = torch.stack([0.1 * (2 * step).sin(), 0.1 * (3 * step).cos(), 0.15 * step], -1)
    else:  # handheld: small turns, small steps to the side
        turn = 0.25 * turn
        center = torch.stack([0.08 * step, 0.03 * (2 * step).sin(), 0.05 * step.sin()], -1)
    turn = turn + draw(vectors(num_views, within=0.03))
    return seen_by(turn, center + draw(vectors(num_views, within=0.02)))


def spoiled(pixels: Tensor, *, noise: float = 1.0, wrong: float = 0.2) -> Tensor:
    """Noise of ``noise`` px, and a share ``wrong`` of pixels anywhere in the image."""
    generator = torch.Generator().manual_seed(1)
    pixels = pixels + noise * torch.randn(pixels.shape, generator=generator).double()
    anywhere = torch.rand(pixels.shape, generator=generator).double() * SIZE
    bad = torch.rand(pixels.shape[:-1], generator=generator) < wrong
    return torch.where(bad[..., None], anywhere, pixels)


def of_another_size(K: Tensor, factor: float) -> Tensor:
    changed = K * factor
    changed[:, 2, 2] = 1
    changed[:, :2, 2] = factor * (K[:, :2, 2] + 0.5) - 0.5
    return changed


def with_focal_lengths(K: Tensor, factor: float) -> Tensor:
    changed = K.clone()
    changed[:, :2, :2] *= factor
    return changed


def transposed(pose: Tensor) -> Tensor:
    changed = pose.clone()
    changed[:, :3, :3] = pose[:, :3, :3].mT
    return changed


def with_translation(pose: Tensor, translation: Tensor) -> Tensor:
    changed = pose.clone()
    changed[:, :3, 3] = translation
    return changed


def only(camera: int, fault: Fault) -> Fault:
    """The fault in one camera."""

    def planted(*capture: Tensor) -> Capture:
        chosen = torch.arange(len(capture[0])) == camera
        K, pose, pixels = (
            torch.where(chosen[:, None, None], wrong, right)
            for wrong, right in zip(fault(*capture), capture, strict=True)
        )
        return K, pose, pixels

    return planted


def rays_of(K: Tensor, pixels: Tensor) -> Tensor:
    return to_homogeneous(pixels) @ K.inverse().mT


def exchanged(K: Tensor, pose: Tensor, pixels: Tensor) -> Capture:
    order = torch.arange(len(K))
    order[[1, 2]] = order[[2, 1]]
    return K, pose, pixels[order]


GLOBAL: dict[Cause, Fault] = {
    Cause.POSES_INVERTED: lambda K, T, x: (K, invert_pose(T), x),
    Cause.OPENGL_WORLD_FROM_CAM: lambda K, T, x: (K, invert_pose(T) @ FLIP, x),
    Cause.OPENGL_AXES: lambda K, T, x: (K, FLIP @ T, x),
    Cause.ROTATIONS_TRANSPOSED: lambda K, T, x: (K, transposed(T), x),
    Cause.ROTATIONS_INVERTED: lambda K, T, x: (K, invert_pose(transposed(invert_pose(T))), x),
    Cause.CENTERS_AS_TRANSLATIONS: lambda K, T, x: (
        K,
        with_translation(T, invert_pose(T)[:, :3, 3]),
        x,
    ),
    Cause.K_TRANSPOSED: lambda K, T, x: (K.mT, T, x),
    Cause.K_OF_OTHER_SIZE: lambda K, T, x: (of_another_size(K, 2.0), T, x),
    Cause.FOCAL_LENGTH: lambda K, T, x: (with_focal_lengths(K, 1.6), T, x),
    Cause.CROPPED: lambda K, T, x: (K, T, x - torch.tensor([160.0, 120.0])),
    Cause.PIXELS_NORMALIZED: lambda K, T, x: (K, T, rays_of(K, x)[..., :2]),
    Cause.AXES_SWAPPED: lambda K, T, x: (K, T, x.flip(-1)),
    Cause.VIEWS_SWAPPED: exchanged,
}
OF_ONE: dict[Cause, Fault] = {
    Cause.UNIT_OF_TRANSLATION: only(
        2, lambda K, T, x: (K, with_translation(T, 1e3 * T[:, :3, 3]), x)
    ),
    Cause.CAMERA_DISAGREES: only(
        2,
        lambda K, T, x: (K, with_translation(T, T[:, :3, 3] + torch.tensor([0.2, 0.15, -0.2])), x),
    ),
    Cause.K_OF_OTHER_SIZE: only(2, lambda K, T, x: (of_another_size(K, 0.5), T, x)),
    Cause.POSES_INVERTED: only(2, lambda K, T, x: (K, invert_pose(T), x)),
    Cause.OPENGL_WORLD_FROM_CAM: only(2, lambda K, T, x: (K, invert_pose(T) @ FLIP, x)),
    Cause.AXES_SWAPPED: only(2, lambda K, T, x: (K, T, x.flip(-1))),
}
FAULTS = [
    *(("all", *item) for item in GLOBAL.items()),
    *(("one", *item) for item in OF_ONE.items()),
]
NAMED = pytest.mark.parametrize(
    ("whose", "cause", "fault"), FAULTS, ids=[f"{cause.name}-{whose}" for whose, cause, _ in FAULTS]
)


def diagnosed(capture: Capture) -> Diagnosis:
    return diagnose(PosedViews(*capture[:2]), capture[2])


def concerned(whose: str, cause: Cause) -> tuple[int, ...]:
    return (1, 2) if cause is Cause.VIEWS_SWAPPED else () if whose == "all" else (2,)
