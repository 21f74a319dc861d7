"""Time and error of a map beside a classical PatchMatch, and beside networks of others.

    pip install --no-deps pyarchinit-photogrammetry-core
    python benchmarks/beside.py CAPTURE [VIEWS] [SETS] [PEERS/run.py]

CAPTURE has view_sets.json and sensor depth; SETS of its sets are looked at, by each the same.
PatchMatch (GPL, run here and imported nowhere else) sees the photos at the size that our network
chooses; where its cost is high it has no depth, as the coverage says. PEERS/run.py is a program of
your own that takes CAPTURE, names, NEAR, FAR and SETS and prints a line for each name.
"""

import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence

import numpy as np
import torch

from deltas_geom.cameras.pixels import resize_intrinsics
from deltas_nets import open_capture
from deltas_nets.captures.frame import FloatArray, Frame
from deltas_nets.captures.usable import usable_view_sets
from deltas_nets.captures.work_size import depth_at_image, fit_work_size
from deltas_nets.evaluate.depth_metrics import depth_metrics, mean_metrics
from deltas_nets.evaluate.scores import resize_nearest
from deltas_nets.predict.depth_map import WORK_PIXELS, PredictConfig, frames_of
from deltas_nets.predict.look import look
from deltas_nets.predict.predictor import load_predictor
from deltas_nets.predict.reach import ROOM, Reach

PEERS = "mvsn_demon,itermvs_dtu,patchmatchnet"
Way = Callable[[Sequence[Frame]], FloatArray]


def main() -> None:
    capture = open_capture(sys.argv[1]).remembering()
    views = int(sys.argv[2]) if len(sys.argv) > 2 else 3
    count = int(sys.argv[3]) if len(sys.argv) > 3 else 6
    sets = usable_view_sets(capture, capture.path / "view_sets.json", views).view_sets
    sets = sets[:: max(1, len(sets) // count)][:count]
    print(
        f"{capture.path.name}, {views} views, {len(sets)} maps, {torch.get_num_threads()} threads"
    )
    for name, way in (("deltas-small", ours()), ("PatchMatch", patch_match())):
        scores, seconds = [], 0.0
        for chosen in sets:
            frames = frames_of(capture, chosen)
            truth = depth_at_image(frames[0])
            began = time.perf_counter()
            found = way(frames)
            seconds += time.perf_counter() - began
            score = depth_metrics(resize_nearest(found.astype(np.float32), truth.shape), truth)
            scores.append(score)
        mean = mean_metrics([score for score in scores if score is not None])
        print(
            f"  {name:<14} {seconds / len(sets):.2f} s a map, Abs Rel {mean.abs_rel:.3f}, "
            f"delta < 1.25 {mean.delta1:.3f}, coverage {mean.coverage:.2f}",
            flush=True,
        )
    if len(sys.argv) > 4:
        command = [sys.executable, sys.argv[4], sys.argv[1], PEERS, *map(str, ROOM), str(count)]
        subprocess.run(command, env=os.environ | {"NSRC": str(views - 1)}, check=True)


def ours() -> Way:
    network, config = load_predictor("deltas-small"), PredictConfig()
    return lambda frames: look(network, frames, config, Reach(*ROOM)).depth


def patch_match() -> Way:
    from ppg_core import patchmatch_depth

    def way(frames: Sequence[Frame]) -> FloatArray:
        size = fit_work_size(frames[0].image_size, max_pixels=WORK_PIXELS)
        greys = [
            (frame.read_resized(size).mean(axis=-1) / 255).astype(np.float32) for frame in frames
        ]
        cameras = [camera(frame, size) for frame in frames]
        sources = []
        for frame, grey, K in zip(frames[1:], greys[1:], cameras[1:], strict=True):
            pose = frame.cam_from_world @ np.linalg.inv(frames[0].cam_from_world)
            sources.append((grey, K, pose[:3, :3].copy(), pose[:3, 3].copy()))
        depth, _, _ = patchmatch_depth(greys[0], cameras[0], sources, ROOM, min_views=1)
        return depth

    return way


def camera(frame: Frame, size: tuple[int, int]) -> tuple[float, ...]:
    K = resize_intrinsics(torch.tensor(frame.K), old_size=frame.image_size, new_size=size)
    return tuple(float(K[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))


if __name__ == "__main__":
    main()
