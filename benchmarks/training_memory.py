"""Peak memory of a training step: forward and backward of a batch of rooms' size.

python benchmarks/training_memory.py [deltas-resnet50] [--batch 4] [--views 3] [--device cuda]

On a GPU it is what tensors take there; on a CPU, the whole process.
"""

import argparse
import resource
import time

import torch

from deltas_geom import PosedViews
from deltas_nets.config import CONFIGS, PAPER_LOSS
from deltas_nets.losses.losses import training_losses
from deltas_nets.network.networks import build_network


def main() -> None:
    """Print one line."""
    parser = argparse.ArgumentParser()
    parser.add_argument("network", nargs="?", default="deltas-resnet50", choices=list(CONFIGS))
    parser.add_argument("--batch", type=int, default=4)
    parser.add_argument("--views", type=int, default=3)
    parser.add_argument("--size", type=int, nargs=2, default=(240, 320))
    parser.add_argument("--device", default="cpu")
    arguments = parser.parse_args()
    batch, views, (height, width) = arguments.batch, arguments.views, arguments.size
    device = torch.device(arguments.device)

    torch.manual_seed(0)
    model = build_network(CONFIGS[arguments.network]).train().to(device)
    K = torch.tensor([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]]).expand(batch, views, 3, 3)
    pose = torch.eye(4).repeat(batch, views, 1, 1)
    pose[..., 0, 3] = -0.1 * torch.arange(views)
    cameras = PosedViews(K.to(device), pose.to(device))
    images = torch.rand(batch, views, 3, height, width, device=device)
    depth = torch.full((batch, views, height, width), 2.0, device=device)

    began = time.perf_counter()
    prediction = model(images, cameras, num_keypoints=512)
    losses = training_losses(
        prediction, images, cameras, depth, PAPER_LOSS, depth_range=(0.5, 10.0)
    )
    losses.total.backward()  # type: ignore[no-untyped-call]
    if device.type == "cuda":
        torch.cuda.synchronize()
        peak, of = torch.cuda.max_memory_allocated() / 1e9, torch.cuda.get_device_name()
    else:
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9
        of = "the whole process"
    seconds = time.perf_counter() - began
    print(
        f"{arguments.network}, batch {batch}, {views} views, {height} x {width}: "
        f"peak {peak:.1f} GB of {of}, {seconds:.1f} s"
    )


if __name__ == "__main__":
    main()
