"""The frames of a capture, read and encoded once each, however many view sets they are in."""

from collections import OrderedDict
from collections.abc import Sequence
from pathlib import Path
from threading import Lock
from typing import NamedTuple

import torch
from torch import Tensor

from deltas_nets.captures.capture import Frame
from deltas_nets.captures.images import Span
from deltas_nets.captures.work_size import load_image
from deltas_nets.network.deltas import Deltas
from deltas_nets.network.encoded import Encoded
from deltas_nets.predict.depth_map import WORK_PIXELS

CAPACITY = 24
"""Frames that are kept, of 120 000 pixels, which take 15 MB each; of larger ones fewer."""

_Key = tuple[Path, Span | None, tuple[int, int]]


class EncodedImages(NamedTuple):
    """A view set as the network's later stages want it.

    Attributes:
        images: ``(V, 3, h, w)`` as the encoder saw them.
        encoded: of one view set of V images.
    """

    images: Tensor
    encoded: Encoded


class EncodedFrames:
    """Reads and encodes frames, and remembers those used last.

    Args:
        model: whose encoder it is; its weights must not change meanwhile.
        capacity: how many frames are remembered.
    """

    def __init__(self, model: Deltas, *, capacity: int = CAPACITY) -> None:
        self.model = model
        self.capacity = capacity
        self._known: OrderedDict[_Key, EncodedImages] = OrderedDict()
        self._turns: dict[_Key, Lock] = {}
        self._lock = Lock()  # threads share it

    @torch.inference_mode()
    def __call__(self, frames: Sequence[Frame], *, work_size: tuple[int, int]) -> EncodedImages:
        """The frames of a view set, those together that are not known yet.

        Args:
            frames: the anchor, then its sources.
            work_size: (height, width) that the network sees.

        Raises:
            UserError: an image cannot be read.
        """
        keys = [(frame.image_path, frame.image_span, work_size) for frame in frames]
        views = {key: self._view(key, frame) for key, frame in zip(keys, frames, strict=True)}
        with self._lock:
            for key in keys:
                self._known[key] = views[key]
                self._known.move_to_end(key)
            while self._full():
                self._known.popitem(last=False)
        return EncodedImages(
            torch.stack([views[key].images for key in keys]),
            Encoded.joined([views[key].encoded for key in keys]),
        )

    def _full(self) -> bool:
        pixels = sum(height * width for *_, (height, width) in self._known)
        return len(self._known) > self.capacity or pixels > self.capacity * WORK_PIXELS

    def _view(self, key: _Key, frame: Frame) -> EncodedImages:
        """A frame encoded, by one thread while others that want it wait."""
        with self._lock:
            turn = self._turns.setdefault(key, Lock())
        with turn:
            with self._lock:
                known = self._known.get(key)
            if known is None:
                known = self._encoded(frame, key[-1])
                with self._lock:
                    self._known[key] = known
        with self._lock:
            self._turns.pop(key, None)
        return known

    def _encoded(self, frame: Frame, work_size: tuple[int, int]) -> EncodedImages:
        """One image alone, so that what comes out does not depend on which others are known."""
        image = load_image(frame, work_size=work_size)
        device = next(self.model.parameters()).device
        (encoded,) = self.model.encode(image.to(device)[None, None]).each()
        return EncodedImages(image, encoded)
