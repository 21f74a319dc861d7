"""AdamW, and the learning rate of every step."""

import math

import torch

from deltas_nets.config import TrainConfig
from deltas_nets.network.deltas import Deltas


def make_optimizer(model: Deltas, config: TrainConfig) -> torch.optim.Optimizer:
    """AdamW; the pretrained encoder learns at a share of the rate."""
    pretrained = model.encoder.pretrained_parameters()
    known = {id(parameter) for parameter in pretrained}
    fresh = [parameter for parameter in model.parameters() if id(parameter) not in known]
    rate = config.learning_rate
    return torch.optim.AdamW(
        [
            {"params": pretrained, "peak": rate * config.encoder_rate},
            {"params": fresh, "peak": rate},
        ],
        lr=rate,
        weight_decay=config.weight_decay,
    )


def set_learning_rate(optimizer: torch.optim.Optimizer, step: int, config: TrainConfig) -> float:
    """Give every group its rate of a step, counted from 0.

    Returns:
        The rate of the group that learns fastest.
    """
    factor = learning_rate_factor(step, config)
    for group in optimizer.param_groups:
        group["lr"] = group["peak"] * factor
    return float(max(group["lr"] for group in optimizer.param_groups))


def learning_rate_factor(step: int, config: TrainConfig) -> float:
    """Linear warm-up, then what the config's schedule says."""
    warm = min(1.0, (step + 1) / max(1, min(config.warmup, config.steps // 10)))
    if config.schedule == "constant":
        return warm
    return warm * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * step / config.steps)))
