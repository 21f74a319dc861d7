"""How a network does on procedural rooms: quick, exact truth, for use during training."""

import torch
from torch import nn

from deltas_geom import PosedViews
from deltas_nets.data.synthetic import Rooms
from deltas_nets.evaluate.depth_metrics import depth_metrics, mean_metrics
from deltas_nets.targets import read_nearest


@torch.no_grad()
def evaluate_rooms(
    model: nn.Module, rooms: Rooms, *, depth_range: tuple[float, float]
) -> dict[str, float]:
    """Errors of dense maps and of all sparse points, view 0 of each room as anchor.

    Returns:
        abs_rel and delta1 of the dense map; sparse, the median relative error of the points.
    """
    device = next(model.parameters()).device
    dense, sparse = [], []
    for index in range(len(rooms)):
        room = rooms[index]
        prediction = model(
            (room.images.float() / 255).to(device),
            PosedViews(*(tensor.to(device) for tensor in room.views)),
            depth_range,
        )
        found = depth_metrics(prediction.depth[0].cpu(), room.depth[0], depth_range=depth_range)
        if found is not None:
            dense.append(found)
        truth = read_nearest(room.depth[0], prediction.keypoints.pixels.cpu())
        error = (prediction.points.depth[0].cpu() - truth).abs() / truth
        sparse.append(error[(truth > depth_range[0]) & (truth < depth_range[1])])
    mean = mean_metrics(dense)
    return {
        "abs_rel": mean.abs_rel,
        "delta1": mean.delta1,
        "sparse": float(torch.cat(sparse).median()),
    }
