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
    """Measure the model's calls inside the block.

    Yields:
        Seconds by stage, filled while the block runs; what lies between the modules is the
        triangulation. "total" is the whole forward.
    """
    seconds: dict[str, float] = {}
    began: dict[str, float] = {}
    device = next(model.parameters()).device

    def now() -> float:
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        return time.perf_counter()

    def start(name: str) -> Any:
        return lambda *_: began.update({name: now()})

    def stop(name: str) -> Any:
        return lambda *_: seconds.update({name: seconds.get(name, 0.0) + now() - began[name]})

    stages = {name: getattr(model, name) for name in MODULES} | {"total": model}
    handles = []
    for name, module in stages.items():
        handles.append(module.register_forward_pre_hook(start(name)))
        handles.append(module.register_forward_hook(stop(name)))
    try:
        yield seconds
    finally:
        for handle in handles:
            handle.remove()
        if "total" in seconds:
            inside = sum(seconds[name] for name in MODULES)
            total = seconds.pop("total")
            seconds.update({GEOMETRY: total - inside, "total": total})
