"""Finding wrong views: answers beside re-weighted least squares and COLMAP, then time, one thread.

python benchmarks/robust.py
"""

import time

import numpy as np
import torch
from torch import Tensor

from deltas_geom import PosedViews, project, refine_points, triangulate, triangulate_robust
from deltas_geom.testing import default_intrinsics, rigid

try:
    import pycolmap
except ImportError:
    pycolmap = None

IMAGE_SIZE = (480, 640)  # of default_intrinsics
THRESHOLD = 4.0  # px
NUM_POINTS, NUM_TIMED, NUM_COLMAP = 10_000, 100_000, 500
REPEATS = 3
Found = tuple[Tensor, Tensor]  # points (N, 3), NaN where they failed, and inliers (V, N)


def scene(num_views: int, share: float, count: int) -> tuple[PosedViews, Tensor, Tensor, Tensor]:
    """Cameras in a row of 1.2 m, points 3 to 7 m ahead, noise of 1 px; views, points, pixels, bad.

    A share of the matches is uniform in the image, and 10 px or more from the truth.
    """
    random = torch.Generator().manual_seed(num_views)
    turn = 0.05 * torch.randn(num_views, 3, generator=random).double()
    center = 0.05 * torch.randn(num_views, 3, generator=random).double()
    center[:, 0] += torch.linspace(-0.6, 0.6, num_views)
    pose = rigid(turn, torch.zeros_like(turn))
    pose[:, :3, 3:] = -pose[:, :3, :3] @ center[..., None]
    views = PosedViews(default_intrinsics().expand(num_views, 3, 3), pose)
    box, corner = torch.tensor([2.0, 1.6, 4.0]), torch.tensor([-1.0, -0.8, 3.0])
    points = torch.rand(count, 3, generator=random).double() * box + corner
    pixels = project(views, points).pixels
    pixels = pixels + torch.randn(pixels.shape, generator=random).double()
    size = torch.tensor(IMAGE_SIZE[::-1])
    anywhere = torch.rand(pixels.shape, generator=random).double() * size - 0.5
    bad = torch.rand(pixels.shape[:-1], generator=random) < share
    bad &= (anywhere - pixels).norm(dim=-1) > 10
    return views, points, torch.where(bad[..., None], anywhere, pixels), bad


def by_pairs(views: PosedViews, pixels: Tensor) -> Found:
    found = triangulate_robust(views.proj, pixels, threshold=THRESHOLD)
    return torch.where(found.valid[:, None], found.points, torch.nan), found.inliers


def by_reweighting(views: PosedViews, pixels: Tensor) -> Found:
    """Cauchy's loss from the DLT of all views, then the DLT of what is within the threshold."""
    start = triangulate(views.proj, pixels).points
    fit = refine_points(views.proj, pixels, start, steps=20, loss="cauchy", scale=1.5)
    seen = project(views, fit.points)
    near = (seen.pixels - pixels).norm(dim=-1) < THRESHOLD
    inliers = near & seen.in_front & fit.valid
    final = triangulate(views.proj, pixels, mask=inliers)
    return torch.where(final.valid[:, None], final.points, torch.nan), inliers


def by_colmap(views: PosedViews, pixels: Tensor) -> Found:
    """LO-RANSAC, one point at a time; COLMAP's pixel centres are at 0.5."""
    height, width = IMAGE_SIZE
    K = views.K[0]
    camera = pycolmap.Camera(
        model="PINHOLE",
        width=width,
        height=height,
        params=[float(K[0, 0]), float(K[1, 1]), float(K[0, 2]) + 0.5, float(K[1, 2]) + 0.5],
    )
    poses = [pycolmap.Rigid3d(pose[:3].numpy()) for pose in views.cam_from_world]
    options = pycolmap.EstimateTriangulationOptions()
    options.residual_type = pycolmap.TriangulationResidualType.REPROJECTION_ERROR
    options.ransac.max_error = THRESHOLD
    options.ransac.random_seed = 0
    points = np.full((pixels.shape[1], 3), np.nan)
    inliers = np.zeros(pixels.shape[:2], dtype=bool)
    for point, seen in enumerate((pixels + 0.5).transpose(0, 1).numpy()):
        found = pycolmap.estimate_triangulation(seen, poses, [camera] * len(poses), options)
        if found is not None:
            points[point], inliers[:, point] = found["xyz"], found["inliers"]
    return torch.from_numpy(points), torch.from_numpy(inliers)


def compared(found: Found, points: Tensor, bad: Tensor, known: Tensor) -> str:
    """Recall and precision of outliers, all views judged rightly, failures: %; error: mm.

    Args:
        found: the answer.
        points: ``(N, 3)`` the truth.
        bad: ``(V, N)`` the outliers.
        known: ``(N,)`` two or more views are right: others have no answer.
    """
    rejected, wrong = ~found[1][:, known], bad[:, known]
    both = (rejected & wrong).sum()
    recall, precision = both / wrong.sum(), both / rejected.sum()
    right = (rejected == wrong).all(dim=0).double().mean()
    error = (found[0] - points).norm(dim=-1)[known]
    failed = error.isnan().double().mean()
    shown = 1000 * error.nan_to_num(torch.inf).median()
    numbers = f"{100 * recall:6.1f} {100 * precision:6.1f} {100 * right:6.1f} {100 * failed:6.1f}"
    return f"{numbers} {shown:8.1f}"


def main() -> None:
    torch.set_num_threads(1)
    print(f"torch {torch.__version__}, pycolmap {getattr(pycolmap, '__version__', 'missing')}")
    print("recall, precision, all right, failed (%), median error (mm); us a point")
    print("views bad      ours                                 oracle   re-weighting")
    for num_views in (3, 4, 5, 8):
        for share in (0.1, 0.3, 0.5):
            views, points, pixels, bad = scene(num_views, share, NUM_POINTS)
            known = (~bad).sum(dim=0) >= 2
            oracle = triangulate(views.proj, pixels, mask=~bad)
            best = 1000 * (oracle.points - points).norm(dim=-1)[known & oracle.valid].median()
            found = by_pairs(views, pixels)
            off = 1000 * (found[0] - points).norm(dim=-1)[known].nanmedian()
            assert off < 1.05 * best, "worse than knowing the outliers: not worth timing"
            ours = compared(found, points, bad, known)
            other = compared(by_reweighting(views, pixels), points, bad, known)
            print(f"{num_views:>5} {100 * share:3.0f} {ours} {best:8.1f}   {other}")

    if pycolmap is not None:
        print(f"\n{NUM_COLMAP} points, ours above COLMAP's")
        for num_views in (3, 5, 8):
            for share in (0.1, 0.3, 0.5):
                views, points, pixels, bad = scene(num_views, share, NUM_COLMAP)
                known = (~bad).sum(dim=0) >= 2
                for find in (by_pairs, by_colmap):
                    began = time.process_time()
                    found = find(views, pixels)
                    spent = 1e6 * (time.process_time() - began) / NUM_COLMAP
                    shown = compared(found, points, bad, known)
                    print(f"{num_views:>5} {100 * share:3.0f} {shown} {spent:8.1f} us")

    print(f"\n{NUM_TIMED} points, float32, seconds of processor time (triangulation alone)")
    for num_views in (2, 3, 4, 5, 8, 16):
        views, _, pixels, _ = scene(num_views, 0.3, NUM_TIMED)
        proj, pixels = views.proj.float(), pixels.float()
        spent = []
        for find in (triangulate_robust, triangulate):
            times = []
            for _ in range(REPEATS):
                began = time.process_time()
                find(proj, pixels)
                times.append(time.process_time() - began)
            spent.append(min(times))
        print(f"{num_views:>5} {spent[0]:6.2f} ({spent[1]:.2f})")


if __name__ == "__main__":
    main()
