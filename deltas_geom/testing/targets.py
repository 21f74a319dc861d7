"""What an implementation under test offers, and the ready-made ones: deltas, kornia, OpenCV.

A :class:`Target` speaks plain tensors, so that wrapping your own function takes a line. What
it leaves out is not tested.
"""

from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
from typing import Literal

import torch
from kornia.geometry.epipolar import fundamental_from_projections
from kornia.geometry.epipolar import triangulate_points as kornia_triangulate_points
from torch import Tensor

from deltas_geom.fundamental import fundamental_between
from deltas_geom.projection import project
from deltas_geom.triangulation import triangulate_points
from deltas_geom.views import PosedViews

KorniaSolver = Literal["eigh", "svd", "cofactor"]
KORNIA_SOLVERS: tuple[KorniaSolver, ...] = ("eigh", "svd", "cofactor")


@dataclass(frozen=True)
class Target:
    """An implementation under test. Conventions are ours (docs/conventions.md), no batch dims.

    Attributes:
        name: head of its column in the table.
        project: ``(K (V, 3, 3), cam_from_world (V, 4, 4), points (N, 3)) -> pixels (V, N, 2)``.
        fundamental: ``(K (2, 3, 3), cam_from_world (2, 4, 4)) -> F (3, 3)`` of any scale and
            sign, with x1^T F x0 = 0 for pixels x0 of view 0 and x1 of view 1.
        triangulate: ``(proj (V, 3, 4), pixels (V, N, 2), weights (V, N) or None) -> points
            (N, 3)`` in the world, metres; ``weights`` multiply the equations, None = all 1.
        max_views: the most views that ``triangulate`` takes; None = any number.
        weighted: whether ``triangulate`` heeds weights; if not, it is called with None.
        differentiable: whether autograd goes through ``triangulate``.

    Example:
        >>> mine = Target("mine", triangulate=triangulate_points, max_views=2, weighted=False)
        >>> mine.offers("weights"), mine.offers("project")
        (False, False)
    """

    name: str
    project: Callable[[Tensor, Tensor, Tensor], Tensor] | None = None
    fundamental: Callable[[Tensor, Tensor], Tensor] | None = None
    triangulate: Callable[[Tensor, Tensor, Tensor | None], Tensor] | None = None
    max_views: int | None = None
    weighted: bool = True
    differentiable: bool = True

    def __post_init__(self) -> None:
        if self.max_views is not None and self.max_views < 2:
            raise ValueError(f"max_views must be 2 or more, or None, got {self.max_views}")

    def offers(self, feature: str) -> bool:
        """Whether there is something to test.

        Args:
            feature: "project", "fundamental", "triangulate", "weights" or "gradients" (of
                triangulation), "many views" (three and more).
        """
        triangulates = self.triangulate is not None
        offered = {
            "project": self.project is not None,
            "fundamental": self.fundamental is not None,
            "triangulate": triangulates,
            "weights": triangulates and self.weighted,
            "gradients": triangulates and self.differentiable,
            "many views": triangulates and (self.max_views is None or self.max_views >= 3),
        }
        return offered[feature]


def deltas() -> Target:
    """Ours: everything, with triangulation in the rig frame."""

    def pixels(K: Tensor, cam_from_world: Tensor, points: Tensor) -> Tensor:
        return project(PosedViews(K, cam_from_world), points).pixels

    def fundamental(K: Tensor, cam_from_world: Tensor) -> Tensor:
        return fundamental_between(PosedViews(K, cam_from_world))

    return Target("deltas", pixels, fundamental, triangulate_points)


def kornia(solver: KorniaSolver = "eigh") -> Target:
    """kornia's camera, fundamental matrix, and two-view triangulation without weights."""

    def pixels(K: Tensor, cam_from_world: Tensor, points: Tensor) -> Tensor:
        # Of all sizes: the projection does not look at the image.
        camera = PosedViews(K, cam_from_world).to_kornia(image_size=(1, 1))
        found: Tensor = camera.project(points.expand(K.shape[0], *points.shape))
        return found

    def fundamental(K: Tensor, cam_from_world: Tensor) -> Tensor:
        proj = PosedViews(K, cam_from_world).proj
        found: Tensor = fundamental_from_projections(proj[:1], proj[1:])[0]
        return found

    def points(proj: Tensor, pixels: Tensor, weights: Tensor | None) -> Tensor:
        first, second = pixels[:1], pixels[1:]
        found: Tensor = kornia_triangulate_points(proj[:1], proj[1:], first, second, solver=solver)
        return found[0]

    return Target(f"kornia {solver}", pixels, fundamental, points, max_views=2, weighted=False)


def opencv() -> Target:
    """OpenCV's ``projectPoints`` and ``triangulatePoints``: two views, no weights, no gradient.

    Its fundamental matrices are estimated from matches: there is none of given cameras.

    Raises:
        ImportError: OpenCV is not installed.
    """
    cv2 = _import_opencv()

    def pixels(K: Tensor, cam_from_world: Tensor, points: Tensor) -> Tensor:
        views = []
        for k, pose in zip(K.numpy(), cam_from_world.numpy(), strict=True):
            turn, _ = cv2.Rodrigues(pose[:3, :3])
            found, _ = cv2.projectPoints(points.numpy(), turn, pose[:3, 3], k, None)
            views.append(torch.from_numpy(found[:, 0]))
        return torch.stack(views)

    def points(proj: Tensor, pixels: Tensor, weights: Tensor | None) -> Tensor:
        first, second = (view.numpy().T for view in pixels)
        homogeneous = cv2.triangulatePoints(proj[0].numpy(), proj[1].numpy(), first, second)
        return torch.from_numpy(cv2.convertPointsFromHomogeneous(homogeneous.T)[:, 0])

    return Target("opencv", pixels, None, points, max_views=2, weighted=False, differentiable=False)


def _import_opencv() -> ModuleType:
    try:
        import cv2
    except ImportError as error:
        raise ImportError(
            "deltas_geom.testing.targets.opencv needs OpenCV: pip install 'deltas-depth[test]'"
        ) from error
    module: ModuleType = cv2
    return module
