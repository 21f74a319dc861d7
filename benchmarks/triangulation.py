"""Weighted n-view triangulation beside the SVD that it replaces, one thread, answers first.

python benchmarks/triangulation.py
"""

import statistics
import time
from collections.abc import Callable

import torch
from torch import Tensor

from deltas_geom import PosedViews, project, triangulate_points
from deltas_geom.testing import rigid

NUM_POINTS = 100_000
REPEATS = 5


def svd_dlt(proj: Tensor, pixels: Tensor, weights: Tensor) -> Tensor:
    """Textbook DLT: one SVD per point."""
    rows = pixels[..., None] * proj[:, None, 2:3] - proj[:, None, :2]
    rows = (rows * weights[..., None, None]).transpose(0, 1).flatten(1, 2)
    vector = torch.linalg.svd(rows, full_matrices=False)[2][:, -1]
    return vector[:, :3] / vector[:, 3:]


def scene(num_views: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Cameras in a row, points 3 to 6 m ahead, 0.5 px of noise; float32."""
    random = torch.Generator().manual_seed(num_views)
    K = torch.tensor([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]]).expand(num_views, 3, 3)
    turn = 0.05 * torch.randn(num_views, 3, generator=random)
    shift = torch.zeros(num_views, 3)
    shift[:, 0] = torch.linspace(-0.3, 0.3, num_views)
    views = PosedViews(K, rigid(turn, shift))
    points = torch.rand(NUM_POINTS, 3, generator=random) * 3 + torch.tensor([-1.5, -1.5, 3.0])
    pixels = project(views, points).pixels
    pixels = pixels + 0.5 * torch.randn(pixels.shape, generator=random)
    return views.proj, pixels, torch.rand(num_views, NUM_POINTS, generator=random) + 0.1, points


def milliseconds(run: Callable[[], object]) -> float:
    """Median processor time."""
    times = []
    for _ in range(REPEATS):
        began = time.process_time()
        run()
        times.append(time.process_time() - began)
    return 1000 * statistics.median(times)


def main() -> None:
    torch.set_num_threads(1)
    print(f"{NUM_POINTS} weighted points, float32, milliseconds of processor time")
    print(f"{'views':>5} {'ours':>8} {'torch SVD':>10} {'ratio':>6}   median error, ours / SVD, mm")
    for num_views in (2, 3, 5, 8):
        proj, pixels, weights, points = scene(num_views)
        ours, svd = triangulate_points(proj, pixels, weights), svd_dlt(proj, pixels, weights)
        errors = [1000 * float((found - points).norm(dim=-1).median()) for found in (ours, svd)]
        assert errors[0] <= 1.02 * errors[1], "less accurate than the SVD: not worth timing"
        fast = milliseconds(lambda: triangulate_points(proj, pixels, weights))  # noqa: B023
        slow = milliseconds(lambda: svd_dlt(proj, pixels, weights))  # noqa: B023
        shown = f"{errors[0]:.2f} / {errors[1]:.2f}"
        print(f"{num_views:>5} {fast:8.1f} {slow:10.1f} {slow / fast:6.1f}   {shown}")


if __name__ == "__main__":
    main()
