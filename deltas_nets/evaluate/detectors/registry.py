"""Detectors by name, as a command line has them: NAME, or NAME=FILE of weights."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from deltas_nets.errors import UserError
from deltas_nets.evaluate.detectors.aliked import aliked
from deltas_nets.evaluate.detectors.classical import orb, sift
from deltas_nets.evaluate.detectors.dense import disk, superpoint, xfeat
from deltas_nets.evaluate.detectors.features import DetectionConfig, Extractor, Features
from deltas_nets.evaluate.detectors.own import ours
from deltas_nets.network.lite.detector import spread_points
from deltas_nets.weights_file import sha256_of, weights_file, weights_record

__all__ = ["LEARNED", "WITHOUT_WEIGHTS", "NamedExtractor", "load_extractors", "spread"]

CHANCE = 300
"""Spread points where no number is asked for."""


class NamedExtractor(NamedTuple):
    """A detector as a table has it.

    Attributes:
        name: its row.
        extract: what finds the features.
        weights: what identifies its file; empty without one.
    """

    name: str
    extract: Extractor
    weights: dict[str, Any]


def spread(image: Tensor, config: DetectionConfig) -> Features:
    """Even coverage that has not looked at the image: what chance gives. It describes nothing."""
    size = (image.shape[-2], image.shape[-1])
    pixels = spread_points(config.num_points or CHANCE, image_size=size)
    return Features(pixels, torch.zeros(len(pixels), 0))


WITHOUT_WEIGHTS: dict[str, Extractor] = {"orb": orb, "sift": sift, "spread": spread}
"""Detectors that nobody trained."""
LEARNED: dict[str, Callable[[Path], Extractor]] = {
    "aliked": aliked,
    "disk": disk,
    "superpoint": superpoint,
    "xfeat": xfeat,
}
"""Detectors of others, from a file of published weights."""
OURS = "ours"


def load_extractors(words: Sequence[str]) -> list[NamedExtractor]:
    """Detectors in their order.

    Args:
        words: orb, sift, spread, ours; ours=FILE of deltas train or of the published checkpoint;
            aliked=FILE, disk=FILE, superpoint=FILE, xfeat=FILE.

    Raises:
        UserError: no such detector, one twice, or a file is missing or holds something else.

    Example:
        >>> [one.name for one in load_extractors(["orb", "ours"])]
        ['orb', 'ours']
    """
    found = [_load(word) for word in words]
    names = [one.name for one in found]
    for number, name in enumerate(names):
        if name in names[:number]:
            raise UserError("the same detector twice", name, "leave one out")
    return found


def _load(word: str) -> NamedExtractor:
    name, given, file = word.partition("=")
    if given and not file:
        raise UserError("no file is named", word, f"write {name}=FILE")
    if name in WITHOUT_WEIGHTS and not given:
        return NamedExtractor(name, WITHOUT_WEIGHTS[name], {})
    if name in LEARNED:
        if not given:
            raise UserError(f"{name} needs weights", word, f"write {name}=FILE")
        extract = LEARNED[name](Path(file))
        return NamedExtractor(
            name, extract, {"name": Path(file).name, "sha256": sha256_of(Path(file))}
        )
    if name == OURS:
        return _of_ours(file)
    known = ", ".join([OURS, *WITHOUT_WEIGHTS, *(f"{name}=FILE" for name in LEARNED)])
    raise UserError("no such detector", word, f"use {known}")


def _of_ours(file: str) -> NamedExtractor:
    """The shipped network, or that of a file under a name that tells files apart."""
    name = f"{OURS}: {'/'.join(Path(file).parts[-2:])}" if file else OURS
    chosen = file or "deltas-small"
    extract = ours(chosen)
    if weights_file(chosen).suffix == ".safetensors":
        return NamedExtractor(name, extract, weights_record(chosen) | {"name": Path(chosen).name})
    record = {"name": Path(chosen).name, "sha256": sha256_of(Path(chosen))}
    return NamedExtractor(name, extract, record)
