"""Maps before and after they heard each other: error, error near edges of depth, flicker.

    python benchmarks/second_pass.py sets CAPTURE 3 > sets.json
    deltas depth CAPTURE --view-sets sets.json --format npz --no-page --passes 1 --out first
    deltas depth CAPTURE --view-sets sets.json --format npz --no-page --out second
    python benchmarks/second_pass.py CAPTURE first second

The sets are those of CAPTURE/view_sets.json where it has one, and chosen ones for all other frames.
Scored are the anchors of CAPTURE/view_sets.json if there is one, else all maps. Edges are where the
log of the true depth jumps by 0.1 between neighbours, and four pixels around. Flicker compares
successive maps at places that both see, as the true depth has it (to 2 %): by how much the log of
their errors differs, so that what the truth itself flickers is left out.
"""

import json
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from skimage.morphology import dilation, footprint_rectangle

from deltas_geom import PosedViews, project, unproject
from deltas_geom.cameras.pixels import resize_intrinsics
from deltas_nets import open_capture
from deltas_nets.captures.capture import Capture
from deltas_nets.captures.frame import Frame
from deltas_nets.captures.usable import usable_view_sets
from deltas_nets.captures.view_choice import choose_view_sets
from deltas_nets.captures.work_size import depth_at_image
from deltas_nets.evaluate.depth_metrics import depth_metrics, mean_metrics
from deltas_nets.outputs.depth_formats import read_depth_map
from deltas_nets.outputs.summary import recorded_depth_scale, recorded_view_sets

SIZE = (270, 360)
"""(height, width) at which edges and flicker are measured."""
SAME = 0.02
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
    scale, found = recorded_depth_scale(folder), []
    off = {id: None for id in ids}
    for one, other in pairwise(ids):
        true = [shrunk(depth_at_image(capture.frame(id))) for id in (one, other)]
        here, there = same_places(capture.frame(one), capture.frame(other), *true)
        if len(here) < 500:
            continue
        for id, depth in zip((one, other), true, strict=True):
            if off[id] is None:
                map_ = shrunk(read_depth_map(folder, id, scale)).astype(np.float64)
                off[id] = np.log(np.where((map_ > 0) & (depth > 0), map_ / depth.clip(1e-3), 1))
        first, second = off[one].ravel()[here], off[other].ravel()[there]
        found.append(float(np.abs(first - second).mean()))
    return f"{np.mean(found):.4f} ({len(found)})" if found else "no pair"


def same_places(one: Frame, other: Frame, here: Map, there: Map) -> tuple[NDArray, NDArray]:
    """Pixels of two frames that show the same place, by the true depth of both."""
    rows, columns = np.nonzero((here > 0.5) & (here < 10))
    pixels = torch.from_numpy(np.stack([columns, rows], axis=-1)).double()[None]
    depth = torch.from_numpy(here[rows, columns]).double()[None]
    seen = project(view(other), unproject(view(one), pixels, depth)[0])
    column, row = (seen.pixels[0] + 0.5).floor().long().unbind(dim=-1)
    inside = seen.in_front[0] & (column >= 0) & (column < SIZE[1]) & (row >= 0) & (row < SIZE[0])
    place = (row * SIZE[1] + column).clamp(0, SIZE[0] * SIZE[1] - 1).numpy()
    z = seen.depth[0].numpy()
    true = there.ravel()[place]
    same = inside.numpy() & (true > 0.5) & (true < 10) & (np.abs(true / z - 1) < SAME)
    return (rows * SIZE[1] + columns)[same], place[same]


def view(frame: Frame) -> PosedViews:
    K = resize_intrinsics(torch.tensor(frame.K), old_size=frame.image_size, new_size=SIZE)
    return PosedViews(K[None], torch.tensor(frame.cam_from_world)[None])


def shrunk(image: Map) -> Map:
    """The pixel that holds each new centre."""
    rows = ((np.arange(SIZE[0]) + 0.5) * image.shape[0] / SIZE[0]).astype(int)
    columns = ((np.arange(SIZE[1]) + 0.5) * image.shape[1] / SIZE[1]).astype(int)
    return image[rows[:, None], columns]


def edges(depth: Map) -> NDArray[np.bool_]:
    log, known = np.log(depth.clip(1e-3)), depth > 0
    jump = np.zeros(depth.shape, dtype=bool)
    jump[:, 1:] |= (np.abs(np.diff(log, axis=1)) > JUMP) & known[:, 1:] & known[:, :-1]
    jump[1:] |= (np.abs(np.diff(log, axis=0)) > JUMP) & known[1:] & known[:-1]
    return dilation(jump, footprint_rectangle((9, 9)))


if __name__ == "__main__":
    sets() if sys.argv[1] == "sets" else main()
