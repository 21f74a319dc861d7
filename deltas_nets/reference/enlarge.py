"""How the maps of the reference network's decoder get their new size."""

import torch.nn.functional as F
from torch import Tensor

from deltas_nets.network.paper.up_projection import insert_zeros


def enlarge_by_rows(x: Tensor, size: tuple[int, int]) -> Tensor:
    """Zeros between the pixels, or the nearest pixel where the rows alone are no multiple."""
    if size[0] % x.shape[-2] == 0:
        return insert_zeros(x, size)
    return F.interpolate(x, size=size, mode="nearest")
