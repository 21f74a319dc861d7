"""Measured depth beside none: 512, 64 and 8 true depths of each anchor, noise and outliers.

    python benchmarks/measured_depth.py CAPTURE [VIEWS] [EVERY]

CAPTURE has sensor depth, of which so many pixels are taken at random; what is scored is all of it.
"alone" is completion without any other view, as with deltas depth --views 1.
"""

import sys
from collections import defaultdict

import numpy as np

from deltas_nets import open_capture
from deltas_nets.captures.frame import FloatArray
from deltas_nets.captures.measured import MeasuredDepth
from deltas_nets.captures.usable import usable_view_sets
from deltas_nets.captures.work_size import depth_at_image
from deltas_nets.evaluate.depth_metrics import DepthMetrics, depth_metrics, mean_metrics
from deltas_nets.predict.depth_map import PredictConfig, frames_of
from deltas_nets.predict.look import look
from deltas_nets.predict.predictor import load_predictor
from deltas_nets.predict.reach import ROOM, Reach

COUNTS = (512, 64, 8)


def main() -> None:
    capture = open_capture(sys.argv[1]).remembering()
    views = int(sys.argv[2]) if len(sys.argv) > 2 else 3
    file = capture.path / "view_sets.json"
    sets = usable_view_sets(capture, file if file.exists() else None, views).view_sets
    sets = sets[:: int(sys.argv[3]) if len(sys.argv) > 3 else 1]
    network, config, room = load_predictor("deltas-small"), PredictConfig(), Reach(*ROOM)
    found: dict[str, list[DepthMetrics]] = defaultdict(list)
    random = np.random.default_rng(0)
    for chosen in sets:
        frames = frames_of(capture, chosen)
        truth = depth_at_image(frames[0])

        def score(name: str, alone: bool, measured: MeasuredDepth | None) -> None:
            seen = frames[:1] if alone else frames  # noqa: B023
            depth = look(network, seen, config, room, measured).depth
            metrics = depth_metrics(depth, truth)  # noqa: B023
            if metrics is not None:
                found[name].append(metrics)

        score("none", False, None)
        for count in COUNTS:
            exact = drawn(random, truth, count)
            noisy = exact.depth * np.exp(0.05 * random.standard_normal(len(exact.depth)))
            wrong = random.random(len(exact.depth)) < 0.1
            spoilt = np.where(wrong, random.uniform(0.5, 10, len(wrong)), exact.depth)
            score(f"{count}", False, exact)
            score(f"{count} alone", True, exact)
            score(f"{count}, 5 % noise", False, exact._replace(depth=noisy, deviation=0.05))
            score(f"{count}, 10 % outliers", False, exact._replace(depth=spoilt))
    print(f"{capture.path.name}, {views} views, {len(sets)} maps: Abs Rel, delta < 1.25")
    for name, scores in found.items():
        mean = mean_metrics(scores)
        print(f"  {name:<22} {mean.abs_rel:.4f}  {mean.delta1:.3f}")


def drawn(random: np.random.Generator, truth: FloatArray, count: int) -> MeasuredDepth:
    rows, columns = np.nonzero((truth > 0.5) & (truth < 10))
    some = random.choice(len(rows), min(count, len(rows)), replace=False)
    pixels = np.stack([columns, rows], axis=-1)[some].astype(np.float64)
    return MeasuredDepth(pixels, truth[rows, columns][some].astype(np.float64), 0.01)


if __name__ == "__main__":
    main()
