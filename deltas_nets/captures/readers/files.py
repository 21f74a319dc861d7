"""Files that a capture names, found by name though they may have moved."""

import os
import re
import stat
import unicodedata
from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path

from deltas_nets.captures.readers.names import IMAGE_SUFFIXES, name_parts, where_to_put
from deltas_nets.captures.readers.our_outputs import is_ours
from deltas_nets.captures.readers.owners import AS_NAMED, Claim, Owners
from deltas_nets.errors import UserError

__all__ = ["NOT_COLOUR", "FileFinder"]

NOT_COLOUR = ("depth", "mask", "normal", "confidence", "semantic", "segment", "preview", ".")
"""How names of folders begin in which no colour image is looked for."""
FILES_LIMIT = 10**6
"""Files and folders that a folder may hold where names are searched in it."""
_EMPTY: frozenset[str] = frozenset()


class FileFinder:
    """Finds the files that a capture names, though they may have moved since.

    A name is looked up as it stands from each root. If nothing is there, the file is searched
    under the roots by the last parts of its name, whatever the case of the letters and the form in
    which accents are written (macOS writes them apart), with a suffix added where it has none. The
    file that agrees in most parts is taken, then the one under an earlier root; where two are as
    good none is, but for copies in images_2, images_4, ..., of which the largest is. An image whose
    suffix alone is another is taken from the folder that is named. `doubts` tells of both. A file
    that another name of the capture means is taken for none but that (`Owners`).

    Found files are in the folder of the capture or, if the name says so by "..", in the one around
    it, and never elsewhere: absolute paths are searched by their last parts, too. Links to files
    are followed, and so are links that are roots; other links to folders are not, so that no
    cycle and no whole disk is walked. Folders that commands of ours filled are not searched.

    Args:
        folder: of the capture.
        roots: folders to look in, best first; those that do not exist are skipped.
        names: all that will be asked for, where they are known before.
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
        names: Sequence[str] = (),
        suffixes: Sequence[str] = IMAGE_SUFFIXES,
        avoid: Sequence[str] = NOT_COLOUR,
    ) -> None:
        self.folder = folder
        self.roots = [root for root in (*roots, folder) if root.is_dir()]
        self.names = names
        self.suffixes = tuple(suffixes)
        self.avoid = tuple(avoid)
        self._folders: dict[str, frozenset[str]] = {}
        self._guesses: list[tuple[str, Path]] = []
        self._missing: list[str] = []

    def find(self, name: str, *, apart_from: Path | None = None) -> Path | None:
        """The file for a name; None where there is none, or no telling which.

        Args:
            name: as the capture has it.
            apart_from: a file that is known to be something else, as the image beside the depth.
        """
        parts = name_parts(name)
        if not parts:
            return None
        found = self._as_named(name) or self._searched(name, tuple(map(_folded, parts)))
        if found is None or found == apart_from:
            self._missing.append(name)
            return None
        return found

    def doubts(self) -> list[str]:
        """A warning of the images that were taken for others, if there are any."""
        if not self._guesses:
            return []
        (name, path), count = self._guesses[0], len(self._guesses)
        more = f", and {count - 1} more like it" if count > 1 else ""
        return [f"{path} is taken for {name[:80]}, which is not there{more}"]

    def doubts_of_missing(self, called: str) -> list[str]:
        """A warning of the files that were not found, if there are any, by what they are called."""
        if not self._missing:
            return []
        count = len(self._missing)
        more = f", as are {count - 1} more" if count > 1 else ""
        where = f"the {called} {self._missing[0][:80]} is missing{more}, {self.folder}"
        return [f"{where}: {where_to_put(self._missing[0])}"]

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

    def _searched(self, name: str, wanted: tuple[str, ...]) -> Path | None:
        claim = self._claim(wanted)
        if claim is None or not self._owners.allow(claim, wanted):
            return None
        if claim.guessed:
            self._guesses.append((name, claim.path))
        return claim.path

    @cached_property
    def _owners(self) -> Owners:
        """Looked for where a file is not as it is named: most captures have none."""
        owners = Owners()
        for name in self.names:
            wanted = tuple(map(_folded, name_parts(name)))
            file = self._as_named(name)
            claim = Claim(file, AS_NAMED) if file else self._claim(wanted) if wanted else None
            if claim is not None:
                owners.add(claim, wanted)
        return owners

    def _claim(self, wanted: tuple[str, ...]) -> Claim | None:
        """The file that the parts of a name mean, whoever else does."""
        names = [wanted[-1]]
        if not names[0].endswith(self.suffixes):
            names = [names[0] + known for known in self.suffixes]
        for last in names:
            agreeing, winners = self._nearest((*wanted[:-1], last))
            largest = winners[0] if len(winners) == 1 else _largest_copy(winners)
            if winners and largest is None:
                break
            if largest is not None:
                return Claim(largest, agreeing, guessed=len(winners) > 1)
        return self._by_another_suffix(wanted)

    def _nearest(self, wanted: Sequence[str]) -> tuple[int, list[Path]]:
        """In how many parts files agree with a name at most, and those that do."""
        known = self._known(wanted[-1])
        ranked = [(_agreeing(found, wanted), -rank, path) for rank, found, path in known]
        best = max((key for *key, _ in ranked), default=[0, 0])
        return best[0], [path for *key, path in ranked if key == best]

    def _by_another_suffix(self, wanted: Sequence[str]) -> Claim | None:
        """The one image in the folder that is named whose suffix alone is another."""
        stem, suffix = os.path.splitext(wanted[-1])
        if self.suffixes != IMAGE_SUFFIXES or suffix not in self.suffixes:
            return None
        found = [
            path
            for other in self.suffixes
            for _, parts, path in self._known(stem + other)
            if (parts[-2:-1] == tuple(wanted[-2:-1]) if wanted[:-1] else path.parent in self.roots)
        ]
        return Claim(found[0], 0, guessed=True) if len(found) == 1 else None

    def _known(self, name: str) -> Sequence[tuple[int, tuple[str, ...], Path]]:
        # A link that leads nowhere has a name, too.
        return [entry for entry in self._index.get(name, ()) if _is_file(os.fspath(entry[2]))]

    @cached_property
    def _index(self) -> dict[str, list[tuple[int, tuple[str, ...], Path]]]:
        """By folded name: the root's rank, the folded parts from there, the file."""
        index: dict[str, list[tuple[int, tuple[str, ...], Path]]] = {}
        seen: set[str] = set()
        for rank, root in enumerate(self.roots):
            for folder, file in _walk(root, self.avoid, seen):
                if file.lower().endswith(self.suffixes):
                    path = Path(folder, file)
                    parts = tuple(map(_folded, path.relative_to(root.parent).parts))
                    index.setdefault(parts[-1], []).append((rank, parts, path))
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
        if folder != os.fspath(root) and is_ours(folder, files):
            folders.clear()
            continue
        folders[:] = sorted(name for name in folders if not name.lower().startswith(avoid))
        count += len(files) + len(folders)
        if count > FILES_LIMIT:
            what = (
                f"the folder holds more than {FILES_LIMIT} files and folders to search for images"
            )
            raise UserError(what, root, "name the folder of one capture")
        for file in sorted(files):
            yield folder, file


def _folded(name: str) -> str:
    """A name without case, its accents in one form: macOS writes a letter and its accent apart."""
    return (name if name.isascii() else unicodedata.normalize("NFC", name)).lower()


def _largest_copy(files: Sequence[Path]) -> Path | None:
    """Of one image in images_2, images_4, ... the least reduced; None where they are others."""
    names = [re.fullmatch(r"images_(\d{1,4})", file.parent.name) for file in files]
    factors = [int(name[1]) for name in names if name is not None]
    beside = len({file.parent.parent for file in files}) == 1
    if not beside or len(set(factors)) < len(files):
        return None
    return files[factors.index(min(factors))]


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
