"""Noisy scenes and rays to triangulate, named ones with their status, and points by SVD."""

import torch
from hypothesis import strategies as st
from torch import Tensor

from deltas_geom import Status, invert_pose, to_homogeneous
from deltas_geom.testing import PosedScene, rigid
from deltas_geom.testing.strategies import posed_scenes, vectors

NOISE = 0.5  # px
NAMED_STATUS = {
    "zero_baseline": Status.NO_PARALLAX,
    "pure_rotation": Status.NO_PARALLAX,
    "right_angle": Status.OK,
    "ring": Status.OK,
    "forward_motion": Status.OK,
    "on_baseline": Status.NO_PARALLAX,
    "behind_camera": Status.BEHIND_CAMERA,
    "at_infinity": Status.AT_INFINITY,
}


@st.composite
def noisy(draw: st.DrawFn, num_views: int = 3) -> tuple[PosedScene, Tensor]:
    """A scene of four points whose pixels are off by up to NOISE, and weights of 0.2 to 1."""
    scene = draw(posed_scenes(num_views=num_views))
    noise = draw(vectors(num_views * 4, within=NOISE, size=2)).reshape(num_views, 4, 2)
    weights = 0.6 + draw(vectors(num_views, within=0.4, size=4))
    return scene._replace(pixels=scene.pixels + noise), weights


def rays_to(cam_from_world: Tensor, points: Tensor) -> Tensor:
    """In each camera's frame, of no particular length."""
    return to_homogeneous(points) @ cam_from_world[..., :3, :].mT


@st.composite
def surrounded(
    draw: st.DrawFn, num_views: int = 3, noise: float = 2e-3
) -> tuple[Tensor, Tensor, Tensor]:
    """Cameras turned any way, 0.5 m apart; noisy rays to points 2 m or more away; the points."""
    turn, shift = draw(vectors(num_views, within=3.0)), draw(vectors(num_views, within=0.1))
    corners = torch.tensor([[0.0, 0, 0], [0.5, 0, 0], [0, 0.5, 0], [0, 0, 0.5]]).double()
    poses = invert_pose(rigid(turn, corners[:num_views] + shift))
    sides = torch.tensor([[1.0, 1, 1], [-1, 1, 1], [1, -1, 1], [-1, -1, -1], [-1, 1, -1]]).double()
    points = 2.5 * sides + draw(vectors(5, within=0.5))
    off = draw(vectors(5 * num_views, within=noise)).reshape(num_views, 5, 3) if noise else 0.0
    return poses, torch.nn.functional.normalize(rays_to(poses, points), dim=-1) + off, points


def dlt_rows(proj: Tensor, pixels: Tensor, weights: Tensor) -> Tensor:
    """Rows ``(N, 2V, 4)`` of one scene, as in the book."""
    equations = pixels[..., None] * proj[:, None, 2:] - proj[:, None, :2]  # (V, N, 2, 4)
    return (weights[..., None, None] * equations).transpose(0, 1).flatten(1, 2)


def svd_points(proj: Tensor, pixels: Tensor, weights: Tensor) -> Tensor:
    null = torch.linalg.svd(dlt_rows(proj, pixels, weights)).Vh[:, -1]
    return null[:, :3] / null[:, 3:]
