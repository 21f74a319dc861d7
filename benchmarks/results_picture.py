"""Rooms that no training sees: photo, true depth, and maps of plane sweep and of deltas-small.

python benchmarks/results_picture.py docs/results/rooms.jpg
"""

import sys
import tempfile
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from numpy.typing import NDArray
from PIL import Image

from deltas_nets.captures.view_sets import ViewSet
from deltas_nets.evaluate.room_scores import room_in_files
from deltas_nets.evaluate.rooms import EVALUATION_SEEDS, held_out_rooms
from deltas_nets.predict.depth_map import PredictConfig, frames_of
from deltas_nets.predict.look import look
from deltas_nets.predict.predictor import load_predictor
from deltas_nets.predict.reach import ROOM, Reach

ROOMS, SIZE, GAP = (0, 3, 5, 8), (240, 320), 4
METHODS = ("plane-sweep", "deltas-small")


def main() -> None:
    """Write the picture: a room a row."""
    rooms = held_out_rooms(max(ROOMS) + 1, EVALUATION_SEEDS, image_size=SIZE)
    predictors = [load_predictor(name) for name in METHODS]
    height, width = (len(ROOMS) * (SIZE[0] + GAP) - GAP, 4 * (SIZE[1] + GAP) - GAP)
    picture = np.full((height, width, 3), 255, dtype=np.uint8)
    for row, number in enumerate(ROOMS):
        with tempfile.TemporaryDirectory() as name:
            capture = room_in_files(rooms[number], Path(name))
            frames = frames_of(capture, ViewSet("key", ("1", "2")))
            truth = frames[0].read_depth()
            maps = [look(one, frames, PredictConfig(), Reach(*ROOM)).depth for one in predictors]
            near, far = np.percentile(truth[truth > 0], (1, 99))
            tiles = [frames[0].read_image(), *(colored(d, near, far) for d in (truth, *maps))]
        top = row * (SIZE[0] + GAP)
        for column, tile in enumerate(tiles):
            left = column * (SIZE[1] + GAP)
            picture[top : top + SIZE[0], left : left + SIZE[1]] = tile
    Image.fromarray(picture).resize((width // 2, height // 2)).save(sys.argv[1], quality=88)


def colored(depth: NDArray[np.float32], near: float, far: float) -> NDArray[np.uint8]:
    """Near is red, far is blue, unknown is black."""
    share = np.log(depth.clip(near, far) / near) / np.log(far / near)
    colors: NDArray[np.uint8] = (255 * colormaps["turbo_r"](share)[..., :3]).astype(np.uint8)
    return np.where(depth[..., None] > 0, colors, 0).astype(np.uint8)


if __name__ == "__main__":
    main()
