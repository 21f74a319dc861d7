"""The one exception that is the user's to fix: a line of cause and remedy, no traceback."""

from pathlib import Path

__all__ = ["UserError"]


class UserError(Exception):
    """Something outside the program is wrong: a file, a folder or an option.

    The command line prints ``deltas: `` and the text, and exits with 2.

    Args:
        what: what is wrong, with the numbers that show it.
        where: the file, folder or option it is about.
        remedy: what the user can do.

    Example:
        >>> print(UserError("pose has 12 numbers, not 16", "pose/7.txt", "write a 4x4 matrix"))
        pose has 12 numbers, not 16, pose/7.txt: write a 4x4 matrix
    """

    def __init__(self, what: str, where: str | Path, remedy: str) -> None:
        # All three go to Exception.args, so that the error survives pickling between processes.
        super().__init__(what, where, remedy)
        self.what = what
        self.where = where
        self.remedy = remedy

    def __str__(self) -> str:
        # Texts of other libraries end up in `what` and may hold line breaks; ours is one line.
        return " ".join(f"{self.what}, {self.where}: {self.remedy}".split())
