"""Frames of ScanNet to train on: an item is a view set of one scene, with its depth."""

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import Dataset

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.ids import ids_in_words
from deltas_nets.captures.posed_images import PosedImages
from deltas_nets.captures.view_sets import ViewSet
from deltas_nets.captures.work_size import depth_at_image, load_views
from deltas_nets.config.scannet import ScanNetConfig
from deltas_nets.datasets.scene_cache import read_scene_cached
from deltas_nets.datasets.scene_names import choose_scenes
from deltas_nets.datasets.scenes import LeftOut, left_out, skipped
from deltas_nets.datasets.skip_list import SkipList, read_skip_list
from deltas_nets.datasets.view_rules import ByBaseline, ByGap, ViewRule
from deltas_nets.errors import UserError

__all__ = ["ScanNetViewSets", "open_scannet", "view_rule"]


MOST = 2**62
"""The largest number of a frame, from which those of its sources can be counted."""


class ScanNetViewSets(Dataset[PosedImages]):
    """Item i is an anchor and its sources; a map-style data set for any ``DataLoader``.

    Nothing is random, and no image is decoded before its item is asked for.

    Args:
        scenes: by name.
        rule: which frames are looked at together.
        image_size: (height, width) of the items.
    """

    def __init__(
        self, scenes: Mapping[str, Capture], rule: ViewRule, *, image_size: tuple[int, int]
    ) -> None:
        self.scenes = list(scenes.items())
        self.rule = rule
        self.image_size = image_size
        self.anchors = _all_anchors([scene for _, scene in self.scenes], rule)

    def __len__(self) -> int:
        return len(self.anchors)

    def __getitem__(self, index: int) -> PosedImages:
        """Images uint8 ``(V, 3, H, W)``, the views' cameras, depth ``(V, H, W)`` metres.

        The anchor is view 0 and defines the coordinates.

        Raises:
            UserError: a file cannot be read.
        """
        scene, positions = self._positions(index)
        frames = [scene.frames.at(position) for position in positions]
        images, views = load_views(frames, work_size=self.image_size)
        depth = np.stack([depth_at_image(frame, work_size=self.image_size) for frame in frames])
        # As bytes, which they were: a quarter of the memory on the way from a worker.
        return PosedImages((images * 255).round().byte(), views, torch.from_numpy(depth))

    def view_set(self, index: int) -> tuple[str, ViewSet]:
        """The scene of an item, and the ids of its frames."""
        scene, positions = self._positions(index)
        name, _ = self.scenes[self.anchors[index, 0]]
        anchor, *sources = map(scene.frames.id_at, positions)
        return name, ViewSet(anchor, tuple(sources))

    def _positions(self, index: int) -> tuple[Capture, list[int]]:
        if not 0 <= index < len(self):
            # Also what ends a `for` loop over the data set.
            raise IndexError(f"view set {index} of {len(self)}")
        number, anchor = map(int, self.anchors[index])
        _, scene = self.scenes[number]
        return scene, [anchor, *self.rule.sources(scene.frames, anchor)]


def view_rule(config: ScanNetConfig, num_views: int) -> ViewRule:
    """How the config wants views to be chosen."""
    if config.tuples == "gap":
        return ByGap(config.gap_of(num_views), num_views)
    return ByBaseline(*config.baseline, float(np.radians(config.max_rotation)), num_views)


def open_scannet(
    config: ScanNetConfig,
    split: str,
    *,
    num_views: int,
    image_size: tuple[int, int],
    cache: Path | None = None,
    option: str = "--data.split",
    report: Callable[[str], None] = lambda _: None,
) -> ScanNetViewSets:
    """Read the poses of a split's scenes and find its view sets.

    Args:
        config: where the scenes are, what to skip, which frames go together.
        split: a split's name or file.
        num_views: V, the anchor among them.
        image_size: (height, width) of the items.
        cache: folder that keeps poses.
        option: which option named the split, for errors.
        report: gets a line of what there is, one of what is doubtful and one of what is missing.

    Raises:
        UserError: there is no root, no scene, no view set; or a file of a scene is malformed.
    """
    if config.root is None:
        raise UserError("where are the scenes?", "--data scannet", "add --root DIR")
    root = Path(config.root)
    skip = SkipList() if config.skip is None else read_skip_list(Path(config.skip))
    scenes = {}
    try:
        folders, missing = choose_scenes(root, split, option=option)
        for name, path in folders.items():
            if name not in skip.whole:
                scene = read_scene_cached(path, cache)
                _check_numbers(scene)
                scenes[name] = skipped(scene, skip.listed(name, scene.frames.numbers))
    except OSError as error:
        what = f"the scenes cannot be read ({error.strerror or error})"
        raise UserError(what, error.filename or root, "check it, and its permissions") from error
    rule = view_rule(config, num_views)
    found = ScanNetViewSets(scenes, rule, image_size=image_size)
    missed = sum(map(left_out, scenes.values()), LeftOut())
    usable = sum(len(scene.frames) for scene in scenes.values())
    unused = len(folders) - len(scenes)
    counts = f"{usable} usable frames in {len(scenes)} scenes; left out: {missed.in_words()}"
    counts += f", {unused} scenes listed as a whole" if unused else ""
    if not len(found):
        remedy = "check the numbers of the frames, --data.skip, and --data.gap or --data.baseline"
        raise UserError(f"there are no {rule.in_words()} ({counts})", root, remedy)
    report(f"{option} {Path(split).name}: {len(found)} times {rule.in_words()}; {counts}")
    doubtful = [doubt for scene in scenes.values() for doubt in scene.doubts]
    if doubtful:
        more = f" (and {len(doubtful) - 1} warnings more)" if len(doubtful) > 1 else ""
        report(f"warning: {doubtful[0]}{more}")
    if missing:
        total = len(folders) + len(missing)
        report(f"{len(missing)} of its {total} scenes are not there: {ids_in_words(missing)}")
    return found


def _check_numbers(scene: Capture) -> None:
    """Numbers of frames are counted on from: an integer of the machine has to hold them."""
    ids = scene.frames.arrays.ids
    large = [id.decode() for id in ids if int(id) > MOST] if ids.itemsize >= len(str(MOST)) else []
    if large:
        what = f"frame {ids_in_words(large, 1)}: the number is too large"
        raise UserError(what, scene.path, f"number frames by at most {MOST}, best from 0")


def _all_anchors(scenes: list[Capture], rule: ViewRule) -> NDArray[np.int32]:
    """``(T, 2)`` number of the scene and position of the anchor, of every view set."""
    parts = [np.zeros((0, 2), dtype=np.int32)]
    for number, scene in enumerate(scenes):
        positions = rule.anchors(scene.frames)
        scene_number = np.full(len(positions), number)
        parts.append(np.stack([scene_number, positions], axis=1).astype(np.int32))
    return np.concatenate(parts)
