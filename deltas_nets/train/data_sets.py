"""What a run trains on and what it is validated on, opened as its config says."""

from collections.abc import Callable
from pathlib import Path

from torch.utils.data import Subset

from deltas_nets.captures.posed_images import PosedImages
from deltas_nets.config import TrainConfig
from deltas_nets.datasets.scannet import ScanNetViewSets, open_scannet
from deltas_nets.outputs.atomic_files import remove_abandoned
from deltas_nets.rooms import Rooms


def training_data(
    config: TrainConfig, *, report: Callable[[str], None] = lambda _: None
) -> Rooms | ScanNetViewSets:
    """What the config wants to train on.

    Args:
        config: of the run.
        report: gets lines about what there is.

    Raises:
        UserError: there is none of it.
    """
    data = config.data
    if data.cache is not None:
        remove_abandoned(Path(data.cache))
    if data.source == "scannet":
        return _frames(config, data.scannet.split, "--data.split", report)
    return Rooms(
        data.num_rooms,
        seed=data.seed,
        num_views=data.num_views,
        image_size=(data.height, data.width),
        close_ups=data.close_ups,
        cache_dir=None if data.cache is None else Path(data.cache),
    )


def validation_data(
    config: TrainConfig, *, report: Callable[[str], None] = lambda _: None
) -> Subset[PosedImages] | None:
    """View sets of the validation split, spread evenly over it; None if the config names none.

    Raises:
        UserError: there is none.
    """
    scannet = config.data.scannet
    if scannet.validation is None:
        return None
    frames = _frames(config, scannet.validation, "--data.validation", report)
    count = min(scannet.validation_tuples, len(frames))
    return Subset(frames, [len(frames) * number // count for number in range(count)])


def _frames(
    config: TrainConfig, split: str, option: str, report: Callable[[str], None]
) -> ScanNetViewSets:
    data = config.data
    return open_scannet(
        data.scannet,
        split,
        num_views=config.max_views,
        image_size=(data.height, data.width),
        cache=None if data.cache is None else Path(data.cache),
        option=option,
        report=report,
    )
