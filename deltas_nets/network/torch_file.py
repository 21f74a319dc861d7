"""Files of torch that others wrote, or a killed machine cut: none of them ends in a traceback."""

import re
from collections.abc import Mapping
from pathlib import Path
from textwrap import shorten
from typing import Any

import torch
from safetensors.torch import load_file
from torch import Tensor

from deltas_nets.errors import UserError

__all__ = ["all_finite", "check_finite_weights", "read_state", "read_torch_file"]

NESTS = ("extractor", "state_dict", "model_state_dict", "model")
"""Keys under which some authors keep the weights in their files."""


def read_torch_file(file: Path, *, remedy: str) -> Any:
    """The content of a ``.safetensors`` or PyTorch file; no code in the file is run.

    Args:
        file: to read.
        remedy: what the user can do if it is no such file.

    Raises:
        UserError: the file is missing, damaged or of another kind.
    """
    try:
        if file.suffix == ".safetensors":
            return load_file(file)
        return torch.load(file, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise UserError("no such weights", file, remedy) from None
    except (OSError, EOFError, RuntimeError, ValueError, KeyError) as error:
        raise UserError(f"the weights cannot be read ({_short(error)})", file, remedy) from None
    except Exception as error:  # a damaged pickle may raise anything
        raise UserError(f"not a file of weights alone ({_short(error)})", file, remedy) from None


def read_state(
    file: Path, *, remedy: str = "name a file of weights (.safetensors, .pt or .pth)"
) -> dict[str, Tensor]:
    """The named tensors of a file.

    Raises:
        UserError: the file is missing, holds anything but tensors by name, or numbers that are not
            finite.
    """
    content = read_torch_file(file, remedy=remedy)
    for name in NESTS:
        if isinstance(content, dict) and isinstance(content.get(name), dict):
            content = content[name]
    if not isinstance(content, dict):
        raise UserError("the file holds no weights by name", file, remedy)
    state = {name: value for name, value in content.items() if isinstance(value, Tensor)}
    check_finite_weights(state, file)
    return state


def check_finite_weights(state: Mapping[str, Tensor], file: Path) -> None:
    """Whether a network could compute with weights, of any shape: one NaN makes all depth NaN.

    Raises:
        UserError: some are NaN or infinite; the text names the first.
    """
    spoilt = [name for name, value in state.items() if not all_finite(value)]
    if spoilt:
        first = f"{spoilt[0]} and {len(spoilt) - 1} more" if len(spoilt) > 1 else spoilt[0]
        remedy = "their training diverged, or the file is damaged: name others"
        raise UserError(f"the weights are not finite ({first})", file, remedy)


def all_finite(value: Tensor) -> bool:
    """Whether no number is NaN or infinite.

    Example:
        >>> all_finite(torch.tensor([1.0, -torch.inf])), all_finite(torch.ones(0))
        (False, True)
    """
    if value.is_complex() or not value.numel():
        return bool(value.isfinite().all())
    if value.is_floating_point() and value.itemsize == 1:  # these know no comparison
        value = value.float()
    # NaN is the least of what it is among; to ask each number takes twenty times as long.
    return all(bool(end.isfinite()) for end in value.aminmax())


def _short(error: Exception) -> str:
    """The beginning of what torch says, which goes on for a page of advice."""
    # What it advises on weights_only is how to run what is in the file after all.
    said = str(error).partition("\n")[0].partition(" In PyTorch 2.6")[0]
    said = re.sub(r"`*weights_only(=True)?`*", "a reader that runs no code", said)
    return shorten(said, 150, placeholder=" ...")
