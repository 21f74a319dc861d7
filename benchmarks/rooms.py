"""How many views of procedural rooms one thread renders in a second.

python benchmarks/rooms.py [number of rooms]
"""

import json
import platform
import sys
import time

import torch

from deltas_nets.rooms import render_room, texture_atlas

NUM_VIEWS = 5
IMAGE_SIZE = (144, 192)


def main() -> None:
    """Render, check what came out, print a line of JSON."""
    num_rooms = int(sys.argv[1]) if len(sys.argv) > 1 else 20
    torch.set_num_threads(1)
    start = time.perf_counter()
    texture_atlas()
    atlas_seconds = time.perf_counter() - start
    render_room(num_rooms, num_views=NUM_VIEWS, image_size=IMAGE_SIZE)  # warm up

    start = time.perf_counter()
    rooms = [
        render_room(seed, num_views=NUM_VIEWS, image_size=IMAGE_SIZE) for seed in range(num_rooms)
    ]
    seconds = time.perf_counter() - start
    depth = torch.stack([room.depth for room in rooms])
    assert depth.isfinite().all() and (depth > 0).all(), "a pixel without depth"
    assert all(0.3 <= room.images.float().mean() / 255 <= 0.55 for room in rooms), "exposure"

    num_views = num_rooms * NUM_VIEWS
    report = {
        "views_per_second": round(num_views / seconds, 1),
        "ms_per_view": round(1000 * seconds / num_views, 2),
        "atlas_seconds": round(atlas_seconds, 2),
        "image_size": IMAGE_SIZE,
        "rooms": num_rooms,
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
        "machine": platform.processor() or platform.machine(),
    }
    print(json.dumps(report))


if __name__ == "__main__":
    main()
