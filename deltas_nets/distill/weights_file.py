"""A teacher's weights from the file that its authors published."""

from collections.abc import Collection, Mapping
from pathlib import Path

from torch import Tensor, nn

from deltas_nets.errors import UserError


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
