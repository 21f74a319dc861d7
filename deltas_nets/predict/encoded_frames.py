"""The frames of a capture, read and encoded once each, however many view sets they are in."""

from collections import OrderedDict
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from deltas_nets.captures.capture import Frame
from deltas_nets.captures.images import Span
from deltas_nets.captures.work_size import load_image
from deltas_nets.network.deltas import Deltas
from deltas_nets.network.encoded import Encoded

CAPACITY = 24
"""Frames that are kept: 15 MB each at the default size."""

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
        new = {
            key: frame for key, frame in zip(keys, frames, strict=True) if key not in self._known
        }
        views = {key: self._known[key] for key in keys if key not in new}
        if new:
            device = next(self.model.parameters()).device
            images = torch.stack([load_image(frame, work_size=work_size) for frame in new.values()])
            encoded = self.model.encode(images.to(device)[None]).each()
            for key, image, view in zip(new, images, encoded, strict=True):
                views[key] = EncodedImages(image, view)
        for key in keys:
            self._known[key] = views[key]
            self._known.move_to_end(key)
        while len(self._known) > self.capacity:
            self._known.popitem(last=False)
        return EncodedImages(
            torch.stack([views[key].images for key in keys]),
            Encoded.joined([views[key].encoded for key in keys]),
        )
