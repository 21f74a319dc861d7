"""The folder that a fusion writes to: what is there already, and whose it is."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from deltas_nets.errors import UserError
from deltas_nets.outputs.beside import FUSE_SUMMARY, fused_files, read_fuse_summary
from deltas_nets.outputs.summary import difference

__all__ = ["check_folder", "own_files"]

REMEDY = "name another folder, or add --overwrite"


def check_folder(
    out: Path, files: Iterable[Path], settings: Mapping[str, Any], *, overwrite: bool
) -> dict[str, Any] | None:
    """What an earlier run of the same settings left; None where there was none.

    Args:
        out: the folder.
        files: that will be written.
        settings: of this run.
        overwrite: whether what others made may be replaced.

    Raises:
        UserError: others made something, and it may not.
    """
    earlier = read_fuse_summary(out)
    if earlier is not None and earlier["settings"] != settings:
        if overwrite:
            return None
        what = f"an earlier run had other settings ({difference(earlier, settings)})"
        raise UserError(what, out / FUSE_SUMMARY, REMEDY)
    for file in files:
        if file.exists() and not (earlier is not None and _is_own(file, earlier)):
            if overwrite:
                return None
            raise UserError("the file exists", file, REMEDY)
    return earlier


def own_files(out: Path, files: Iterable[Path], settings: Mapping[str, Any]) -> list[str]:
    """Names of what runs of these settings make, now and before; what other ones made goes.

    Args:
        out: the folder.
        files: that will be written.
        settings: of this run.
    """
    made = {file.name for file in files}
    earlier = read_fuse_summary(out)
    if earlier is None:
        return sorted(made)
    before = {name for name in fused_files(earlier) if (out / name).exists()}
    if earlier["settings"] == settings:
        return sorted(made | before)
    for name in before - made:
        (out / name).unlink()
    return sorted(made)


def _is_own(file: Path, earlier: Mapping[str, Any]) -> bool:
    # The summary of an older version does not name its files.
    return "files" not in earlier or file.name in fused_files(earlier)
