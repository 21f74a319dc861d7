"""Files that a capture names, found by name though they may have moved."""

import os
import stat
from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path

from deltas_nets.captures.readers.names import IMAGE_SUFFIXES, name_parts
from deltas_nets.errors import UserError

__all__ = ["NOT_COLOUR", "FileFinder"]

NOT_COLOUR = ("depth", "mask", "normal", "confidence", "semantic", "segment", ".")
"""How names of folders begin in which no colour image is looked for."""
FILES_LIMIT = 10**6
"""Files that a folder may hold where names are searched in it."""
_EMPTY: frozenset[str] = frozenset()


class FileFinder:
    """Finds the files that a capture names, though they may have moved since.

    A name is looked up as it stands from each root. If nothing is there, the file is searched
    under the roots by the last parts of its name, whatever the case of the letters, with a suffix
    added where it has none. The file that agrees in most parts is taken, then the one under an
    earlier root; where two are as good none is.

    Found files are in the folder of the capture or, if the name says so by "..", in the one around
    it, and never elsewhere: absolute paths are searched by their last parts, too. Links to files
    are followed, and so are links that are roots; other links to folders are not, so that no
    cycle and no whole disk is walked.

    Args:
        folder: of the capture.
        roots: folders to look in, best first; those that do not exist are skipped.
        suffixes: of the files.
        avoid: how names of folders begin, in lower case, that are not searched.

    Raises:
        UserError: there are more than a million files to search among.
    """

    def __init__(
        self,
        folder: Path,
        roots: Sequence[Path] = (),
        *,
        suffixes: Sequence[str] = IMAGE_SUFFIXES,
        avoid: Sequence[str] = NOT_COLOUR,
    ) -> None:
        self.folder = folder
        self.roots = [root for root in (*roots, folder) if root.is_dir()]
        self.suffixes = tuple(suffixes)
        self.avoid = tuple(avoid)
        self._folders: dict[str, frozenset[str]] = {}

    def find(self, name: str) -> Path | None:
        """The file for a name; None where there is none, or no telling which."""
        parts = name_parts(name)
        if not parts:
            return None
        return self._as_named(name) or self._by_last_parts(parts)

    def _as_named(self, name: str) -> Path | None:
        relative = name.replace("\\", "/")
        if relative.startswith("/") or relative[1:2] == ":":
            return None
        up = ".." in relative.split("/")
        suffixes = ("",) if relative.lower().endswith(self.suffixes) else self.suffixes
        # Strings, not paths, which take ten times as long where a million names are asked for.
        above, _, last = relative.rpartition("/")
        for root in self._names_of_roots[-1:] if up else self._names_of_roots:
            listed = self._listed(f"{root}/{above}")
            for suffix in suffixes:
                if last + suffix not in listed:
                    continue
                file = os.path.join(root, relative + suffix)
                if _is_file(file) and (not up or self._is_around(file)):
                    return Path(file)
        return None

    def _listed(self, folder: str) -> frozenset[str]:
        """What a folder holds; each is listed once, and none is where there is no folder."""
        if folder not in self._folders:
            try:
                self._folders[folder] = frozenset(os.listdir(folder))
            except (OSError, ValueError):  # not there, a name too long, or with a NUL
                self._folders[folder] = _EMPTY
        return self._folders[folder]

    @cached_property
    def _names_of_roots(self) -> list[str]:
        """The last is the capture's folder."""
        return [os.fspath(root) for root in self.roots]

    def _is_around(self, file: str) -> bool:
        """Whether a file is in the folder around the capture's."""
        around = os.path.dirname(os.path.abspath(self.folder))
        return os.path.abspath(file).startswith(os.path.join(around, ""))

    def _by_last_parts(self, parts: Sequence[str]) -> Path | None:
        lower = [part.lower() for part in parts]
        names = [lower[-1]]
        if not lower[-1].endswith(self.suffixes):
            names = [lower[-1] + known for known in self.suffixes]
        for name in names:
            wanted = (*lower[:-1], name)
            ranked = [
                (_agreeing(found, wanted), -rank, path) for rank, found, path in self._known(name)
            ]
            if ranked:
                best = max(key for *key, _ in ranked)
                winners = [path for *key, path in ranked if key == best]
                return winners[0] if len(winners) == 1 else None
        return None

    def _known(self, name: str) -> Sequence[tuple[int, tuple[str, ...], Path]]:
        return self._index.get(name, ())

    @cached_property
    def _index(self) -> dict[str, list[tuple[int, tuple[str, ...], Path]]]:
        """By lower name: the root's rank, the lower parts from there, the file."""
        index: dict[str, list[tuple[int, tuple[str, ...], Path]]] = {}
        seen: set[str] = set()
        for rank, root in enumerate(self.roots):
            for folder, file in _walk(root, self.avoid, seen):
                if file.lower().endswith(self.suffixes):
                    path = Path(folder, file)
                    parts = tuple(part.lower() for part in path.relative_to(root.parent).parts)
                    index.setdefault(file.lower(), []).append((rank, parts, path))
        return index


def _walk(root: Path, avoid: tuple[str, ...], seen: set[str]) -> Iterator[tuple[str, str]]:
    """Folder and name of each file below a root, those of folders that were seen left out."""
    count = 0
    for folder, folders, files in os.walk(root):
        real = os.path.realpath(folder)
        if real in seen:
            folders.clear()
            continue
        seen.add(real)
        folders[:] = sorted(name for name in folders if not name.lower().startswith(avoid))
        count += len(files)
        if count > FILES_LIMIT:
            what = f"the folder holds more than {FILES_LIMIT} files to search for images"
            raise UserError(what, root, "name the folder of one capture")
        for file in sorted(files):
            yield folder, file


def _agreeing(found: Sequence[str], wanted: Sequence[str]) -> int:
    """How many of the last parts are the same."""
    pairs = zip(reversed(found), reversed(wanted), strict=False)
    return next(
        (place for place, (a, b) in enumerate(pairs) if a != b), min(map(len, (found, wanted)))
    )


def _is_file(path: str) -> bool:
    try:
        return stat.S_ISREG(os.stat(path).st_mode)
    except (OSError, ValueError):  # not there, a name too long, or with a NUL
        return False
