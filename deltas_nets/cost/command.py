"""What `deltas cost` does: measure, write, print."""

import platform
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import torch
from torch import nn

from deltas_nets.cost.literature import PAPER_SETTING
from deltas_nets.cost.measure import Cost, cost_of
from deltas_nets.cost.report import comparison_table, cost_table, costs_as_json
from deltas_nets.errors import UserError
from deltas_nets.outputs.atomic_files import write_json
from deltas_nets.terminal import table_console, warn

MIN_SIDE = 32
"""Images may not be lower or narrower: nothing would be left at the coarsest scale, pixels."""


def run_cost(
    models: Mapping[str, nn.Module],
    *,
    num_views: int = 2,
    image_size: tuple[int, int] = (240, 320),
    num_keypoints: int = 512,
    repeats: int = 5,
    json: Path | None = None,
) -> None:
    """Tell what each network costs, and beside the paper's figures if the setting is the paper's.

    Args:
        models: by name, called as `Deltas` is.
        num_views: the anchor and its sources.
        image_size: (height, width).
        num_keypoints: points to triangulate.
        repeats: runs that are timed.
        json: also write everything here.

    Raises:
        UserError: the setting makes no sense, or the file cannot be written.
    """
    if num_views < 2 or repeats < 1 or num_keypoints < 1 or min(image_size) < MIN_SIDE:
        raise UserError(
            f"cannot measure {num_views} views of {image_size[0]} x {image_size[1]}, "
            f"{num_keypoints} keypoints, {repeats} times",
            "command line",
            f"ask for 2 views, {MIN_SIDE} pixels, 1 keypoint and 1 run or more",
        )
    height, width = image_size
    fitting = {name: model for name, model in models.items() if _takes(model, image_size)}
    for name in [name for name in models if name not in fitting]:
        left_out = f"{name} takes multiples of {_multiple(models[name])}, not {height} x {width}"
        if not fitting:
            raise UserError(left_out, "command line", "change --size, or name other networks")
        warn(f"{left_out}: left out")
    costs: dict[str, Cost] = {}

    def measured() -> Iterator[str]:
        for name, model in fitting.items():
            costs[name] = cost_of(model, num_views, image_size, num_keypoints, repeats=repeats)
            yield name

    names: Iterable[str] = measured()
    devices = {name: device_name(model) for name, model in fitting.items()}
    if json is not None:  # before the reader of what is printed may have had enough
        names = list(names)
        write_json(
            json,
            {
                "num_views": num_views,
                "image_size": image_size,
                "num_keypoints": num_keypoints,
                "repeats": repeats,
                "devices": devices,
                "torch": torch.__version__,
                **costs_as_json(costs),
            },
        )
    console = table_console()
    setting = f"{num_views} views, {height} x {width}, {num_keypoints} keypoints"
    for name in names:
        cost = costs[name]
        console.print(cost_table(cost, title=f"{name}: {setting}"))
        console.print(
            f"Intermediate tensors hold {cost.peak_bytes / 1e6:.1f} MB at once. Products are "
            "convolutions and matrix products; a multiply-accumulate is two operations. Times "
            f"are the median of {repeats}, on {devices[name]}.\n"
        )
        if cost.unknown:
            warn(f"{name}: not counted for want of a formula: {', '.join(sorted(cost.unknown))}")
    if (num_views, image_size, num_keypoints) == PAPER_SETTING:
        console.print(comparison_table(costs))


def _takes(model: nn.Module, image_size: tuple[int, int]) -> bool:
    """The reference network has no rule for cells that leave the image."""
    return all(side % _multiple(model) == 0 for side in image_size)


def _multiple(model: nn.Module) -> int:
    """What the sides of images must be multiples of."""
    return int(getattr(model, "side_multiple", 1))


def device_name(model: nn.Module) -> str:
    """Where the model is, in words that say what its times are worth."""
    device = next(model.parameters()).device
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    if device.type == "cpu":
        threads = torch.get_num_threads()
        return f"{platform.machine()} CPU, {threads} thread{'s' if threads > 1 else ''}"
    return str(device)
