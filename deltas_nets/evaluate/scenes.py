"""Which scenes are scored: captures, folders of captures, and lists of them in files."""

import os
from collections.abc import Sequence
from pathlib import Path

from deltas_nets.captures.ids import ids_in_words, natural_key
from deltas_nets.captures.opening import READERS
from deltas_nets.captures.readers import scannet
from deltas_nets.captures.text_lines import read_lines
from deltas_nets.datasets.scene_names import choose_scenes, find_scenes
from deltas_nets.errors import UserError
from deltas_nets.terminal import warn

__all__ = ["named_scenes", "scenes_in", "scenes_of_split"]


def named_scenes(paths: Sequence[Path], listed: Path | None = None) -> dict[str, Path]:
    """Captures by name.

    Args:
        paths: captures, or folders of captures.
        listed: a file with a scene on each line, relative to the only path, or to the file's folder
            where there is none.

    Raises:
        UserError: a path does not exist, or the list cannot be read, or names what is not there.
    """
    if listed is not None:
        if len(paths) > 1:
            what = f"a list of scenes is relative to one folder, not to {len(paths)}"
            raise UserError(what, "--scenes", "name one folder")
        root = paths[0] if paths else listed.parent
        names = _lines(listed)
        missing = [name for name in names if not (root / name).exists()]
        if missing:
            what = f"{len(missing)} of {len(names)} scenes are not there"
            raise UserError(f"{what} ({ids_in_words(missing, 3)})", root, f"check {listed}")
        return _by_name([root / name for name in names])
    for path in paths:
        if not path.exists():
            raise UserError("the capture does not exist", path, "check the path")
    return _by_name([scene for path in paths for scene in scenes_in(path)])


def scenes_in(path: Path) -> list[Path]:
    """The captures in a folder, in the order of their names; the path itself where it is one."""
    reader = next((reader for reader in READERS if reader.recognises(path)), None)
    if reader is scannet and not scannet.is_scene(path):
        found = list(find_scenes(path).values())
        return found if len(found) > 1 else [path]
    if reader is not None or not path.is_dir():
        return [path]
    inside = sorted(path.iterdir(), key=lambda child: natural_key(child.name))
    folders = [child for child in inside if child.is_dir() and not child.name.startswith(".")]
    found = [child for child in folders if any(one.recognises(child) for one in READERS)]
    return found or [path]


def scenes_of_split(root: Path, split: str) -> dict[str, Path]:
    """The scenes of a split of ScanNet.

    Args:
        root: the folder that holds scans_test/ and scans/, or scenes.
        split: train, test, all, or a file with the name of a scene on each line.

    Raises:
        UserError: as `deltas_nets.datasets.scene_names.choose_scenes`.
    """
    chosen = choose_scenes(root, split, option="--split")
    if chosen.missing:
        warn(
            f"{len(chosen.missing)} scenes of the split are not there: "
            f"{ids_in_words(chosen.missing, 3)}"
        )
    return dict(chosen.folders)


def _lines(file: Path) -> list[str]:
    remedy = "name a text file with a scene on each line"
    lines = read_lines(file, name="list of scenes", remedy=remedy)
    names = list(dict.fromkeys(" ".join(words) for _, words in lines))
    if not names:
        raise UserError("the list names no scene", file, remedy)
    return names


def _by_name(scenes: Sequence[Path]) -> dict[str, Path]:
    """Paths by the shortest ends of them that differ, so that names fit into tables."""
    places = [scene.resolve() for scene in scenes]
    if len(set(places)) < len(places):
        twice = next(scene for scene in places if places.count(scene) > 1)
        raise UserError("a scene is named twice", twice, "name it once")
    # Links keep their names, which are those of the command line.
    whole = [Path(os.path.abspath(scene)) for scene in scenes]
    longest = max((len(scene.parts) for scene in whole), default=1)
    for parts in range(1, longest + 1):
        names = ["/".join(scene.parts[-parts:]) for scene in whole]
        if len(set(names)) == len(names):
            return dict(zip(names, scenes, strict=True))
    raise AssertionError("different paths have different ends")
