"""Image pairs with intrinsics and relative pose in a text file, and poses of them from matches.

A line of the file is NAME NAME ROTATED ROTATED, then K of both (9 numbers each, row by row) and
second_from_first (16). Images lie beside the file or in its folder ``images``.

Source: Sarlin et al., SuperGlue (CVPR 2020): the format of its evaluation. Without depth a baseline
has no length, so poses come from essential matrices and their translations are directions.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from deltas_geom.cameras.pixels import resize_intrinsics
from deltas_nets.captures.images import decode, resize_image
from deltas_nets.captures.text_lines import read_text
from deltas_nets.captures.work_size import fit_work_size
from deltas_nets.errors import UserError
from deltas_nets.evaluate.detectors.config import WORK_PIXELS, TableConfig
from deltas_nets.evaluate.detectors.features import Features
from deltas_nets.evaluate.detectors.matched import mutual_nearest
from deltas_nets.evaluate.detectors.pose.relative import relative_pose_from_matches
from deltas_nets.evaluate.detectors.registry import NamedExtractor
from deltas_nets.evaluate.detectors.scores import PoseError, pose_error, share_within

__all__ = [
    "ImagePair",
    "RelativeScores",
    "load_pair",
    "matched_pixels",
    "read_pairs",
    "score_pairs",
]

NUMBERS = 38
LIMITS = (5.0, 10.0, 20.0)
"""Degrees."""


class ImagePair(NamedTuple):
    """Two images without depth.

    Attributes:
        images: their files.
        K: ``(2, 3, 3)`` at the images' own size.
        second_from_first: ``(4, 4)``.
    """

    images: tuple[Path, Path]
    K: Tensor
    second_from_first: Tensor


class RelativeScores(NamedTuple):
    """A detector on all pairs.

    Attributes:
        points: mean number in an image.
        matches: mean number of mutual nearest neighbours of a pair.
        rotation: share of pairs whose rotation is within 5, 10 and 20 degrees.
        direction: the same of the direction of the baseline.
        pairs: how many.
    """

    points: float
    matches: float
    rotation: tuple[float, ...]
    direction: tuple[float, ...]
    pairs: int


def read_pairs(file: Path) -> list[ImagePair]:
    """The pairs of a file.

    Raises:
        UserError: a line is not of the form above, or an image is not there.
    """
    pairs = []
    remedy = "write NAME NAME ROTATED ROTATED, K of both and second_from_first: 38 words"
    text = read_text(file, name="list of pairs", remedy=remedy)
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split()
        if not words:
            continue
        where = f"{file}, line {number}"
        if len(words) != NUMBERS:
            raise UserError(f"{len(words)} words", where, remedy)
        try:
            numbers = torch.tensor([float(word) for word in words[2:]], dtype=torch.float64)
        except ValueError as error:
            raise UserError(f"no number ({error})", where, remedy) from None
        if not bool(numbers.isfinite().all()):
            raise UserError("no number (one is not finite)", where, remedy)
        if bool(numbers[:2].any()):
            raise UserError("rotated images are not read", where, "write 0 0 after the names")
        names = [_image(file.parent, name, where) for name in words[:2]]
        K = numbers[2:20].reshape(2, 3, 3)
        pairs.append(ImagePair((names[0], names[1]), K, numbers[20:].reshape(4, 4)))
    if not pairs:
        raise UserError("the file holds no pairs", file, "write a line a pair")
    return pairs


@torch.inference_mode()
def score_pairs(
    extractors: Sequence[NamedExtractor],
    pairs: Sequence[ImagePair],
    config: TableConfig,
    *,
    report: Callable[[str], None] = lambda _: None,
) -> dict[str, RelativeScores]:
    """Relative poses of every pair from every detector's matches.

    Args:
        extractors: the detectors.
        pairs: from :func:`read_pairs`.
        config: the protocol.
        report: called with the names of every finished pair.

    Raises:
        UserError: an image cannot be read.
    """
    errors: dict[str, list[PoseError]] = {one.name: [] for one in extractors}
    points: dict[str, list[int]] = {one.name: [] for one in extractors}
    matched: dict[str, list[int]] = {one.name: [] for one in extractors}
    for pair in pairs:
        images, K = load_pair(pair, config)
        for name, extract, _ in extractors:
            first, second = (extract(image, config.detection) for image in images)
            one, two = matched_pixels(first, second)
            found = relative_pose_from_matches(one, two, K, config.essential)
            estimated = None if found is None else found.model
            errors[name].append(pose_error(estimated, pair.second_from_first))
            points[name] += [len(first.pixels), len(second.pixels)]
            matched[name].append(len(one))
        report(" ".join(file.name for file in pair.images))
    return {
        name: RelativeScores(
            points=sum(points[name]) / len(points[name]),
            matches=sum(matched[name]) / len(found),
            rotation=_shares([error.rotation for error in found], sum(matched[name])),
            direction=_shares([error.direction for error in found], sum(matched[name])),
            pairs=len(found),
        )
        for name, found in errors.items()
    }


def load_pair(pair: ImagePair, config: TableConfig) -> tuple[list[Tensor], Tensor]:
    """Both images ``(3, H, W)`` in [0, 1] at the work size, and their K ``(2, 3, 3)``."""
    loaded = [_load(file, K, config) for file, K in zip(pair.images, pair.K, strict=True)]
    return [image for image, _ in loaded], torch.stack([K for _, K in loaded])


def matched_pixels(first: Features, second: Features) -> tuple[Tensor, Tensor]:
    """Pixels ``(P, 2)`` of mutual nearest neighbours."""
    matches = mutual_nearest(first.descriptors, second.descriptors)
    return first.pixels[matches[:, 0]], second.pixels[matches[:, 1]]


def _shares(errors: Sequence[float], matches: int) -> tuple[float, ...]:
    return tuple(share_within(errors, limit, matches) for limit in LIMITS)


def _image(folder: Path, name: str, where: str) -> Path:
    for file in (folder / name, folder / "images" / name):
        if file.is_file():
            return file
    raise UserError(f"no image {name}", where, "put it beside the file or into images/")


def _load(file: Path, K: Tensor, config: TableConfig) -> tuple[Tensor, Tensor]:
    """An image ``(3, H, W)`` in [0, 1] and its K ``(3, 3)``, at the work size."""
    remedy = "name pairs of JPEG or PNG images"
    pixels = np.asarray(decode(file, remedy=remedy).convert("RGB"))
    old = (pixels.shape[0], pixels.shape[1])
    size = config.work_size or fit_work_size(old, max_pixels=WORK_PIXELS)
    resized = np.ascontiguousarray(resize_image(pixels, size))
    image = torch.from_numpy(resized).permute(2, 0, 1).contiguous().float() / 255
    return image, resize_intrinsics(K, old_size=old, new_size=size)
