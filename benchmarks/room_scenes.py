"""Procedural rooms on disk, as data sets lay them out, so that every protocol runs without one.

    python benchmarks/room_scenes.py scannet OUT 4    # OUT/scans_test/scene0707_00, ...
    python benchmarks/room_scenes.py demon OUT 4      # OUT/room_000, ...: pairs as DPSNet has them
    python benchmarks/room_scenes.py close-ups OUT 8  # ScanNet's layout: desks, shelves and floors
    deltas evaluate OUT --data scannet --protocol paper --views 3 --gap 2 --every 1
    deltas evaluate OUT                               # the pairs

The rooms are those of `deltas evaluate --rooms` at 240 x 320, as rendered: neither training nor
calibration sees them. In ScanNet's layout a scene has nine frames, in DPSNet's two.
"""

import sys
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from deltas_nets.captures.posed_images import PosedImages
from deltas_nets.evaluate.rooms import EVALUATION_SEEDS
from deltas_nets.outputs.depth_formats import write_depth_png
from deltas_nets.rooms import render_close_up, render_room

SIZE = (240, 320)
FIRST_TEST_SCENE = 707


def main() -> None:
    layout, out, count = sys.argv[1], Path(sys.argv[2]), int(sys.argv[3])
    for number in range(count):
        seed = EVALUATION_SEEDS[number]
        if layout in ("scannet", "close-ups"):
            render = render_room if layout == "scannet" else render_close_up
            folder = out / "scans_test" / f"scene{FIRST_TEST_SCENE + number:04d}_00"
            as_scannet(folder, render(seed, num_views=9, image_size=SIZE))
        else:
            as_pair(out / f"room_{number:03d}", render_room(seed, num_views=2, image_size=SIZE))


def as_scannet(folder: Path, room: PosedImages) -> None:
    for name in ("color", "depth", "pose", "intrinsic"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    np.savetxt(folder / "intrinsic" / "intrinsic_color.txt", room.views.K[0].numpy(), fmt="%.6f")
    world_from_cam = torch.linalg.inv(room.views.cam_from_world.double())
    for i in range(len(room.images)):
        photo(room, i).save(folder / "color" / f"{i}.jpg", quality=95)
        write_depth_png(folder / "depth" / f"{i}.png", room.depth[i].numpy())
        np.savetxt(folder / "pose" / f"{i}.txt", world_from_cam[i].numpy(), fmt="%.9f")


def as_pair(folder: Path, room: PosedImages) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    np.savetxt(folder / "cam.txt", room.views.K[0].numpy())
    np.savetxt(folder / "poses.txt", room.views.cam_from_world[:, :3].reshape(2, 12).numpy())
    for i in range(2):
        photo(room, i).save(folder / f"{i:04d}.jpg", quality=95)
        np.save(folder / f"{i:04d}.npy", room.depth[i].numpy())


def photo(room: PosedImages, number: int) -> Image.Image:
    return Image.fromarray(room.images[number].permute(1, 2, 0).numpy())


if __name__ == "__main__":
    main()
