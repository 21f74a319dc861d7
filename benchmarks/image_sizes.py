"""Maps of rooms at the usual size and at the larger one: does confidence tell which is better?

    python benchmarks/image_sizes.py [ROOMS] [SHARE_OF_CLOSE_UPS] [SEED]

For rooms of three views, with the light, blur, noise and pose errors of training: Abs Rel at 288 x
384 with 768 points and at 480 x 640 with 1600, by how much surer of the larger images the network
is, and what its choice gives. Seeds below 1000 are of rooms that no training sees.
"""

import sys
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F

from deltas_geom import PosedViews
from deltas_nets import load_model
from deltas_nets.captures.posed_images import PosedImages
from deltas_nets.evaluate.depth_metrics import depth_metrics
from deltas_nets.evaluate.rooms import DisturbedRooms
from deltas_nets.network.deltas import Deltas
from deltas_nets.network.known_depth import KnownDepth
from deltas_nets.predict.depth_map import PredictConfig
from deltas_nets.predict.ours import num_points
from deltas_nets.predict.trial import AS_SURE, surer
from deltas_nets.rooms import Rooms

USUAL, LARGE = (288, 384), (480, 640)
RANGE = (0.5, 10.0)
LIMITS = (-np.inf, -0.03, -AS_SURE, 0.0, np.inf)


class Compared(NamedTuple):
    """A room: Abs Rel at both sizes, and the confidence that the larger adds."""

    usual: float
    large: float
    gain: float

    @property
    def chosen(self) -> float:
        """Abs Rel at the size that is chosen."""
        return self.usual if surer(PredictConfig(), [self.gain]) == PredictConfig() else self.large


def main() -> None:
    given = [*sys.argv[1:], *("44", "0.5", "500")[len(sys.argv) - 1 :]]
    count, close, seed = int(given[0]), float(given[1]), int(given[2])
    model = load_model()
    rooms = DisturbedRooms(Rooms(count, seed=seed, num_views=3, image_size=LARGE, close_ups=close))
    found = [compared(model, rooms[number]) for number in range(count)]
    print("confidence gained   rooms   usual   large   larger is better")
    for low, high in pairwise(LIMITS):
        some = [each for each in found if low <= each.gain < high]
        if some:
            usual, large, _ = np.mean(some, axis=0)
            better = sum(each.large < each.usual for each in some)
            print(f"{low:6.2f} to {high:5.2f} {len(some):10} {usual:7.4f} {large:7.4f} {better:8}")
    usual, large, _ = np.mean(found, axis=0)
    chosen = np.mean([each.chosen for each in found])
    print(f"all {count:20} {usual:7.4f} {large:7.4f}   as chosen {chosen:.4f}")


@torch.inference_mode()
def compared(model: Deltas, room: PosedImages) -> Compared:
    (usual, sure), (large, surer) = (seen(model, room, size) for size in (USUAL, LARGE))
    return Compared(usual, large, surer - sure)


def seen(model: Deltas, room: PosedImages, size: tuple[int, int]) -> tuple[float, float]:
    """Abs Rel, and the mean confidence."""
    images = F.interpolate(room.images.float() / 255, size=size, mode="bilinear", antialias=True)
    views = PosedViews(*(part[None] for part in room.views)).resize(old_size=LARGE, new_size=size)
    points = num_points(model, size)
    found = model(images[None].clamp(0, 1), views, RANGE, num_keypoints=points)
    depth = F.interpolate(found.depth, size=LARGE, mode="bilinear")[0, 0]
    sure = KnownDepth(found.depth, found.std / found.depth).confidence().mean()
    scored = depth_metrics(depth.numpy(), room.depth[0].numpy(), depth_range=RANGE)
    assert scored is not None  # all of a room has depth
    return scored.abs_rel, float(sure)


if __name__ == "__main__":
    main()
