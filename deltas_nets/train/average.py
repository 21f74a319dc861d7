"""A running average of the weights: what is evaluated and shipped."""

import copy
from typing import TypeVar

import torch
from torch import nn

Network = TypeVar("Network", bound=nn.Module)


class RunningAverage:
    """Exponential average of a network's weights and statistics.

    Args:
        model: a copy of it is kept, in evaluation mode.
        decay: weight of the past at every step; early steps forget faster.
    """

    def __init__(self, model: nn.Module, decay: float) -> None:
        self.model = copy.deepcopy(model).eval().requires_grad_(False)
        self.decay = decay

    @torch.no_grad()
    def update(self, model: nn.Module, step: int) -> None:
        """Take in the weights after a step, counted from 0."""
        keep = min(self.decay, (1 + step) / (10 + step))
        current, averages, news = model.state_dict(), [], []
        for name, average in self.model.state_dict().items():
            if average.is_floating_point():
                averages.append(average)
                news.append(current[name].to(average.dtype))
            else:
                average.copy_(current[name])
        torch._foreach_lerp_(averages, news, 1 - keep)  # one launch, not one a tensor
