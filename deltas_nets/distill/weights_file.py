"""A teacher's weights from the file that its authors published."""

from collections.abc import Collection, Mapping
from pathlib import Path

import torch
from safetensors.torch import load_file
from torch import Tensor, nn

from deltas_nets.errors import UserError

NESTS = ("extractor", "state_dict", "model_state_dict", "model")
"""Keys under which some authors keep the weights in their files."""


def read_state(file: Path) -> dict[str, Tensor]:
    """The named tensors of a ``.safetensors`` or PyTorch file; no code in the file is run.

    Raises:
        UserError: the file is missing, or holds anything but tensors by name.
    """
    remedy = "name a file of weights (.safetensors, .pt or .pth)"
    try:
        if file.suffix == ".safetensors":
            return load_file(file)
        content = torch.load(file, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise UserError("no such weights", file, remedy) from None
    except (OSError, EOFError, RuntimeError, ValueError, KeyError) as error:
        raise UserError(f"the weights cannot be read ({error})", file, remedy) from None
    except Exception as error:  # a damaged pickle may raise anything
        reason = str(error).partition("\n")[0]
        raise UserError(f"not a file of weights alone ({reason})", file, remedy) from None
    for name in NESTS:
        if isinstance(content, dict) and isinstance(content.get(name), dict):
            content = content[name]
    if not isinstance(content, dict):
        raise UserError("the file holds no weights by name", file, remedy)
    return {name: value for name, value in content.items() if isinstance(value, Tensor)}


def fill(
    network: nn.Module,
    state: Mapping[str, Tensor],
    file: Path,
    *,
    what: str,
    computed: Collection[str] = (),
) -> None:
    """Copy weights into a network of the same shape; what the network lacks is left out.

    Args:
        network: gets the weights.
        state: named tensors.
        file: where they come from, for the error.
        what: name of the network, for the error.
        computed: constants that the network makes itself; files need not hold them.

    Raises:
        UserError: a weight is missing or has another shape; names the first one.
    """
    remedy = f"name a file with {what}'s published weights"
    for name, own in network.state_dict().items():
        if name not in state:
            # Older files have no counters; evaluation does not use them.
            if name in computed or name.endswith("num_batches_tracked"):
                continue
            raise UserError(f"not weights of {what} (no {name})", file, remedy)
        if state[name].shape != own.shape:
            shapes = f"{tuple(state[name].shape)}, not {tuple(own.shape)}"
            raise UserError(f"not weights of {what} ({name} is {shapes})", file, remedy)
    network.load_state_dict(dict(state), strict=False)
