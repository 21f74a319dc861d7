"""Whether a folder can be written to, known before anything heavy is imported."""

from pathlib import Path

from deltas_nets.errors import UserError

__all__ = ["check_new"]


def check_new(out: Path) -> None:
    """Whether a folder is there for a capture to be written to.

    Raises:
        UserError: it holds something, or is a file.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        what = "the folder is not empty" if out.is_dir() else "this is a file, not a folder"
        raise UserError(what, out, "name a new folder")
