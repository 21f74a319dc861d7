"""A rendered room on disk."""

from pathlib import Path

import numpy as np
import torch
from PIL import Image

from deltas_nets.captures.posed_images import PosedImages
from deltas_nets.outputs.products import write_depth_png


def write_scene(folder: Path, room: PosedImages) -> None:
    """A rendered room as ScanNet would have exported it."""
    for name in ("color", "depth", "pose", "intrinsic"):
        (folder / name).mkdir(parents=True)
    np.savetxt(folder / "intrinsic" / "intrinsic_color.txt", room.views.K[0].numpy(), fmt="%.6f")
    world_from_cam = torch.linalg.inv(room.views.cam_from_world.double())
    for id in range(len(room.images)):
        pixels = room.images[id].permute(1, 2, 0).numpy()
        Image.fromarray(pixels).save(folder / "color" / f"{id}.png")
        write_depth_png(folder / "depth" / f"{id}.png", room.depth[id].numpy())
        np.savetxt(folder / "pose" / f"{id}.txt", world_from_cam[id].numpy(), fmt="%.9f")
