"""To which of a capture's names a file belongs, where several could mean it."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

__all__ = ["AS_NAMED", "Claim", "Owners"]

AS_NAMED = 10**6
"""Parts in which a file agrees that is where its name says."""


class Claim(NamedTuple):
    """A file that a name may mean.

    Attributes:
        path: the file.
        agreeing: the last parts of the name that are its own; 0 where the suffix is another.
        guessed: whether another file was as good, or the suffix is another.
    """

    path: Path
    agreeing: int
    guessed: bool = False


class Owners:
    """The names that claim each file.

    A folder of photos that was renamed looks like one that is missing beside another camera's:
    that other names claim the files tells them apart.
    """

    def __init__(self) -> None:
        self._best: dict[Path, tuple[int, set[tuple[str, ...]]]] = {}
        self._folders: set[Path] = set()

    def add(self, claim: Claim, wanted: tuple[str, ...]) -> None:
        """Note what the parts of a name claim."""
        best, names = self._best.get(claim.path, (-1, set()))
        if claim.agreeing > best:
            best, names = claim.agreeing, set()
        if claim.agreeing == best:
            names.add(wanted)
        self._best[claim.path] = best, names
        if claim.agreeing > 1:
            self._folders.add(claim.path.parent)

    def allow(self, claim: Claim, wanted: Sequence[str]) -> bool:
        """Whether a file may be taken for a name that it is not called by.

        It may not where another name claims it as well or better, nor where the name's folder is
        another and other names lead to the file's.
        """
        if claim.agreeing == 1 < len(wanted) and claim.path.parent in self._folders:
            return False
        best, names = self._best.get(claim.path, (-1, set()))
        return claim.agreeing > best or names == {tuple(wanted)}
