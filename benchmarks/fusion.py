"""Fused depth: beside Open3D, its memory in a flat, and how good what becomes of our maps is.

    python benchmarks/fusion.py open3d CAPTURE [VOXEL]   # of sensor depth; pip install open3d-cpu
    python benchmarks/fusion.py flat [VOXEL]             # a flat of 10 x 10 x 3 m, furnished
    python benchmarks/fusion.py maps CAPTURE DEPTHS      # DEPTHS of `deltas depth`

Distances to Open3D's mesh are from points spread over one mesh to the triangles of the other, in
voxels. Times are of integrating and meshing alone, of frames that are in memory; threads are those
that OMP_NUM_THREADS allows. Maps are scored against the fused sensor depth of the same frames, by
points spread evenly over surfaces; points where no sensor measured anything are left out.
"""

import itertools
import resource
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from deltas_nets import open_capture
from deltas_nets.fuse import Cloud, DepthView, Mesh, Volume, surface, without_small_parts
from deltas_nets.fuse.config import FuseConfig
from deltas_nets.fuse.fusing import SMALL_PART
from deltas_nets.fuse.prepared import PreparedViews
from deltas_nets.fuse.sources import DepthSource, Sensed, depth_source
from deltas_nets.fuse.threads import own_threads

Points = NDArray[np.float64]
NEAR, FAR = 0.05, 0.10  # m
DENSE = 0.01  # m between points that are spread over a mesh
ROUNDS = 3
VOXEL = 0.03  # m, of our maps


def main() -> None:
    if sys.argv[1] == "open3d":
        beside_open3d(Path(sys.argv[2]), float(sys.argv[3]) if len(sys.argv) > 3 else 0.02)
    elif sys.argv[1] == "flat":
        memory_of_a_flat(float(sys.argv[2]) if len(sys.argv) > 2 else 0.01)
    else:
        score_maps(Path(sys.argv[2]), Path(sys.argv[3]))


def beside_open3d(path: Path, voxel: float) -> None:
    import open3d as o3d

    source = Sensed(open_capture(path))
    views = [source.view(id) for id in source.ids]
    views = [view._replace(std=torch.ones_like(view.std)) for view in views]  # as Open3D weighs
    ways = {"ours": ours, "VoxelBlockGrid": block_grid}
    meshes: dict[str, Mesh] = {}
    threads = torch.get_num_threads()
    print(f"{path.name}, {len(views)} frames, voxels of {voxel:g} m, {threads} threads")
    print("  seconds to integrate, to mesh; of processor time; vertices")
    for name, fuse in ways.items():
        times = []
        for _ in range(ROUNDS):
            meshes[name], *seconds = fuse(views, voxel)
            times.append(seconds)
        a, b, c = np.min(times, axis=0)
        print(f"  {name:<14} {a:6.2f} {b:6.2f} {c:6.2f}  {len(meshes[name].vertices)}")
    scenes = [o3d.t.geometry.RaycastingScene() for _ in ways]
    for scene, mesh in zip(scenes, meshes.values(), strict=True):
        scene.add_triangles(mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32))
    for scene, mesh in zip(scenes[::-1], meshes.values(), strict=True):
        apart = scene.compute_distance(spread(mesh).astype(np.float32)).numpy() / voxel
        print(
            f"  to the other: {apart.mean():.3f} voxels, 99 % below {np.percentile(apart, 99):.2f}"
        )


def ours(views: Sequence[DepthView], voxel: float) -> tuple[Mesh, float, float, float]:
    def integrate() -> Volume:
        volume = Volume(voxel, threads=threads)
        for view in views:
            volume.add(view)
        return volume

    with own_threads() as threads:
        return timed(integrate, surface)


def block_grid(views: Sequence[DepthView], voxel: float) -> tuple[Mesh, float, float, float]:
    import open3d.core as o3c
    from open3d.t.geometry import Image, VoxelBlockGrid

    frames = [
        (
            Image(o3c.Tensor(view.depth.numpy())),
            Image(o3c.Tensor(view.colors.numpy().astype(np.float32) / 255)),
            o3c.Tensor(view.K.numpy()),
            o3c.Tensor(view.cam_from_world.numpy()),
        )
        for view in views
    ]

    def integrate() -> Any:
        kinds = (o3c.float32,) * 3
        names = ("tsdf", "weight", "color")
        grid = VoxelBlockGrid(names, kinds, (1, 1, 3), voxel, 16, 20_000, o3c.Device("CPU:0"))
        for depth, color, K, pose in frames:
            blocks = grid.compute_unique_block_coordinates(depth, K, pose, 1.0, 100.0, 4.0)
            grid.integrate(blocks, depth, color, K, K, pose, 1.0, 100.0, 4.0)
        return grid

    def mesh(grid: Any) -> Mesh:
        found = grid.extract_triangle_mesh(0.0)
        vertices = found.vertex.positions.numpy().astype(np.float64)
        return Mesh(vertices, np.zeros((0, 3), np.uint8), found.triangle.indices.numpy())

    return timed(integrate, mesh)


def timed(
    integrate: Callable[[], Any], mesh: Callable[[Any], Mesh]
) -> tuple[Mesh, float, float, float]:
    """The mesh; seconds to integrate, to mesh, and of the processor for both."""
    began, used = time.perf_counter(), time.process_time()
    volume = integrate()
    between = time.perf_counter()
    found = mesh(volume)
    ended = time.perf_counter()
    return found, between - began, ended - between, time.process_time() - used


def spread(mesh: Mesh, apart: float = DENSE) -> Points:
    """Points spread over a mesh at random, one for each square of a side."""
    areas = mesh.areas()
    random = np.random.default_rng(0)
    count = int(areas.sum() / apart**2)
    a, b, c = mesh.vertices[
        mesh.faces[random.choice(len(areas), count, p=areas / areas.sum())]
    ].swapaxes(0, 1)
    u, v = random.random((2, count, 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    spread_points: Points = a + u * (b - a) + v * (c - a)
    return spread_points


def memory_of_a_flat(voxel: float) -> None:
    """Frames of 240 x 320 that look around in a box of 10 x 10 x 3 m with boxes in it."""
    volume, cloud, count, used = Volume(voxel), Cloud(voxel), 0, 0.0
    for view in flat_views():
        began = time.process_time()
        volume.add(view)
        cloud.add(view)
        count, used = count + 1, used + time.process_time() - began
    blocks, points = len(volume.blocks), len(cloud)
    began = time.process_time()
    mesh = without_small_parts(surface(volume), SMALL_PART * voxel**2)
    meshing = time.process_time() - began
    print(
        f"{count} frames, {voxel:g} m: {used / count:.3f} s of the processor a frame, "
        f"{meshing:.1f} s to mesh; {blocks} blocks, {points} points, "
        f"{len(mesh.faces)} faces, {mesh.areas().sum():.0f} m2; peak {peak():.2f} GB"
    )


def peak() -> float:
    """Gigabytes of this process, at most, so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


def flat_views() -> Iterable[DepthView]:
    random = np.random.default_rng(0)
    low = [np.array([0.0, 0, 0])]
    high = [np.array([10.0, 10, 3])]
    for _ in range(12):  # tables, shelves
        corner = random.uniform([0.5, 0.5, 0], [8, 8, 0])
        low.append(corner)
        high.append(corner + random.uniform([0.4, 0.4, 0.4], [1.5, 1.5, 2.0]))
    size, K = (240, 320), np.array([[260.0, 0, 159.5], [0, 260, 119.5], [0, 0, 1]])
    x, y = np.meshgrid(np.arange(size[1]), np.arange(size[0]))
    rays = np.stack(((x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones(size)), axis=-1)
    for place in np.stack(np.meshgrid([2, 4, 6, 8], [2, 4, 6, 8]), axis=-1).reshape(-1, 2):
        for turn in np.arange(8) * np.pi / 4:
            for tilt in (-0.6, 0.0, 0.6):
                ahead = np.array(
                    [np.cos(turn) * np.cos(tilt), np.sin(turn) * np.cos(tilt), np.sin(tilt)]
                )
                right = np.array([np.sin(turn), -np.cos(turn), 0])
                rotation = np.stack((right, np.cross(ahead, right), ahead))
                centre = np.array([*place, 1.5])
                if any(
                    (centre > a).all() and (centre < b).all()
                    for a, b in zip(low[1:], high[1:], strict=True)
                ):
                    continue
                pose = np.eye(4)
                pose[:3, :3], pose[:3, 3] = rotation, -rotation @ centre
                depth = torch.from_numpy(seen_depth(centre, rays @ rotation, low, high)).float()
                colors = (60 * rays @ rotation + 128).clip(0, 255).astype(np.uint8)
                yield DepthView(
                    depth,
                    0.01 * depth,
                    torch.from_numpy(colors),
                    torch.tensor(K),
                    torch.tensor(pose),
                )


def seen_depth(
    centre: Points, rays: Points, low: Sequence[Points], high: Sequence[Points]
) -> Points:
    """Of rays from inside of the first box and outside of the others, along z where rays have 1."""
    with np.errstate(divide="ignore"):
        ways = [((a - centre) / rays, (b - centre) / rays) for a, b in zip(low, high, strict=True)]
    depth: Points = np.maximum(*ways[0]).min(axis=-1)
    for a, b in ways[1:]:
        near, far = np.minimum(a, b).max(axis=-1), np.maximum(a, b).min(axis=-1)
        depth = np.where((near < far) & (near > 0), np.minimum(depth, near), depth)
    return depth


class Truth(NamedTuple):
    views: Sequence[DepthView]
    points: Points
    tree: Any


def score_maps(path: Path, depths: Path) -> None:
    """Accuracy, completeness and F-score of meshes and clouds, fused in several ways."""
    capture = open_capture(path).remembering()
    predicted = depth_source(capture, depths)
    sensor = Sensed(capture)
    true_views = [sensor.view(id) for id in predicted.ids]
    true_cloud = Cloud(0.02)
    for view in true_views:
        true_cloud.add(view)
    points = true_cloud.points().points
    truth = Truth(true_views, points, cKDTree(points))
    print(f"{path.name}, {len(predicted.ids)} maps; m, m, shares; at 5 cm")
    print("  confidence consistency sigma    accuracy completeness precision recall F-score >10 cm")
    ways = [(0.0, 0), (0.4, 0), (0.4, 1), (0.5, 2), (0.6, 3), (0.7, 3)]
    for (least, agree), weighed in itertools.product(ways, (False, True)):
        source = depth_source(capture, depths, min_confidence=least)
        views = views_of(source, FuseConfig(neighbours=8 if agree else 0, least=max(agree, 1)))
        if not weighed:
            views = [view._replace(std=torch.full_like(view.std, 0.1)) for view in views]
        mesh = surface(volume_of(views, VOXEL, 5 * VOXEL))
        mesh = without_small_parts(mesh, SMALL_PART * VOXEL**2)
        cloud = Cloud(VOXEL)
        for view in views:
            cloud.add(view)
        words = f"  {least:<10} {agree or 'no':<11} {'yes' if weighed else 'no':<5}"
        print(words, "mesh ", score(spread(mesh, 0.02), truth), flush=True)
        print(words, "cloud", score(cloud.points().points, truth), flush=True)


def views_of(source: DepthSource, config: FuseConfig) -> list[DepthView]:
    prepared = PreparedViews(source, config)
    return [prepared.view(id) for id in source.ids]


def volume_of(views: Sequence[DepthView], voxel: float, truncation: float) -> Volume:
    volume = Volume(voxel, truncation)
    for view in views:
        volume.add(view)
    return volume


def score(points: Points, truth: Truth) -> str:
    points = points[measured(points, truth.views)]
    if len(points) == 0:
        return "nothing"
    off, missed = truth.tree.query(points)[0], cKDTree(points).query(truth.points)[0]
    precision, recall = (off < NEAR).mean(), (missed < NEAR).mean()
    f_score = 2 * precision * recall / max(precision + recall, 1e-9)
    far = (off > FAR).mean()
    shares = f"{precision:.3f} {recall:.3f} {f_score:.3f}  {far:.3f}"
    return f"{off.mean():.4f} {missed.mean():.4f}  {shares}"


def measured(points: Points, views: Sequence[DepthView]) -> NDArray[np.bool_]:
    """Points along whose ray a sensor measured something, from one of its frames or more."""
    found = np.zeros(len(points), dtype=bool)
    for view in views:
        pose, K = view.cam_from_world.numpy(), view.K.numpy()
        x, y, z = K @ (pose[:3, :3] @ points.T + pose[:3, 3:])
        ahead = np.where(z > 1e-6, z, np.inf)
        column, row = np.rint(x / ahead).astype(int), np.rint(y / ahead).astype(int)
        height, width = view.image_size
        inside = (z > 1e-6) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        depth = view.depth.numpy()[row.clip(0, height - 1), column.clip(0, width - 1)]
        found |= inside & (depth > 0)
    return found


if __name__ == "__main__":
    main()
