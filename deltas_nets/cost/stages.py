"""Which stage of a network is at work: its direct children, and what lies between them."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import torch
from torch import nn

GEOMETRY = "geometry"
"""What a network computes outside its children: triangulation, sparse depth, final resizing."""


@contextmanager
def followed_stages(model: nn.Module, enter: Callable[[str], None]) -> Iterator[None]:
    """Call ``enter`` whenever another stage of the model gets to work, inside the block.

    A stage is at work while its module or any module in it is called, so that networks count
    whose children are used piece by piece.

    Args:
        model: every direct child is a stage named after it.
        enter: gets the stage's name; first, and between the children, `GEOMETRY`.
    """
    active = [GEOMETRY]

    def begin(name: str) -> Callable[..., None]:
        def hook(*_: Any) -> None:
            if name != active[-1]:
                enter(name)
            active.append(name)

        return hook

    def end(*_: Any) -> None:
        left = active.pop()
        if left != active[-1]:
            enter(active[-1])

    handles = []
    for module, name in _stage_of_module(model).items():
        handles.append(module.register_forward_pre_hook(begin(name)))
        handles.append(module.register_forward_hook(end, always_call=True))
    try:
        enter(GEOMETRY)
        yield
    finally:
        for handle in handles:
            handle.remove()


class Lap(NamedTuple):
    """A stretch of time in which one stage was at work.

    Attributes:
        stage: its name, or `GEOMETRY`.
        seconds: how long.
    """

    stage: str
    seconds: float


@contextmanager
def timed_stages(model: nn.Module) -> Iterator[list[Lap]]:
    """Measure what the model does inside the block.

    Args:
        model: as for :func:`followed_stages`.

    Yields:
        The laps, whose last one ends with the block; the first and the last are of `GEOMETRY`.
    """
    laps: list[Lap] = []
    device = next(model.parameters()).device
    active, since = GEOMETRY, time.perf_counter()

    def enter(stage: str) -> None:
        nonlocal active, since
        if device.type != "cpu":
            # Kernels run on after the call that started them returns.
            torch.accelerator.synchronize(device)
        now = time.perf_counter()
        if stage != active:
            laps.append(Lap(active, now - since))
            active, since = stage, now

    with followed_stages(model, enter):
        yield laps
        enter("")


def stage_names(model: nn.Module) -> list[str]:
    """The children in their order, then `GEOMETRY`."""
    return [name for name, _ in model.named_children()] + [GEOMETRY]


def parameters_by_stage(model: nn.Module) -> dict[str, int]:
    """Numbers of parameters; one that several stages share belongs to the first."""
    seen: set[int] = set()
    counts = {}
    for name, module in (*model.named_children(), (GEOMETRY, model)):
        own = {id(weight): weight for weight in module.parameters() if id(weight) not in seen}
        seen |= own.keys()
        counts[name] = sum(weight.numel() for weight in own.values())
    return counts


def _stage_of_module(model: nn.Module) -> dict[nn.Module, str]:
    stages = {child: name for name, child in model.named_children()}
    for name, child in model.named_children():
        for module in child.modules():
            stages.setdefault(module, name)
    return stages
