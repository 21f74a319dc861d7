"""The frames of a capture by their descriptors, for maps that are compared with them."""

from collections import OrderedDict
from collections.abc import Sequence
from threading import Lock
from typing import NamedTuple

import torch
from torch import Tensor

from deltas_nets.agree.compared import Described, compared
from deltas_nets.captures.capture import Frame
from deltas_nets.captures.work_size import camera_at
from deltas_nets.network.known_depth import KnownDepth
from deltas_nets.predict.encoded_frames import EncodedFrames

__all__ = ["AtSize", "DescribedFrames"]

CAPACITY = 500_000_000
"""Bytes: of 540 frames at 240 x 320, of 135 at 480 x 640. Encoding one again takes as long as
comparing with five."""
STEPS = 127
"""Of a number of a descriptor, which is kept in eight bits: cosines move by 0.002."""


class AtSize(NamedTuple):
    """A straight frame, and the (height, width) at which the network saw it."""

    frame: Frame
    size: tuple[int, int]


class DescribedFrames:
    """Remembers the descriptors of the frames used last, which are a part of what is encoded.

    Args:
        encode: the encoder that makes them.
        capacity: bytes that are remembered, or one frame where that is more.
    """

    def __init__(self, encode: EncodedFrames, *, capacity: int = CAPACITY) -> None:
        self.encode, self.capacity = encode, capacity
        self._known: OrderedDict[tuple[object, ...], Tensor] = OrderedDict()
        self._lock = Lock()  # threads share it

    @torch.inference_mode()
    def compared(self, anchor: AtSize, found: KnownDepth, others: Sequence[AtSize]) -> KnownDepth:
        """A map ``(1, h, w)`` of the anchor, compared with other frames.

        Raises:
            UserError: an image cannot be read.
        """
        device = next(self.encode.model.parameters()).device
        own, *around = map(self, (anchor, *others))
        return compared(found.to(device), own, around).to("cpu")

    def __call__(self, seen: AtSize) -> Described:
        """A frame's descriptors and its camera at their size.

        Raises:
            UserError: the image cannot be read.
        """
        maps = self._maps(seen)
        size = (maps.shape[0], maps.shape[1])
        return Described(maps.flatten(0, 1).float() / STEPS, size, camera_at(seen.frame, size))

    def _maps(self, seen: AtSize) -> Tensor:
        """``(h, w, D)`` in steps."""
        frame, size = seen
        key = (frame.image_path, frame.image_span, size)
        with self._lock:
            known = self._known.get(key)
        if known is None:
            maps = self.encode([frame], work_size=size).encoded.descriptors.maps[0, 0]
            known = (maps.permute(1, 2, 0) * STEPS).round().to(torch.int8).contiguous()
        with self._lock:
            self._known[key] = known
            self._known.move_to_end(key)
            while len(self._known) > 1 and self._bytes() > self.capacity:
                self._known.popitem(last=False)
        return known

    def _bytes(self) -> int:
        return sum(maps.nbytes for maps in self._known.values())
