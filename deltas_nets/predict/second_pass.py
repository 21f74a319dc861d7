"""The second pass over a capture: each map hears those of the frames around it."""

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

import torch

from deltas_geom import PosedViews
from deltas_geom.cameras.pixels import resize_intrinsics
from deltas_nets.agree.agreed import agreed
from deltas_nets.agree.neighbours import neighbours, sample
from deltas_nets.agree.seen_from import seen_from
from deltas_nets.captures.capture import Capture
from deltas_nets.captures.straight import straight
from deltas_nets.errors import UserError
from deltas_nets.network.known_depth import KnownDepth
from deltas_nets.outputs.first_maps import FirstMaps
from deltas_nets.predict.depth_map import DepthMap, KeypointDepths, PredictConfig, finished_map
from deltas_nets.predict.look import as_photographed

__all__ = ["SecondPass"]

REMEMBERED = 32
"""Maps that are kept in memory: 0.7 MB each."""


class _First(NamedTuple):
    """A map of the first pass, its camera ``(1)`` at its size, and its record."""

    map: KnownDepth
    view: PosedViews
    record: dict[str, Any]


class SecondPass:
    """Maps of a capture after they have heard each other.

    Args:
        capture: the frames.
        first: the maps of the first pass.
        ids: the frames that have one.

    Raises:
        UserError: a map is missing or damaged.
    """

    def __init__(self, capture: Capture, first: FirstMaps, ids: Sequence[str]) -> None:
        self.capture = capture
        self.first = first
        self._read = lru_cache(maxsize=REMEMBERED)(self._from_disk)
        points, views, sizes = [], [], []
        for id in ids:
            found = self._read(id)
            points.append(sample(found.map.depth, found.view))
            views.append(found.view)
            sizes.append((found.map.depth.shape[-2], found.map.depth.shape[-1]))
        cameras = PosedViews(*(torch.cat(parts) for parts in zip(*views, strict=True)))
        around = neighbours(torch.stack(points), cameras, sizes)
        self._around = {id: [ids[n] for n in near] for id, near in zip(ids, around, strict=True)}

    @torch.inference_mode()
    def __call__(self, id: str, config: PredictConfig) -> tuple[DepthMap, dict[str, Any]]:
        """The map of a frame, and what the first pass recorded of it.

        Raises:
            UserError: the image cannot be read, or a map of the first pass is gone.
        """
        own = self._read(id)
        size = (own.map.depth.shape[-2], own.map.depth.shape[-1])
        heard = [self._read(near) for near in self._around[id]]
        seen = [
            seen_from(
                KnownDepth(*(torch.stack(parts) for parts in zip(*alike[0], strict=True))),
                PosedViews(*(torch.cat(parts) for parts in zip(*alike[1], strict=True))),
                own.view,
                image_size=size,
            )
            for alike in _by_size(heard)
        ]
        found = own.map
        if seen:
            found = agreed(found, KnownDepth(*map(torch.cat, zip(*seen, strict=True))))
        photo = self.capture.frame(id)
        anchor = straight(photo)
        of_straight = config if anchor is photo else replace(config, size=None)
        nothing = KeypointDepths(torch.zeros(0, 2), torch.zeros(0), size)
        result = finished_map(anchor, found, nothing, of_straight)
        return as_photographed(result, anchor, config), own.record

    def _from_disk(self, id: str) -> _First:
        read = self.first.read(id)
        if read is None:
            what = f"the map of the first pass of frame {id} is gone or damaged"
            raise UserError(what, self.first.file(id), "run the same command again")
        found, record = read
        frame = straight(self.capture.frame(id))
        size = (found.depth.shape[-2], found.depth.shape[-1])
        K = resize_intrinsics(torch.tensor(frame.K), old_size=frame.image_size, new_size=size)
        view = PosedViews(K[None], torch.tensor(frame.cam_from_world)[None])
        return _First(found, view, record)


def _by_size(heard: Sequence[_First]) -> list[tuple[list[KnownDepth], list[PosedViews]]]:
    """Maps and cameras, those of one size together: mostly all of them."""
    groups: dict[torch.Size, tuple[list[KnownDepth], list[PosedViews]]] = {}
    for other in heard:
        maps, views = groups.setdefault(other.map.depth.shape, ([], []))
        maps.append(other.map)
        views.append(other.view)
    return list(groups.values())
