"""The later passes over a capture: each map hears those of the frames around it."""

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

import torch

from deltas_geom import PosedViews
from deltas_nets.agree.agreed import agreed
from deltas_nets.agree.heard import Heard
from deltas_nets.agree.held import held
from deltas_nets.agree.neighbours import APART, neighbours, sample
from deltas_nets.captures.capture import Capture
from deltas_nets.captures.measured import MeasuredDepth
from deltas_nets.captures.spread import spread
from deltas_nets.captures.straight import straight
from deltas_nets.captures.work_size import camera_at
from deltas_nets.errors import UserError
from deltas_nets.network.known_depth import KnownDepth
from deltas_nets.network.unit import unit_of
from deltas_nets.outputs.first_maps import FirstMaps
from deltas_nets.predict.depth_map import DepthMap, KeypointDepths, PredictConfig, finished_map
from deltas_nets.predict.described import AtSize
from deltas_nets.predict.look import as_photographed
from deltas_nets.predict.ours import known_depth
from deltas_nets.predict.predictor import Predictor

__all__ = ["LaterPasses"]

REMEMBERED = 64
"""Maps of a pass that are kept in memory: 0.7 MB each."""
COMPARED = 8
"""Frames around that a map is compared with."""


class _First(NamedTuple):
    """A map of the first pass, its camera ``(1)`` at its size, and its record."""

    map: KnownDepth
    view: PosedViews
    record: dict[str, Any]


class LaterPasses:
    """Maps of a capture after they have heard each other.

    A map that has heard others is a better one to hear. What hears is the map of the first pass in
    every pass: one that hears and hears again forgets what it saw itself.

    Args:
        capture: the frames.
        first: the maps of the first pass.
        ids: the frames that have one.
        predictor: gives maps the last touch.

    Raises:
        UserError: a map is missing or damaged.
    """

    def __init__(
        self, capture: Capture, first: FirstMaps, ids: Sequence[str], predictor: Predictor
    ) -> None:
        self.capture, self.predictor = capture, predictor
        self.first = first
        self._read = lru_cache(maxsize=2 * REMEMBERED)(self._from_disk)
        points, views, sizes = [], [], []
        for id in ids:
            found = self._read(first, id)
            points.append(sample(found.map.depth, found.view))
            views.append(found.view)
            sizes.append((found.map.depth.shape[-2], found.map.depth.shape[-1]))
        cameras = PosedViews(*(torch.cat(parts) for parts in zip(*views, strict=True)))
        around = neighbours(torch.stack(points), cameras, sizes, apart=APART)
        self._around = {id: [ids[n] for n in near] for id, near in zip(ids, around, strict=True)}

    @torch.inference_mode()
    def hear(self, id: str, told: FirstMaps) -> KnownDepth:
        """The map ``(1, h, w)`` of a frame that has heard those of the pass before.

        Args:
            id: the frame.
            told: the maps of that pass.

        Raises:
            UserError: a map is gone.
        """
        own = self._read(self.first, id)
        heard = [self._read(told, near) for near in self._around[id]]
        return agreed(own.map, own.view, _by_size(heard))

    @torch.inference_mode()
    def finished(
        self,
        id: str,
        found: KnownDepth,
        config: PredictConfig,
        measured: MeasuredDepth | None = None,
    ) -> tuple[DepthMap, dict[str, Any]]:
        """A map as it is written, and what the first pass recorded of it.

        Args:
            id: of the frame.
            found: ``(1, h, w)``, which has heard others.
            config: sizes, confidence.
            measured: depth of the frame, to which the map is held.

        Raises:
            UserError: the image cannot be read.
        """
        photo = self.capture.frame(id)
        anchor = straight(photo)
        of_straight = config if anchor is photo else replace(config, size=None)
        size = (found.depth.shape[-2], found.depth.shape[-1])
        nothing = KeypointDepths(torch.zeros(0, 2), torch.zeros(0), size)
        drawn = self.drawn(id, found)
        if measured is not None:
            drawn = held(
                drawn, KnownDepth(*(part[0] for part in known_depth(anchor, measured, size)))
            )
        result = finished_map(anchor, drawn, nothing, of_straight)
        # A copy: the map stays in memory, and what is added to its record is not of the first pass.
        return as_photographed(result, anchor, config), dict(self._read(self.first, id).record)

    @torch.inference_mode()
    def drawn(self, id: str, found: KnownDepth) -> KnownDepth:
        """A map that has heard, as its image shows it, and compared with those around it.

        Raises:
            UserError: the image cannot be read.
        """
        known = found.depth[found.depth > 0]
        if not len(known):
            return found
        anchor = straight(self.capture.frame(id))
        unit = unit_of(float(known.median()), self.capture.metric)
        drawn = self.predictor.redrawn(anchor, found._replace(depth=found.depth * unit))
        drawn = drawn._replace(depth=drawn.depth / unit)
        around = [self._at_size(near) for near in spread(self._around[id], COMPARED)]
        return self.predictor.compared(self._at_size(id), drawn, around)

    def _at_size(self, id: str) -> AtSize:
        """A frame as the network saw it."""
        depth = self._read(self.first, id).map.depth
        return AtSize(straight(self.capture.frame(id)), (depth.shape[-2], depth.shape[-1]))

    def _from_disk(self, told: FirstMaps, id: str) -> _First:
        read = told.read(id)
        if read is None:
            what = f"a map of frame {id} from an earlier pass is gone or damaged"
            raise UserError(what, told.file(id), "run the same command again")
        found, record = read
        size = (found.depth.shape[-2], found.depth.shape[-1])
        return _First(found, camera_at(straight(self.capture.frame(id)), size), record)


def _by_size(heard: Sequence[_First]) -> list[Heard]:
    """Maps and cameras, those of one size together: mostly all of them."""
    groups: dict[torch.Size, list[_First]] = {}
    for other in heard:
        groups.setdefault(other.map.depth.shape, []).append(other)
    return [
        Heard(
            KnownDepth(*map(torch.stack, zip(*(one.map for one in alike), strict=True))),
            PosedViews(*map(torch.cat, zip(*(one.view for one in alike), strict=True))),
        )
        for alike in groups.values()
    ]
