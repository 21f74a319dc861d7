"""How much memory a computation holds at once."""

import weakref
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves


class PeakMemory(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """The most bytes held at once by tensors that were made while this is active.

    Weights and inputs, which exist before, are not in it, nor is what an operator needs for
    itself while it runs.

    Attributes:
        peak: bytes.

    Example:
        >>> with PeakMemory() as memory:
        ...     kept = torch.ones(1000)
        ...     for _ in range(3):
        ...         last = kept + 1
        >>> memory.peak  # the next sum is made before the last one is let go
        12000
    """

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.peak = 0
        self._held = 0

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        kwargs = kwargs or {}
        given = _storages((args, kwargs))
        out = func(*args, **kwargs)
        for key, storage in _storages(out).items():
            # A view or an in-place result lies in memory that was there before.
            if key not in given:
                self._hold(storage.nbytes())
                weakref.finalize(storage, self._hold, -storage.nbytes())
        return out

    def _hold(self, size: int) -> None:
        self._held += size
        self.peak = max(self.peak, self._held)


def _storages(values: Any) -> dict[int, torch.UntypedStorage]:
    """The storages of all tensors in nested containers, each once, by its address."""
    tensors = (leaf for leaf in tree_leaves(values) if isinstance(leaf, Tensor))
    return {storage._cdata: storage for storage in (it.untyped_storage() for it in tensors)}
