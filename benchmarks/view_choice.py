"""Views chosen by geometry beside views at fixed gaps: depth of the same anchors.

    python benchmarks/view_choice.py CAPTURE [VIEWS] [EVERY]

A gap of 2 means the frames 2 before and 2 after the anchor, then 4, as many as there are views.
"""

import sys
from collections.abc import Sequence

import numpy as np
import torch

from deltas_nets import open_capture
from deltas_nets.captures.capture import Capture
from deltas_nets.captures.view_choice import choose_view_sets
from deltas_nets.captures.view_sets import ViewSet
from deltas_nets.captures.work_size import depth_at_image
from deltas_nets.evaluate.depth_metrics import depth_metrics
from deltas_nets.predict.depth_map import PredictConfig, frames_of
from deltas_nets.predict.look import look
from deltas_nets.predict.predictor import load_predictor
from deltas_nets.predict.reach import ROOM, Reach

GAPS = (1, 2, 3, 5, 10, 20)


def main() -> None:
    capture = open_capture(sys.argv[1]).remembering()
    num_views = int(sys.argv[2]) if len(sys.argv) > 2 else 3
    ids = list(capture.frames)[:: int(sys.argv[3]) if len(sys.argv) > 3 else 7]
    anchors = [id for id in ids if capture.frame(id).depth_path is not None]
    network, config = load_predictor("deltas-small"), PredictConfig()
    ways = {"chosen": choose_view_sets(capture, num_views, anchors=anchors)}
    ways |= {f"gap {gap}": at_gap(capture, anchors, gap, num_views - 1) for gap in GAPS}
    print(f"{capture.path.name}, {num_views} views, {len(anchors)} anchors")
    print("  Abs Rel: mean, median; delta < 1.25")
    for name, sets in ways.items():
        found = [
            depth_metrics(
                look(network, frames_of(capture, views), config, Reach(*ROOM)).depth,
                depth_at_image(capture.frame(views.anchor)),
            )
            for views in sets
        ]
        scores = [score for score in found if score is not None]
        errors, inside = ([getattr(s, key) for s in scores] for key in ("abs_rel", "delta1"))
        print(f"  {name:<8} {np.mean(errors):.4f}  {np.median(errors):.4f}  {np.mean(inside):.3f}")


def at_gap(capture: Capture, anchors: Sequence[str], gap: int, count: int) -> tuple[ViewSet, ...]:
    """As many sources as asked, by turns after and before the anchor."""
    ids = list(capture.frames)
    sets = []
    for anchor in anchors:
        place = ids.index(anchor)
        steps = [sign * gap * times for times in range(1, count + 2) for sign in (1, -1)]
        there = [ids[place + step] for step in steps if 0 <= place + step < len(ids)]
        sets.append(ViewSet(anchor, tuple(there[:count] or [ids[place - 1]])))
    return tuple(sets)


if __name__ == "__main__":
    torch.set_grad_enabled(False)
    main()
