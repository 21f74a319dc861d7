"""Batch norm is the one layer through which the rooms of a step see each other."""

import torch
from torch import nn
from torch.nn.modules.batchnorm import _BatchNorm

from deltas_nets.config import TrainConfig
from deltas_nets.train.freeze import frozen_stages


def prepare_batch_norm(model: nn.Module, config: TrainConfig, *, processes: int) -> None:
    """Freeze statistics, all or those of frozen stages, or share them between GPUs.

    Parameters and buffers stay the same objects, so an optimizer made before keeps working.

    Args:
        model: in training mode, on its device; changed in place.
        config: of the run.
        processes: of the run. PyTorch shares statistics between GPUs only; on CPUs each process
            normalises by its own rooms, and the running statistics are those of the first.
    """
    as_they_are = [model] if config.freeze_batch_norm else frozen_stages(model, config)
    for module in (module for part in as_they_are for module in part.modules()):
        if isinstance(module, _BatchNorm):
            module.eval()
    if config.freeze_batch_norm:
        return
    if config.sync_batchnorm and processes > 1 and next(model.parameters()).is_cuda:
        nn.SyncBatchNorm.convert_sync_batchnorm(model)  # type: ignore[no-untyped-call]


class Statistics:
    """A network's running statistics at one moment."""

    def __init__(self, model: nn.Module) -> None:
        self._kept = [(buffer, buffer.clone()) for buffer in model.buffers()]

    @torch.no_grad()
    def restore(self) -> None:
        """Put them back."""
        for buffer, before in self._kept:
            buffer.copy_(before)
