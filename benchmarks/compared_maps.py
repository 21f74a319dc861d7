"""Rooms whose maps heard each other: as they are drawn, and compared with the images around them.

    python benchmarks/compared_maps.py [ROOMS] [SHARE_OF_CLOSE_UPS] [SEED]

Ten views of each room at 288 x 384, with the light, blur, noise and pose errors of training, three
of them for each map, three passes. Abs Rel, its median, within four pixels of edges of depth, that
of the surest half by that of all, the mean of the confidence and what it should be. Seeds below
1000 are of rooms that no training sees.
"""

import sys
from pathlib import Path

import numpy as np
import torch
from second_pass import edges
from torch import Tensor

from deltas_geom import PosedViews
from deltas_nets import load_model
from deltas_nets.agree.compared import Described, compared
from deltas_nets.agree.neighbours import neighbours, sample
from deltas_nets.captures.posed_images import PosedImages
from deltas_nets.captures.spread import spread
from deltas_nets.evaluate.rooms import DisturbedRooms
from deltas_nets.network.deltas import Deltas
from deltas_nets.network.encoded import Encoded
from deltas_nets.network.known_depth import KnownDepth
from deltas_nets.predict.later_passes import COMPARED
from deltas_nets.rooms import Rooms
from deltas_nets.train.heard_rooms import HeardRooms, hear_each_other

SIZE, VIEWS = (288, 384), 10
RANGE = (0.3, 10.0)


def main() -> None:
    given = [*sys.argv[1:], *("12", "0.3", "500")[len(sys.argv) - 1 :]]
    count, close, seed = int(given[0]), float(given[1]), int(given[2])
    model = load_model()
    rooms = Rooms(count, seed=seed, num_views=VIEWS, image_size=SIZE, close_ups=close)
    heard = HeardRooms(DisturbedRooms(rooms), model, Path(), seed=seed)
    drawn, moved = [], []
    with torch.inference_mode():
        for number in range(count):
            room = heard.rooms[number]
            for before, after, truth in maps_of(model, heard, room, seed + number):
                drawn.append(scores(before, truth))
                moved.append(scores(after, truth))
    print("           Abs Rel  median   edges  surest half  confidence  share below 5 %")
    for name, found in (("drawn", drawn), ("compared", moved)):
        print(f"{name:<10}" + "".join(f"{value:9.4f}" for value in np.nanmean(found, axis=0)))


def maps_of(
    model: Deltas, heard: HeardRooms, room: PosedImages, seed: int
) -> list[tuple[KnownDepth, KnownDepth, Tensor]]:
    """Of each view the map that is drawn, what comes of comparing it, and the truth."""
    agreed = hear_each_other(heard.maps(room, torch.Generator().manual_seed(seed)), room.views)
    each = [model.encode(image[None, None].float() / 255) for image in room.images]
    cameras = [PosedViews(*(part[v : v + 1] for part in room.views)) for v in range(VIEWS)]
    seen = [described(*pair) for pair in zip(each, cameras, strict=True)]
    points = [sample(depth, view) for depth, view in zip(agreed.depth, cameras, strict=True)]
    found = []
    for v, near in enumerate(neighbours(torch.stack(points), room.views, [SIZE] * VIEWS)):
        of_one = KnownDepth(*(part[v : v + 1] for part in agreed))
        before = KnownDepth(*(part[0] for part in model.redrawn(each[v], of_one)))
        after = compared(before, seen[v], [seen[other] for other in spread(near, COMPARED)])
        found.append((before, after, room.depth[v]))
    return found


def described(encoded: Encoded, view: PosedViews) -> Described:
    maps = encoded.descriptors.maps[0, 0]
    size = (maps.shape[-2], maps.shape[-1])
    return Described(
        maps.flatten(1).mT.contiguous(), size, view.resize(old_size=SIZE, new_size=size)
    )


def scores(found: KnownDepth, truth: Tensor) -> tuple[float, ...]:
    known = ((truth > RANGE[0]) & (truth < RANGE[1])).numpy()
    true = truth.numpy()
    error = np.abs(found.depth[0].numpy() - true) / true.clip(1e-3)
    of_all, at_edge = error[known], error[known & edges(true)]
    surest = np.argsort(found.deviation[0].numpy()[known], kind="stable")[: of_all.size // 2]
    confidence = found.confidence()[0].numpy()[known]
    near_edges = at_edge.mean() if at_edge.size else np.nan
    half = of_all[surest].mean() / of_all.mean()
    below = (of_all < 0.05).mean()
    return of_all.mean(), np.median(of_all), near_edges, half, confidence.mean(), below


if __name__ == "__main__":
    main()
