"""Stages of a network that a run leaves as they are."""

from torch import nn

from deltas_nets.config import TrainConfig


def frozen_stages(model: nn.Module, config: TrainConfig) -> list[nn.Module]:
    """The stages that the config names and the network has."""
    stages = (getattr(model, name, None) for name in config.freeze)
    return [stage for stage in stages if stage is not None]
