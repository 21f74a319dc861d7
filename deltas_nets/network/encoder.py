"""What every image encoder states of itself, and how it starts from public weights."""

from pathlib import Path
from typing import NamedTuple

from torch import nn

from deltas_nets.errors import UserError
from deltas_nets.network.torch_file import read_state


class Origin(NamedTuple):
    """Public weights that an encoder can start from.

    Attributes:
        network: its name.
        licence: of the weights.
        file: what to name for them.
    """

    network: str
    licence: str
    file: str

    def __str__(self) -> str:
        return f"{self.network} ({self.licence})"


class ImageEncoder(nn.Module):
    """RGB images ``(B, V, 3, H, W)`` in [0, 1], any size, to feature maps.

    Attributes:
        origin: the public weights that it can start from.
    """

    origin: Origin

    def public_names(self) -> dict[str, str]:
        """Names in the public checkpoint of the weights that start from it, to our names."""
        raise NotImplementedError

    def pretrained_parameters(self) -> list[nn.Parameter]:
        """The parameters that start from public weights, if any do."""
        names = set(self.public_names().values())
        return [parameter for name, parameter in self.named_parameters() if name in names]

    def load_pretrained(self, file: Path) -> None:
        """Start from a public checkpoint; its classifier is left out.

        Raises:
            UserError: the file is missing or holds something else.
        """
        state = read_state(file, remedy=f"name {self.origin.file}")
        own, names = self.state_dict(), self.public_names()
        missing = sorted(
            public
            for public, name in names.items()
            if public not in state or state[public].shape != own[name].shape
        )
        if missing:
            what = f"not a checkpoint of {self.origin.network} (no {missing[0]})"
            raise UserError(what, file, f"name {self.origin.file}")
        self.load_state_dict({name: state[public] for public, name in names.items()}, strict=False)
