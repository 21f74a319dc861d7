"""Counts the operations of everything that torch computes, stage by stage."""

from collections import Counter
from collections.abc import Callable
from typing import Any, NamedTuple

from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import flop_registry

from deltas_nets.cost.formulas import FORMULAS, Formula, attention_products, attention_softmax


class Flops(NamedTuple):
    """Floating-point operations; two are a multiply-accumulate.

    Attributes:
        products: of convolutions and matrix products alone, as torch's counter has it.
        every: of all operators, by the conventions of `deltas_nets.cost.formulas`.
    """

    products: int
    every: int


class OperationCounter(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Counts while it is active; whoever holds it says which stage is at work.

    Attributes:
        stage: what the next operations are counted for.
        flops: found so far, by stage.
        unknown: calls of operators that have no formula, by name; they count as nothing.

    Example:
        >>> import torch
        >>> with OperationCounter() as counter:
        ...     _ = torch.ones(2, 3) @ torch.ones(3, 5) + 1
        >>> counter.total()
        Flops(products=60, every=70)
    """

    def __init__(self, stage: str = "") -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.stage = stage
        self.flops: dict[str, Flops] = {}
        self.unknown: Counter[str] = Counter()

    def enter(self, stage: str) -> None:
        """What follows is computed in this stage."""
        self.stage = stage

    def total(self) -> Flops:
        """The sum over all stages."""
        found = self.flops.values()
        return Flops(sum(flops.products for flops in found), sum(flops.every for flops in found))

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        kwargs = kwargs or {}
        counts = _counts_of(func)
        if counts is None and func.namespace != "prim":
            # In inference mode operators arrive whole that are made of others.
            with self:
                out = func.decompose(*args, **kwargs)
            if out is not NotImplemented:
                return out
            self.unknown[func._schema.name] += 1
        out = func(*args, **kwargs)
        if counts is not None:
            products, every = counts(args, kwargs, out)
            before = self.flops.get(self.stage, Flops(0, 0))
            self.flops[self.stage] = Flops(before.products + products, before.every + every)
        return out


def _counts_of(func: Any) -> Callable[..., Flops] | None:
    """What makes both counts of an operator's arguments, keyword arguments and result, if known."""
    namespace, name = func._schema.name.split("::")
    if name == "_scaled_dot_product_flash_attention_for_cpu":
        return _fused_attention(lambda args, kwargs, out: attention_products(*args[:3]))
    if func._overloadpacket in flop_registry:
        by_torch = flop_registry[func._overloadpacket]

        def products(args: Any, kwargs: Any, out: Any) -> int:
            return int(by_torch(*args, **kwargs, out_val=out))

        if name.startswith("_scaled_dot_product"):
            return _fused_attention(products)
        return lambda *call: Flops(products(*call), products(*call))
    if func.is_view:
        return lambda *call: Flops(0, 0)
    if namespace == "aten" and (formula := FORMULAS.get(name.removesuffix("_"))) is not None:
        return lambda *call: Flops(0, formula(*call))
    return None


def _fused_attention(products: Formula) -> Callable[..., Flops]:
    def counts(args: Any, kwargs: Any, out: Any) -> Flops:
        flops = products(args, kwargs, out)
        return Flops(flops, flops + attention_softmax(args[0], args[1]))

    return counts
