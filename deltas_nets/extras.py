"""Packages and devices that not everybody has: whether they are there, asked before all work."""

from importlib.util import find_spec
from pathlib import Path
from textwrap import shorten
from typing import TYPE_CHECKING

from deltas_nets.errors import UserError

if TYPE_CHECKING:
    import torch

__all__ = ["check_extra", "usable_device"]


def check_extra(
    extra: str, *packages: str, wanted_by: str, where: str | Path, otherwise: str = ""
) -> None:
    """Are the packages of an extra installed?

    Args:
        extra: its name, as pip takes it.
        packages: that are needed, as they are imported.
        wanted_by: what needs them, as a subject in the plural or singular with its verb.
        where: the command, option or file it is about.
        otherwise: what can be done without them.

    Raises:
        UserError: one is missing.

    Example:
        >>> check_extra("mesh", "no_such_package", wanted_by="GLB needs", where="--glb")
        Traceback (most recent call last):
        deltas_nets.errors.UserError: GLB needs the package no_such_package, --glb: pip install \
"deltas-depth[mesh]"
    """
    for package in packages:
        if find_spec(package) is None:
            remedy = f'pip install "deltas-depth[{extra}]"'
            remedy += f", or {otherwise}" if otherwise else ""
            raise UserError(f"{wanted_by} the package {package}", where, remedy)


def usable_device(device: "str | torch.device") -> str:
    """The name of a device, as of ``--device``; "auto" is a CUDA device where there is one.

    Raises:
        UserError: nothing can be computed there.
    """
    import torch

    if device == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    try:
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:
        # Torch lists all devices that it has heard of.
        reason = shorten(str(error).splitlines()[0], 80, placeholder=" ...")
        raise UserError(
            f"cannot compute there ({reason})", f"--device {device}", "use cpu"
        ) from None
    return str(device)
