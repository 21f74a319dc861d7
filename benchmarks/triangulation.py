"""Triangulation beside its peers: one thread, answers first, ratios from one run.

python benchmarks/triangulation.py [forward] [two-view] [float64] [compiled] [backward] [singly]
    [transposed] [threads] [busy]

Peers that are not installed are left out: pip install 'deltas-depth[test]' pycolmap gtsam
"""

import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from deltas_geom import PosedViews, project, refine_points, triangulate, triangulate_points
from deltas_geom.testing import rigid
from deltas_geom.testing.targets import KORNIA_SOLVERS, kornia, opencv

NUM_POINTS = 100_000
REPEATS = 11
# Inductor would cut the one loop into pieces, and carry everything between them through memory.
# It would also give up vector instructions where pixels are not next to each other in memory.
COMPILED = {
    "fullgraph": True,
    "dynamic": False,
    "options": {"max_fusion_size": 2000, "cpp.enable_tiling_heuristics": False},
}
Scene = tuple[Tensor, Tensor, Tensor, Tensor]


def svd_dlt(proj: Tensor, pixels: Tensor, weights: Tensor) -> Tensor:
    """Textbook DLT: one SVD per point."""
    rows = pixels[..., None] * proj[:, None, 2:3] - proj[:, None, :2]
    rows = (rows * weights[..., None, None]).transpose(0, 1).flatten(1, 2)
    vector = torch.linalg.svd(rows, full_matrices=False)[2][:, -1]
    return vector[:, :3] / vector[:, 3:]


def scene(num_views: int) -> Scene:
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


def milliseconds(*runs: Callable[[], object]) -> list[float]:
    """Least processor time of each, to which a busy machine only adds; taken in turns."""
    times: list[list[float]] = [[] for _ in runs]
    for repeat in range(REPEATS + 1):
        for run, seen in zip(runs, times, strict=True):
            began = time.process_time()
            run()
            if repeat:  # the first is a warm-up
                seen.append(time.process_time() - began)
    return [1000 * min(seen) for seen in times]


def check(points: Tensor, found: Tensor, peer: Tensor) -> None:
    """Not worth timing unless as accurate."""
    ours, theirs = ((x - points).norm(dim=-1).median() for x in (found, peer))
    assert ours <= 1.02 * theirs, f"median error {ours:.4f} m, the peer's {theirs:.4f} m"


def row(name: str, ours: float, peers: dict[str, tuple[float, str]]) -> None:
    """One line: our time, and how many times as long each peer takes; its goal in brackets."""
    shown = "  ".join(
        f"{peer} {ms:.0f} = {ms / ours:.1f}x ({goal})" for peer, (ms, goal) in peers.items()
    )
    print(f"{name:<34} {ours:7.1f} ms   {shown}", flush=True)


@torch.no_grad()
def forward() -> None:
    for num_views in (2, 3, 5, 8):
        proj, pixels, weights, points = scene(num_views)
        check(points, triangulate_points(proj, pixels, weights), svd_dlt(proj, pixels, weights))
        start = triangulate_points(proj, pixels, weights)
        ours, svd, known, noise, step = milliseconds(
            lambda: triangulate_points(proj, pixels, weights),  # noqa: B023
            lambda: svd_dlt(proj, pixels, weights),  # noqa: B023
            lambda: triangulate(proj, pixels, weights),  # noqa: B023
            lambda: triangulate(proj, pixels, weights, covariance=True),  # noqa: B023
            lambda: refine_points(proj, pixels, start, weights),  # noqa: B023
        )
        row(f"{num_views} views, points alone", ours, {"torch SVD": (svd, "8")})
        shares = f"covariance {(noise - known) / known:.2f} (0.7), one Gauss-Newton step"
        print(f"{'':4}with status, residual, parallax {known:.1f} ms; of that: {shares}", end=" ")
        print(f"{step / known:.2f} (1), of points alone {step / ours:.2f}", flush=True)


@torch.no_grad()
def two_view() -> None:
    proj, pixels, _, points = scene(2)
    peers = {"OpenCV": (opencv(), "2")} | {
        f"kornia {solver}": (kornia(solver), goal)
        for solver, goal in zip(KORNIA_SOLVERS, ("6", "10", "2"), strict=True)
    }
    runs = [lambda: triangulate_points(proj, pixels)]
    for target, _ in peers.values():
        solve = target.triangulate
        assert solve is not None
        check(points, triangulate_points(proj, pixels), solve(proj, pixels, None))
        runs.append(lambda solve=solve: solve(proj, pixels, None))  # type: ignore[misc]
    ours, *theirs = milliseconds(*runs)
    goals = [goal for _, goal in peers.values()]
    row("2 views, no weights", ours, dict(zip(peers, zip(theirs, goals, strict=True), strict=True)))


@torch.no_grad()
def float64() -> None:
    for num_views in (2, 5, 8):
        proj, pixels, weights, points = (t.double() for t in scene(num_views))
        check(points, triangulate_points(proj, pixels, weights), svd_dlt(proj, pixels, weights))
        ours, svd = milliseconds(
            lambda: triangulate_points(proj, pixels, weights),  # noqa: B023
            lambda: svd_dlt(proj, pixels, weights),  # noqa: B023
        )
        row(f"{num_views} views, float64", ours, {"torch SVD": (svd, "5")})


@torch.no_grad()
def compiled() -> None:
    for num_views in (2, 5):
        proj, pixels, weights, points = scene(num_views)
        fast = torch.compile(triangulate_points, **COMPILED)  # type: ignore[call-overload]
        check(points, fast(proj, pixels, weights), svd_dlt(proj, pixels, weights))
        ours, svd = milliseconds(
            lambda: fast(proj, pixels, weights),  # noqa: B023
            lambda: svd_dlt(proj, pixels, weights),  # noqa: B023
        )
        row(f"{num_views} views, compiled", ours, {"torch SVD": (svd, "20")})


def kept(solve: Callable[..., Tensor], inputs: list[Tensor]) -> float:
    """Megabytes that autograd keeps for backward, inputs included."""
    storages = {}

    def pack(tensor: Tensor) -> Tensor:
        storage = tensor.untyped_storage()
        storages[storage.data_ptr()] = storage.nbytes()
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor):
        solve(*inputs)
    return sum(storages.values()) / 1e6


def _there_and_back(solve: Callable[..., Tensor], inputs: list[Tensor]) -> None:
    solve(*inputs).sum().backward()


def backward() -> None:
    for num_views in (2, 5):
        *tensors, points = scene(num_views)
        inputs = [tensor.requires_grad_() for tensor in tensors]
        fast = torch.compile(triangulate_points, **COMPILED)  # type: ignore[call-overload]
        solvers: list[Callable[..., Tensor]] = [triangulate_points, fast, svd_dlt]
        if num_views == 2:
            cofactor = kornia("cofactor").triangulate
            solvers.append(lambda proj, pixels, weights: cofactor(proj, pixels, None))  # noqa: B023
        check(points, triangulate_points(*inputs), svd_dlt(*inputs))
        gradients = [torch.autograd.grad(f(*inputs).sum(), inputs[1])[0] for f in solvers[:2]]
        torch.testing.assert_close(gradients[0], gradients[1], rtol=1e-3, atol=1e-5)
        runs = [partial(_there_and_back, solve, inputs) for solve in solvers[:3]]
        ours, quick, svd = milliseconds(*runs)
        row(f"{num_views} views, forward + backward", ours, {"torch SVD": (svd, "2.2")})
        row(f"{num_views} views, the same compiled", quick, {"torch SVD": (svd, "7")})
        ours_mb, _, svd_mb, *other = (kept(f, inputs) for f in solvers)
        shown = f"torch SVD {svd_mb:.1f} = {svd_mb / ours_mb:.1f}x (4)"
        if other:
            shown += f", kornia cofactor {other[0]:.1f} = {other[0] / ours_mb:.1f}x (8)"
        print(f"{'':4}kept for backward: {ours_mb:.1f} MB, {shown}", flush=True)


@torch.no_grad()
def singly() -> None:
    """Libraries that take a point at a time, from Python, on some of the points."""
    few = 5000
    for num_views in (2, 5):
        proj, pixels, _, points = scene(num_views)
        ours = milliseconds(lambda: triangulate_points(proj, pixels))[0] / NUM_POINTS  # noqa: B023
        peers: dict[str, tuple[float, str]] = {}
        for name, make, goal in (("pycolmap", _pycolmap, "10"), ("gtsam", _gtsam, "40")):
            try:
                solve = make(proj, pixels[:, :few])
            except ImportError:
                continue
            check(points[:few], triangulate_points(proj, pixels[:, :few]), solve())
            peers[name] = (milliseconds(solve)[0] / few * NUM_POINTS, goal)
        row(f"{num_views} views, beside a point at a time", ours * NUM_POINTS, peers)


def _pycolmap(proj: Tensor, pixels: Tensor) -> Callable[[], Tensor]:
    import pycolmap

    # It takes calibrated rays: the intrinsics are those of the scene, known to be the same.
    K = torch.tensor([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]]).double()
    poses = [pose.numpy() for pose in torch.linalg.inv(K) @ proj.double()]
    rays = torch.nn.functional.pad((pixels.double() - K[:2, 2]) / 300, (0, 1), value=1.0)
    rays = torch.nn.functional.normalize(rays, dim=-1)
    seen = [ray.numpy() for ray in rays.transpose(0, 1)]

    def solve() -> Tensor:
        found = [pycolmap.triangulate_multi_view_point(poses, ray) for ray in seen]
        return torch.tensor([[float(x) for x in point] for point in found])

    return solve


def _gtsam(proj: Tensor, pixels: Tensor) -> Callable[[], Tensor]:
    import gtsam

    K = torch.tensor([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]]).double()
    calibration = gtsam.Cal3_S2(300.0, 300.0, 0.0, 160.0, 120.0)
    poses = gtsam.Pose3Vector()
    for extrinsic in torch.linalg.inv(K) @ proj.double():
        rotation, translation = extrinsic[:, :3], extrinsic[:, 3]
        center = (-rotation.mT @ translation).numpy()
        poses.append(gtsam.Pose3(gtsam.Rot3(rotation.mT.numpy()), center))
    seen = []
    for point in pixels.double().transpose(0, 1):
        matches = gtsam.Point2Vector()
        for pixel in point:
            matches.append(pixel.numpy())
        seen.append(matches)

    def solve() -> Tensor:
        found = [
            gtsam.triangulatePoint3(poses, calibration, one, 1e-9, False)  # rank, no refinement
            for one in seen
        ]
        return torch.tensor([[float(x) for x in point] for point in found])

    return solve


@torch.no_grad()
def transposed() -> None:
    """(N, V, 2) in memory, seen as (V, N, 2)."""
    for num_views in (2, 5):
        proj, pixels, weights, _ = scene(num_views)
        other = pixels.transpose(0, 1).contiguous().transpose(0, 1)
        straight, turned = milliseconds(
            lambda: triangulate_points(proj, pixels, weights),  # noqa: B023
            lambda: triangulate_points(proj, other, weights),  # noqa: B023
        )
        print(f"{num_views} views, transposed: {turned / straight:.2f} of the time (at most 1.1)")


def wall_and_processor(run: Callable[[], object], repeats: int) -> tuple[float, float]:
    """Median milliseconds of a call."""
    walls, processors = [], []
    for repeat in range(repeats + 1):
        wall, processor = time.perf_counter(), time.process_time()
        run()
        if repeat:
            walls.append(time.perf_counter() - wall)
            processors.append(time.process_time() - processor)
    return 1000 * statistics.median(walls), 1000 * statistics.median(processors)


@torch.no_grad()
def threads() -> None:
    """Two threads beside one: they must not cost anything."""
    for count in (1000, 10_000, 100_000, 1_000_000):
        proj, pixels, weights, _ = scene(3)
        times = -(-count // NUM_POINTS)
        pixels = pixels.repeat(1, times, 1)[:, :count].contiguous()
        weights = weights.repeat(1, times)[:, :count].contiguous()
        found = []
        for number in (1, 2, 1, 2):  # in turns, so that all see the same machine
            torch.set_num_threads(number)
            repeats = max(3, 200_000 // count)
            found.append(
                wall_and_processor(lambda: triangulate_points(proj, pixels, weights), repeats)  # noqa: B023
            )
        torch.set_num_threads(1)
        one, two = (tuple(map(min, zip(*found[k::2], strict=True))) for k in (0, 1))
        shown = f"wall {two[0] / one[0]:.2f} (1), processor {two[1] / one[1]:.2f} (1.3)"
        print(f"{count} points, two threads by one: {shown}", flush=True)


def busy() -> None:
    """With default threads, beside a process that keeps another core busy."""
    torch.set_num_threads(os.cpu_count() or 1)
    other = subprocess.Popen([sys.executable, "-c", "while True: pass"])
    try:
        for num_views in (2, 3, 5):
            proj, pixels, weights, _ = scene(num_views)
            inputs = [tensor.clone().requires_grad_() for tensor in (proj, pixels, weights)]
            shown = []
            for ours, svd, goal in (
                (
                    lambda: triangulate_points(proj, pixels, weights),  # noqa: B023
                    lambda: svd_dlt(proj, pixels, weights),  # noqa: B023
                    "7",
                ),
                (
                    lambda: _there_and_back(triangulate_points, inputs),  # noqa: B023
                    lambda: _there_and_back(svd_dlt, inputs),  # noqa: B023
                    "2.2",
                ),
            ):
                mine, theirs = (wall_and_processor(run, 5)[0] for run in (ours, svd))
                shown.append(f"{mine:.0f} ms, torch SVD {theirs / mine:.1f}x ({goal})")
            print(f"{num_views} views beside a busy process, wall: " + "; back too ".join(shown))
    finally:
        other.kill()
        torch.set_num_threads(1)


PARTS = {
    "forward": forward,
    "two-view": two_view,
    "float64": float64,
    "compiled": compiled,
    "backward": backward,
    "singly": singly,
    "transposed": transposed,
    "threads": threads,
    "busy": busy,
}


def main() -> None:
    torch.set_num_threads(1)
    print(f"{NUM_POINTS} points, milliseconds of processor time; (goals) are 'at least'")
    for name in sys.argv[1:] or PARTS:
        PARTS[name]()


if __name__ == "__main__":
    main()
