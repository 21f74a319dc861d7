"""What each stage of the joint matcher adds, on a capture with sensor depth.

    python benchmarks/stages.py CAPTURE VIEW_SETS.json

Errors of all sparse points: decided from the fused correlation alone, after each round of
exchange between points, and after refinement and triangulation; then of the dense map.
"""

import sys
from collections import defaultdict
from pathlib import Path

import torch

from deltas_geom import soft_argmax
from deltas_nets import load_model, open_capture
from deltas_nets.captures.view_sets import read_view_sets
from deltas_nets.captures.work_size import depth_at_image
from deltas_nets.evaluate.depth_metrics import DepthMetrics, depth_metrics, mean_metrics
from deltas_nets.evaluate.points import point_depths, score_points
from deltas_nets.predict.depth_map import PredictConfig
from deltas_nets.predict.encoded_frames import EncodedFrames
from deltas_nets.predict.ours import predict_frame


def main() -> None:
    capture = open_capture(sys.argv[1])
    view_sets = read_view_sets(Path(sys.argv[2]), capture)
    model, config = load_model(), PredictConfig()
    encode = EncodedFrames(model)
    window = model.config.matcher.window
    print("means over frames: Abs Rel, delta < 1.25, coverage")
    for num_views in (3, 7):
        found: dict[str, list[DepthMetrics]] = defaultdict(list)
        for views in view_sets:
            ids = (views.anchor, *views.sources[: num_views - 1])
            truth = depth_at_image(capture.frame(views.anchor))
            result = predict_frame(encode, [capture.frame(id) for id in ids], config)
            _, true = point_depths(result.prediction, truth)
            posterior = result.prediction.evidence.posterior
            for number, logits in enumerate(posterior.stages):
                inverse = soft_argmax(logits[0], posterior.inv_depth[:, None], window=window)
                metrics = depth_metrics(1 / inverse.position[:, 0], true)
                assert metrics is not None
                found[f"posterior, {number} rounds of exchange"].append(metrics)
            points = score_points(result.prediction, truth, config.depth_range)
            dense = depth_metrics(result.map.depth, truth)
            assert points is not None
            assert dense is not None
            found["refined and triangulated"].append(points)
            found["dense map"].append(dense)
        print(f"\n{num_views} views")
        for name, frames in found.items():
            mean = mean_metrics(frames)
            row = f"{mean.abs_rel:.3f}  {mean.delta1:.3f}  {mean.coverage:.3f}"
            print(f"  {name:<34} {row}")


if __name__ == "__main__":
    torch.set_grad_enabled(False)
    main()
