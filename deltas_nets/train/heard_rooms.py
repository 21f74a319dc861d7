"""Rooms whose maps have heard each other: what the stage that redraws learns from.

A room is a small capture. The network makes a map of each of its views from some of the others,
and the maps hear each other as those of a capture do, so they err as maps do on which frames agree.
"""

from pathlib import Path
from typing import NamedTuple

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor
from torch.utils.data import Dataset

from deltas_geom import PosedViews
from deltas_nets.agree.agreed import agreed
from deltas_nets.agree.heard import Heard
from deltas_nets.agree.neighbours import neighbours, sample
from deltas_nets.captures.posed_images import PosedImages
from deltas_nets.evaluate.rooms import RoomViews
from deltas_nets.network.deltas import Deltas
from deltas_nets.network.encoded import Encoded
from deltas_nets.network.known_depth import KnownDepth
from deltas_nets.outputs.atomic_files import write_atomically
from deltas_nets.train.step import DEPTH_RANGE

__all__ = ["HeardRooms", "HeardView", "hear_each_other"]

PASSES = 3
"""As of `deltas depth`."""


class HeardView(NamedTuple):
    """A view of a room.

    Attributes:
        image: ``(3, H, W)`` in [0, 1].
        agreed: ``(1, H, W)`` its map after it heard the others.
        depth: ``(1, H, W)`` true, metres.
    """

    image: Tensor
    agreed: KnownDepth
    depth: Tensor


class HeardRooms(Dataset[int]):
    """Makes rooms and keeps them in files; item i makes room i if it is not there, and is i.

    Args:
        rooms: as cameras and trackers give them, all of V views.
        model: makes the maps; it is not changed.
        folder: of the files, 15 MB each for ten views of 288 x 384.
        num_sources: of each map.
        seed: of which views these are.
    """

    def __init__(
        self,
        rooms: RoomViews,
        model: Deltas,
        folder: Path,
        *,
        num_sources: int = 2,
        seed: int = 0,
    ) -> None:
        self.rooms, self.model, self.folder = rooms, model, folder
        self.num_sources, self.seed = num_sources, seed

    def __len__(self) -> int:
        return len(self.rooms)

    def __getitem__(self, index: int) -> int:
        try:
            self.view(index, 0)
        except (OSError, SafetensorError, KeyError, ValueError):  # not there, or damaged
            room = self.rooms[index]
            content = save(self._heard(room, torch.Generator().manual_seed(self.seed + index)))
            self.folder.mkdir(parents=True, exist_ok=True)
            write_atomically(self._file(index), lambda opened: opened.write(content))
        return index

    def view(self, index: int, number: int) -> HeardView:
        """One of the views of a room that is there.

        Raises:
            OSError, SafetensorError, KeyError, ValueError: it is not.
        """
        with safe_open(self._file(index), framework="pt") as opened:
            names = ("images", "depth", "deviation", "truth")
            image, depth, deviation, truth = (opened.get_slice(name)[number] for name in names)
        return HeardView(
            image.float() / 255, KnownDepth(depth.float(), deviation.float()), truth.float()
        )

    def _file(self, index: int) -> Path:
        return self.folder / f"{index}.safetensors"

    @torch.inference_mode()
    def _heard(self, room: PosedImages, random: torch.Generator) -> dict[str, Tensor]:
        heard = hear_each_other(self.maps(room, random), room.views)
        return {
            "images": room.images.contiguous(),
            "depth": heard.depth.half(),
            "deviation": heard.deviation.half(),
            "truth": room.depth[:, None].half(),
        }

    def maps(self, room: PosedImages, random: torch.Generator) -> KnownDepth:
        """A map ``(V, 1, H, W)`` of each view, as the network finds it."""
        size = (room.depth.shape[-2], room.depth.shape[-1])
        one_by_one = [
            self.model.encode(image[None, None].float() / 255).each()[0] for image in room.images
        ]
        maps = []
        for view in range(len(one_by_one)):
            others = torch.randperm(len(one_by_one) - 1, generator=random)[: self.num_sources]
            chosen = [view, *(int(other) + (int(other) >= view) for other in others)]
            prediction = self.model.from_encoded(
                Encoded.joined([one_by_one[v] for v in chosen]),
                PosedViews(*(part[chosen][None] for part in room.views)),
                DEPTH_RANGE,
                image_size=size,
            )
            maps.append(KnownDepth(prediction.depth, prediction.std / prediction.depth))
        return KnownDepth(*(torch.cat(parts) for parts in zip(*maps, strict=True)))


def hear_each_other(alone: KnownDepth, views: PosedViews, *, passes: int = PASSES) -> KnownDepth:
    """Maps of a small capture after some passes, all of them in memory.

    Args:
        alone: ``(V, 1, H, W)`` each as the network finds it.
        views: their cameras, ``(V)``.
        passes: the first of which is over.
    """
    count, size = len(alone.depth), (alone.depth.shape[-2], alone.depth.shape[-1])
    cameras = [PosedViews(*(part[v : v + 1] for part in views)) for v in range(count)]
    points = [sample(depth, view) for depth, view in zip(alone.depth, cameras, strict=True)]
    around = neighbours(torch.stack(points), views, [size] * count)
    told = alone
    for _ in range(1, passes):
        heard = []
        for v, near in enumerate(around):
            own = KnownDepth(*(part[v] for part in alone))
            others = Heard(
                KnownDepth(*(part[near] for part in told)),
                PosedViews(*(part[near] for part in views)),
            )
            heard.append(agreed(own, cameras[v], [others] if near else []))
        told = KnownDepth(*map(torch.stack, zip(*heard, strict=True)))
    return told
