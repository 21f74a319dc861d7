"""How a network does on procedural rooms: exact truth, and no training sees them."""

from collections.abc import Callable, Iterable
from typing import Literal, Protocol

import torch
from torch import nn
from torch.utils.data import Dataset

from deltas_geom import PosedViews
from deltas_nets.captures.posed_images import PosedImages
from deltas_nets.config import TrainConfig
from deltas_nets.datasets.augment import Photometry, disturb_poses, draw_pose_errors
from deltas_nets.datasets.workers import rendered_ahead
from deltas_nets.evaluate.calibration import CalibrationMeter
from deltas_nets.evaluate.depth_metrics import depth_metrics, mean_metrics
from deltas_nets.losses.targets import read_nearest
from deltas_nets.network.deltas import Deltas
from deltas_nets.network.prediction import DepthPrediction
from deltas_nets.rooms import Rooms

EVALUATION_SEEDS, CALIBRATION_SEEDS = range(500), range(500, 1000)
"""Rooms to report on and rooms to calibrate with; those of training have seeds from 1000."""

POSE_NOISE = TrainConfig().pose_noise

Conditions = Literal["ideal", "real"]


class RoomViews(Protocol):
    """Rooms by number: images uint8 ``(V, 3, H, W)``, cameras, depth ``(V, H, W)``."""

    def __len__(self) -> int: ...
    def __getitem__(self, index: int) -> PosedImages: ...


class DisturbedRooms(Dataset[PosedImages]):
    """Rooms as cameras and trackers give them: the light, blur, noise and poses of training.

    Args:
        rooms: as rendered; their seeds decide what happens to them.
        pose_noise: standard deviations of the sources' poses, metres and radians per axis.
    """

    def __init__(self, rooms: Rooms, pose_noise: tuple[float, float] = POSE_NOISE) -> None:
        self.rooms = rooms
        self.pose_noise = pose_noise
        self.photometry = Photometry()

    def __len__(self) -> int:
        return len(self.rooms)

    def __getitem__(self, index: int) -> PosedImages:
        room, seed = self.rooms[index], self.rooms.seed + index
        images = self.photometry(room.images[None].float() / 255, seed)[0]
        views = disturb_poses(
            PosedViews(*(tensor[None] for tensor in room.views)),
            draw_pose_errors(len(room.depth), self.pose_noise, torch.Generator().manual_seed(seed)),
        )
        views = PosedViews(*(tensor[0] for tensor in views))
        return PosedImages((images * 255).round().to(torch.uint8), views, room.depth)


def held_out_rooms(
    count: int,
    seeds: range,
    *,
    num_views: int = 3,
    image_size: tuple[int, int] = (288, 384),
    conditions: Conditions = "real",
) -> RoomViews:
    """The first of the rooms of some seeds.

    Args:
        count: how many.
        seeds: ``EVALUATION_SEEDS`` or ``CALIBRATION_SEEDS``.
        num_views: V, the anchor first.
        image_size: height, width.
        conditions: "ideal" as rendered, "real" as :class:`DisturbedRooms`.

    Raises:
        ValueError: there are not so many.
    """
    if not 1 <= count <= len(seeds):
        raise ValueError(f"the number of rooms must be within 1 to {len(seeds)}, got {count}")
    rooms = Rooms(count, seed=seeds.start, num_views=num_views, image_size=image_size)
    return DisturbedRooms(rooms) if conditions == "real" else rooms


def measure_rooms(
    model: Deltas,
    rooms: RoomViews,
    meter: CalibrationMeter,
    *,
    depth_range: tuple[float, float],
    report: Callable[[str], None] = lambda _: None,
) -> None:
    """Let a meter look at the maps of all rooms."""
    for number, room in enumerate(in_order(rooms)):
        _measure(predict_room(model, room, depth_range), room, meter, depth_range)
        report(str(number))


def in_order(rooms: RoomViews) -> Iterable[PosedImages]:
    """All of them, rendered by other processes where they are not in memory."""
    if isinstance(rooms, Dataset):
        return rendered_ahead(rooms, len(rooms))
    return (rooms[number] for number in range(len(rooms)))  # in memory


@torch.no_grad()
def predict_room(
    model: nn.Module, room: PosedImages, depth_range: tuple[float, float]
) -> DepthPrediction:
    """Depth of view 0, on the model's device."""
    device = next(model.parameters()).device
    prediction: DepthPrediction = model(
        (room.images.float() / 255).to(device),
        room.views.to(device),
        depth_range,
    )
    return prediction


def _measure(
    prediction: DepthPrediction,
    room: PosedImages,
    meter: CalibrationMeter,
    depth_range: tuple[float, float],
) -> None:
    relative_std = prediction.std / prediction.depth
    meter.add(
        prediction.depth[0].cpu(), relative_std[0].cpu(), room.depth[0], depth_range=depth_range
    )


def evaluate_rooms(
    model: nn.Module, rooms: RoomViews, *, depth_range: tuple[float, float]
) -> dict[str, float]:
    """Errors of dense maps and of all sparse points, quick, for use during training.

    Returns:
        abs_rel and delta1 of the dense map; sparse, the median relative error of the points.
    """
    dense, sparse = [], []
    for index in range(len(rooms)):
        room = rooms[index]
        prediction = predict_room(model, room, depth_range)
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
