"""Which scenes a data set holds: the folders that are there, and the split that is wanted."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from deltas_nets.captures.ids import ids_in_words
from deltas_nets.captures.readers.scannet import NESTING, is_scene
from deltas_nets.captures.text_lines import read_lines
from deltas_nets.errors import UserError

__all__ = ["ChosenScenes", "choose_scenes", "find_scenes"]

NAMED_SPLITS = {"train": range(707), "test": range(707, 807)}
"""Rooms by number: the paper trains on scans of the first 707 and tests on 100 others."""
_SCENE = re.compile(r"scene(\d{4})_\d{2}", re.ASCII)


class ChosenScenes(NamedTuple):
    """The scenes of a split.

    Attributes:
        folders: of those that are there, by name, in the order of the split.
        missing: names of the split that no folder has.
    """

    folders: Mapping[str, Path]
    missing: Sequence[str]


def find_scenes(root: Path) -> dict[str, Path]:
    """Scene folders in ``root``, ``root/scans`` and ``root/scans_test`` by name, sorted.

    A folder that is a scene itself counts as one.

    Raises:
        UserError: the folder does not exist, holds no scene, or two with one name.
    """
    layout = "name the folder that holds scans/ or scenes (color, depth, pose and intrinsic each)"
    if not root.is_dir():
        raise UserError("there is no such folder", root, layout)
    if is_scene(root):
        return {root.resolve().name: root}
    found: dict[str, Path] = {}
    for nest in (root, *(root / name for name in NESTING)):
        for child in sorted(nest.iterdir()) if nest.is_dir() else ():
            if not is_scene(child):
                continue
            if child.name in found:
                what = f"two folders are called {child.name} ({found[child.name]} is the other)"
                raise UserError(what, child, "remove or rename one of them")
            found[child.name] = child
    if not found:
        raise UserError("there is no scene in the folder", root, layout)
    return dict(sorted(found.items()))


def choose_scenes(root: Path, split: str, *, option: str = "--data.split") -> ChosenScenes:
    """The scenes of a split.

    Args:
        root: where they are, see :func:`find_scenes`.
        split: train, test, all, or a file with the name of a scene on each line.
        option: which option named the split, for errors.

    Raises:
        UserError: as :func:`find_scenes`; the file cannot be read or names no scene; none of the
            split's scenes is there.
    """
    found = find_scenes(root)
    if split == "all":
        return ChosenScenes(found, ())
    if split in NAMED_SPLITS:
        numbers = NAMED_SPLITS[split]
        folders = {name: path for name, path in found.items() if _number(name) in numbers}
        if not folders:
            what = (
                f"none of the {len(found)} scenes ({ids_in_words(found, 3)}) is in the split "
                f"{split}, scene{numbers[0]:04}_NN to scene{numbers[-1]:04}_NN"
            )
            raise UserError(what, root, f"use {option} all or {option} FILE")
        return ChosenScenes(folders, ())
    file = Path(split)
    names = list(dict.fromkeys(_read_names(file, option)))
    folders = {name: found[name] for name in names if name in found}
    missing = [name for name in names if name not in found]
    if not folders:
        what = f"none of the {len(names)} scenes of {file} is there ({ids_in_words(names, 3)})"
        raise UserError(what, root, "check --root, and the names in the file")
    return ChosenScenes(folders, missing)


def _read_names(file: Path, option: str) -> list[str]:
    remedy = f"name a file with {option}, or one of {', '.join(NAMED_SPLITS)} and all"
    names = []
    for number, words in read_lines(file, name="split", remedy=remedy):
        if len(words) != 1:
            what = f"line {number} of the split has {len(words)} words, not the name of a scene"
            raise UserError(what, file, "write a name on each line")
        names.append(words[0])
    if not names:
        raise UserError("the split names no scene", file, "write a name on each line")
    return names


def _number(name: str) -> int | None:
    match = _SCENE.fullmatch(name)
    return None if match is None else int(match[1])
