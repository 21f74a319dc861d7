"""Does an exported network give the depth of the one it was made of?"""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from deltas_nets.captures.posed_images import PosedImages
from deltas_nets.errors import UserError
from deltas_nets.export.graph import OUTPUTS, ExportConfig, FixedDeltas
from deltas_nets.network.deltas import Deltas
from deltas_nets.rooms import render_room

TOLERANCE = 1e-3
"""Largest relative difference of depth at any pixel."""
ROOM_SEEDS = (901, 902, 903)
"""Of rooms that no training sees."""

Inputs = tuple[Tensor, Tensor, Tensor]
RunExported = Callable[[Inputs], dict[str, Tensor]]


class Agreement(NamedTuple):
    """How far two networks are apart on a procedural room.

    Attributes:
        relative: largest relative difference of depth at any pixel.
        room: seed of the room.
    """

    relative: float
    room: int


def inputs_of(room: PosedImages, device: torch.device | str = "cpu") -> Inputs:
    """What an exported network takes, from one uint8 scene ``(V, 3, H, W)``."""
    images = room.images.to(device)[None].float() / 255
    return images, room.views.K.to(device)[None], room.views.cam_from_world.to(device)[None]


def check_agreement(
    run: RunExported, model: Deltas, config: ExportConfig, *, runtime: str, out: Path
) -> Agreement:
    """Compare depth on a procedural room, pixel by pixel.

    Two detections of equal strength may be ranked either way, by rounding, and then the two
    networks triangulate other points. A room where that happens tells nothing about the graph,
    and the next one is taken.

    Args:
        run: the exported network.
        model: what it was made of.
        config: what is fixed.
        runtime: what runs the exported network, for the error.
        out: the file, for the error.

    Raises:
        UserError: they differ by more than the tolerance, or detect other points in every room.
    """
    differences = _compared(run, FixedDeltas(model, config).eval(), config)
    for room, found, wanted in differences:
        if not same_points(found["keypoints"], wanted["keypoints"]):
            continue
        relative = relative_difference(found["depth"], wanted["depth"])
        if relative <= TOLERANCE:  # NaN is not
            return Agreement(relative, room)
        raise UserError(
            f"{runtime} gives a depth that differs by {relative:.2g}, more than {TOLERANCE:g}",
            out,
            f"nothing was written; try other versions of torch and {runtime}",
        )
    raise UserError(
        f"{runtime} detects other points in {len(ROOM_SEEDS)} rooms",
        out,
        f"nothing was written; try other versions of torch and {runtime}",
    )


def relative_difference(found: Tensor, wanted: Tensor) -> float:
    """Largest difference by what is wanted; NaN if one is NaN."""
    return float(((found - wanted).abs() / wanted).max())


def same_points(found: Tensor, wanted: Tensor) -> bool:
    """Are these the same keypoints ``(1, N, 2)``, in any order?"""
    ours, others = (sorted(pixels[0].tolist()) for pixels in (found, wanted))
    return bool(ours == others)


def _compared(
    run: RunExported, eager: FixedDeltas, config: ExportConfig
) -> Iterator[tuple[int, dict[str, Tensor], dict[str, Tensor]]]:
    device = next(eager.parameters()).device
    for seed in ROOM_SEEDS:
        room = render_room(seed, num_views=config.num_views, image_size=config.image_size)
        with torch.no_grad():
            wanted = eager(*inputs_of(room, device))
        found = run(inputs_of(room))
        yield seed, found, {name: wanted[name].cpu() for name in OUTPUTS}
