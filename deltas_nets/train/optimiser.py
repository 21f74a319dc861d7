"""AdamW, and the learning rate of every step."""

import torch

from deltas_nets.config import TrainConfig
from deltas_nets.config.schedule import rate_factor
from deltas_nets.network.networks import Network


def make_optimizer(model: Network, config: TrainConfig) -> torch.optim.Optimizer:
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
    factor = rate_factor(step, config.steps, warmup=config.warmup, schedule=config.schedule)
    for group in optimizer.param_groups:
        group["lr"] = group["peak"] * factor
    return float(max(group["lr"] for group in optimizer.param_groups))
