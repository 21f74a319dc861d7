"""Maps before and after they heard each other: error, error near edges of depth, flicker.

    python benchmarks/second_pass.py sets CAPTURE 3 > sets.json
    deltas depth CAPTURE --view-sets sets.json --format npz --no-page --passes 1 --out first
    deltas depth CAPTURE --view-sets sets.json --format npz --no-page --out second
    python benchmarks/second_pass.py CAPTURE first second

The sets are those of CAPTURE/view_sets.json where it has one, and chosen ones for all other frames.
Scored are the anchors of CAPTURE/view_sets.json if there is one, else all maps. Edges are where the
log of the true depth jumps by 0.1 between neighbours, and four pixels around. Flicker is that of
`deltas evaluate --consistency`.
"""

import json
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from skimage.morphology import dilation, footprint_rectangle

from deltas_nets import open_capture
from deltas_nets.captures.capture import Capture
from deltas_nets.captures.usable import usable_view_sets
from deltas_nets.captures.view_choice import choose_view_sets
from deltas_nets.captures.work_size import depth_at_image
from deltas_nets.evaluate.consistency import SeenMaps, shrunk
from deltas_nets.evaluate.depth_metrics import depth_metrics, mean_metrics
from deltas_nets.outputs.depth_formats import read_depth_map
from deltas_nets.outputs.summary import recorded_depth_scale, recorded_view_sets

JUMP = 0.1
Map = NDArray[np.float32]


def sets() -> None:
    """Write a view set of every frame to standard output."""
    capture, views = open_capture(sys.argv[2]), int(sys.argv[3])
    file = capture.path / "view_sets.json"
    listed = usable_view_sets(capture, file, views).view_sets if file.exists() else ()
    given = {chosen.anchor: chosen for chosen in listed}
    all_sets = [given.get(v.anchor, v) for v in choose_view_sets(capture, views)]
    print(json.dumps([{"anchor": v.anchor, "sources": v.sources} for v in all_sets]))


def main() -> None:
    capture = open_capture(sys.argv[1])
    listed = capture.path / "view_sets.json"
    scored = None
    if listed.exists():
        scored = {str(views["anchor"]) for views in json.loads(listed.read_text())}
    print(
        "folder: Abs Rel, delta < 1.25, median-scaled Abs Rel; Abs Rel near edges; flicker (pairs)"
    )
    for folder in map(Path, sys.argv[2:]):
        ids = [views.anchor for views in recorded_view_sets(folder)]
        chosen = [id for id in ids if scored is None or id in scored]
        of_maps, of_pairs = errors(capture, folder, chosen), flicker(capture, folder, ids)
        print(f"  {folder.name:<12} {of_maps}; {of_pairs}")


def errors(capture: Capture, folder: Path, ids: list[str]) -> str:
    dense, scaled, near_edges = [], [], []
    for id in ids:
        truth = depth_at_image(capture.frame(id))
        found = read_depth_map(folder, id, recorded_depth_scale(folder))
        score = depth_metrics(found, truth)
        if score is None:
            continue
        dense.append(score)
        both = (truth > 0.5) & (truth < 10) & (found > 0)
        ratio = np.float32(np.median(truth[both] / found[both]))
        scaled.append(depth_metrics(found * ratio, truth))
        small, true = shrunk(found), shrunk(truth)
        at_edge = depth_metrics(small, np.where(edges(true), true, 0))
        if at_edge is not None:
            near_edges.append(at_edge.abs_rel)
    mean = mean_metrics(dense)
    alone = mean_metrics([score for score in scaled if score is not None])
    return f"{mean.abs_rel:.4f}  {mean.delta1:.4f}  {alone.abs_rel:.4f}  {np.mean(near_edges):.4f}"


def flicker(capture: Capture, folder: Path, ids: list[str]) -> str:
    maps, scale = SeenMaps(), recorded_depth_scale(folder)
    for id in ids:
        frame = capture.frame(id)
        maps.add(frame, read_depth_map(folder, id, scale), depth_at_image(frame))
    found = maps.result()
    return f"{found.flicker:.4f} ({found.successive})" if found.flicker is not None else "no pair"


def edges(depth: Map) -> NDArray[np.bool_]:
    log, known = np.log(depth.clip(1e-3)), depth > 0
    jump = np.zeros(depth.shape, dtype=bool)
    jump[:, 1:] |= (np.abs(np.diff(log, axis=1)) > JUMP) & known[:, 1:] & known[:, :-1]
    jump[1:] |= (np.abs(np.diff(log, axis=0)) > JUMP) & known[1:] & known[:-1]
    return dilation(jump, footprint_rectangle((9, 9)))


if __name__ == "__main__":
    sets() if sys.argv[1] == "sets" else main()
