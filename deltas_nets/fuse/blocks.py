"""Voxels where there is something, eight cubed at a time: memory grows with surfaces, not rooms."""

import torch
from torch import Tensor

__all__ = ["SIDE", "VOXELS", "Blocks"]

SIDE = 8
"""Voxels along the side of a block."""
VOXELS = SIDE**3
SLAB = 2048
"""Blocks whose memory is taken at once. Slabs are never copied to make room for more."""


class Blocks:
    """Sums in the voxels of some blocks, found by the blocks' names.

    Args:
        channels: sums of each voxel.
        device: where they are.
    """

    def __init__(self, channels: int, device: str | torch.device = "cpu") -> None:
        self.channels, self.device = channels, torch.device(device)
        self.names = torch.zeros(0, dtype=torch.int64, device=self.device)
        """``(B,)`` ascending, see `deltas_nets.fuse.lattice`."""
        self.slots = torch.zeros(0, dtype=torch.int64, device=self.device)
        """``(B,)`` where each block's sums are: the slot-th block of all slabs."""
        self._slabs: list[Tensor] = []

    def __len__(self) -> int:
        return len(self.names)

    def find(self, names: Tensor) -> Tensor:
        """Slots ``(M,)`` of blocks; -1 of those that are not there."""
        if len(self) == 0:
            return torch.full_like(names, -1)
        place = torch.searchsorted(self.names, names).clamp_max(len(self) - 1)
        return torch.where(self.names[place] == names, self.slots[place], -1)

    def claim(self, names: Tensor) -> Tensor:
        """Slots ``(M,)`` of blocks, each named once; those that are new start with zeros."""
        new = names[self.find(names) < 0]
        if len(new):
            slots = torch.arange(len(self), len(self) + len(new), device=self.device)
            self.names, order = torch.cat((self.names, new)).sort()
            self.slots = torch.cat((self.slots, slots))[order]
            while len(self._slabs) * SLAB < len(self):
                shape = (self.channels, SLAB, VOXELS)
                self._slabs.append(torch.zeros(shape, device=self.device))
        return self.find(names)

    def slab(self, number: int) -> Tensor:
        """``(C, SLAB, VOXELS)`` sums of the slots from ``number * SLAB`` on, to be added to."""
        return self._slabs[number]

    def read(self, slots: Tensor, channels: slice = slice(None)) -> Tensor:
        """``(C, M, VOXELS)`` sums of slots."""
        count = len(range(*channels.indices(self.channels)))
        values = torch.zeros(count, len(slots), VOXELS, device=self.device)
        number = slots // SLAB
        for slab in sorted(set(number.tolist())):
            mine = number == slab
            values[:, mine] = self._slabs[slab][channels, slots[mine] % SLAB]
        return values

    def read_voxels(self, slots: Tensor, voxels: Tensor) -> Tensor:
        """``(C, M)`` sums of single voxels ``(M,)`` of slots ``(M,)``."""
        values = torch.zeros(self.channels, len(slots), device=self.device)
        number = slots // SLAB
        for slab in sorted(set(number.tolist())):
            mine = number == slab
            values[:, mine] = self._slabs[slab][:, slots[mine] % SLAB, voxels[mine]]
        return values

    def state(self) -> dict[str, Tensor]:
        """Everything, to be written; sums are not copied."""
        named = {f"slab{number}": slab for number, slab in enumerate(self._slabs)}
        return {"names": self.names, "slots": self.slots, **named}

    def restore(self, state: dict[str, Tensor]) -> None:
        """Take over a state."""
        self.names, self.slots = state["names"].to(self.device), state["slots"].to(self.device)
        count = sum(name.startswith("slab") for name in state)
        self._slabs = [state[f"slab{number}"].to(self.device) for number in range(count)]
