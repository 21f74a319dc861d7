"""How long each stage of the network takes."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch

from deltas_nets.network.deltas import Deltas

MODULES = ("encoder", "detector", "descriptor", "matcher", "densifier")
GEOMETRY = "triangulation and sparse depth"


@contextmanager
def timed_stages(model: Deltas) -> Iterator[dict[str, float]]:
    """Measure the model's predictions inside the block.

    Yields:
        Seconds by stage, filled while the block runs. "total" runs from the first stage of a
        prediction to the end of the densifier; what lies between the modules is the
        triangulation.
    """
    seconds = dict.fromkeys((*MODULES, GEOMETRY, "total"), 0.0)
    began: dict[str, float] = {}
    device = next(model.parameters()).device

    def now() -> float:
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        return time.perf_counter()

    def start(name: str) -> Any:
        def hook(*_: Any) -> None:
            began[name] = now()
            began.setdefault("total", began[name])

        return hook

    def stop(name: str) -> Any:
        def hook(*_: Any) -> None:
            ended = now()
            seconds[name] += ended - began[name]
            if name == MODULES[-1]:
                seconds["total"] += ended - began.pop("total")
                inside = sum(seconds[name] for name in MODULES)
                seconds[GEOMETRY] = seconds["total"] - inside

        return hook

    handles = []
    for name in MODULES:
        module = getattr(model, name)
        handles.append(module.register_forward_pre_hook(start(name)))
        handles.append(module.register_forward_hook(stop(name)))
    try:
        yield seconds
    finally:
        for handle in handles:
            handle.remove()
