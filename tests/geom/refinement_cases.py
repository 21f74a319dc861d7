"""Scenes with points to refine, and the cost that refinement lowers."""

import torch
from hypothesis import strategies as st
from torch import Tensor

from deltas_geom import PosedViews
from deltas_geom.testing import PosedScene, default_intrinsics, rigid, scene_from
from deltas_geom.testing.strategies import posed_scenes, vectors
from deltas_geom.triangulation.refine import Loss

NOISE = 0.5  # px
LOSSES: list[Loss] = ["squared", "huber", "cauchy"]
SCALE = 0.3  # px: some views are beyond it


@st.composite
def near_misses(draw: st.DrawFn, num_views: int = 3) -> tuple[PosedScene, Tensor, Tensor]:
    """Four points with noisy pixels, weights of 0.2 to 1, and a start up to 10 cm off."""
    scene = draw(posed_scenes(num_views=num_views))
    noise = draw(vectors(num_views * 4, within=NOISE, size=2)).reshape(num_views, 4, 2)
    weights = 0.6 + draw(vectors(num_views, within=0.4, size=4))
    start = scene.points + draw(vectors(4, within=0.1))
    return scene._replace(pixels=scene.pixels + noise), weights, start


def robust_cost(
    proj: Tensor, points: Tensor, pixels: Tensor, weights: Tensor, loss: Loss
) -> Tensor:
    """Weighted sum of the loss, ``(*B, N)``, term by term."""
    homogeneous = torch.cat([points, torch.ones_like(points[..., :1])], dim=-1)
    projected = homogeneous.unsqueeze(-3) @ proj.mT
    squared = (projected[..., :2] / projected[..., 2:] - pixels).square().sum(dim=-1)
    if loss == "huber":
        far = 2 * SCALE * squared.sqrt() - SCALE**2
        squared = torch.where(squared > SCALE**2, far, squared)
    elif loss == "cauchy":
        squared = SCALE**2 * torch.log1p(squared / SCALE**2)
    return (weights.square() * squared).sum(dim=-2)


def scene_at(angle: float, num_views: int, count: int) -> PosedScene:
    """Cameras on an arc of ``angle`` degrees around points 4 m away, 0.5 px of noise."""
    generator = torch.Generator().manual_seed(0)
    turns = torch.zeros(num_views, 3).double()
    turns[:, 1] = torch.linspace(-0.5, 0.5, num_views).double() * angle * torch.pi / 180
    pose = rigid(turns, torch.tensor([0.0, 0, 4]).double().expand(num_views, 3))
    views = PosedViews(default_intrinsics().expand(num_views, 3, 3), pose)
    points = torch.rand(count, 3, generator=generator, dtype=torch.float64) - 0.5
    scene = scene_from(views, points)
    noise = torch.randn(scene.pixels.shape, generator=generator, dtype=torch.float64)
    return scene._replace(pixels=scene.pixels + NOISE * noise)
