"""One optimiser step: by one process or many, in one pass or several, the same."""

import copy
import math
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor, nn

from deltas_geom import PosedViews
from deltas_nets.config import LOSS_FUNCTIONS, TrainConfig
from deltas_nets.distill.supervision import TeacherLabels
from deltas_nets.losses.divisors import (
    WHOLE,
    Divisors,
    DivisorsOverProcesses,
    DivisorsToCome,
    KnownDivisors,
)
from deltas_nets.losses.losses import Losses, training_losses
from deltas_nets.network.networks import Network
from deltas_nets.train.batch_norm import Statistics
from deltas_nets.train.batches import Batch

if TYPE_CHECKING:
    from lightning_fabric import Fabric

DEPTH_RANGE = (0.5, 10.0)


class Objective(nn.Module):
    """A network and its losses as one module, so that nothing but losses leaves DDP.

    Args:
        model: its forward is that of :class:`deltas_nets.network.deltas.Deltas`.
        config: of the run.
    """

    def __init__(self, model: Network, config: TrainConfig) -> None:
        super().__init__()
        self.model = model
        self.config = config

    def forward(self, batch: Batch, divisors: Divisors = WHOLE) -> Losses:
        """The losses of a batch or of a part of one."""
        # Not Fabric's mixed precision: it would round the cameras to half precision as well.
        mixed = self.config.precision == "bf16-mixed"
        with torch.autocast(batch.images.device.type, dtype=torch.bfloat16, enabled=mixed):
            prediction = self.model(
                batch.images,
                batch.views,
                DEPTH_RANGE,
                num_keypoints=self.config.num_keypoints,
                shift=batch.shift,
            )
        return training_losses(
            prediction,
            batch.images,
            batch.true_views,
            batch.depth,
            self.config.loss,
            depth_range=DEPTH_RANGE,
            labels=batch.labels,
            divisors=divisors,
        )


class StepResult(NamedTuple):
    """What all processes know about a step.

    Attributes:
        losses: of the whole batch.
        done: the weights have changed; False where a gradient or a loss was not finite.
        stop: some process was asked to stop.
    """

    losses: dict[str, float]
    done: bool
    stop: bool

    @property
    def not_finite(self) -> list[str]:
        """What was not: terms of the loss, or the gradient where all of them were."""
        terms = [name for name, value in self.losses.items() if not math.isfinite(value)]
        return [name for name in terms if name != "total" or len(terms) == 1] or ["the gradient"]


class Stepper:
    """Takes optimiser steps.

    Args:
        objective: as it is, for passes that only count.
        wrapped: the same, set up by Fabric.
        optimizer: set up by Fabric.
        fabric: launched.
        teacher: says what the detector is to find, on the same device.
    """

    def __init__(
        self,
        objective: Objective,
        wrapped: nn.Module,
        optimizer: torch.optim.Optimizer,
        fabric: "Fabric",
        teacher: TeacherLabels | None = None,
    ) -> None:
        self.objective = objective
        self.wrapped = wrapped
        self.optimizer = optimizer
        self.fabric = fabric
        self.teacher = teacher
        self.config = objective.config

    def __call__(self, batch: Batch, *, stop: bool = False) -> StepResult:
        """Learn from this process's part of a step's rooms.

        All processes call it, and decide together: the weights stay the same everywhere.

        Args:
            batch: on the device.
            stop: this process was asked to stop.
        """
        fabric = self.fabric
        passes = [self._taught(part) for part in batch.split(self.config.accumulate)]
        divisors_of_a_pass, statistics = self._divisors(passes), Statistics(self.objective)
        self.optimizer.zero_grad()
        names = (*LOSS_FUNCTIONS, "total")
        totals = torch.zeros(len(names), device=batch.images.device)
        for number, part in enumerate(passes):
            more = number < len(passes) - 1
            with fabric.no_backward_sync(self.wrapped, enabled=more):
                losses: Losses = self.wrapped(part, divisors_of_a_pass())
                fabric.backward(losses.total / len(passes))
            values = torch.stack([*losses.terms.values(), losses.total]).detach()
            totals += values / len(passes)
        norm = fabric.clip_gradients(
            self.wrapped,
            self.optimizer,
            max_norm=self.config.clip_gradient,
            error_if_nonfinite=False,
        )
        unusable = ~(norm.isfinite() & totals[-1].isfinite())
        flags = torch.stack([unusable, torch.full_like(unusable, stop)]).to(totals.dtype)
        values = torch.cat([totals, flags])
        if fabric.world_size > 1:
            values = fabric.all_reduce(values, reduce_op="mean")
        *means, skip, stopping = values.tolist()
        if skip:
            statistics.restore()  # they have seen what was not finite
        else:
            self.optimizer.step()
        return StepResult(dict(zip(names, means, strict=True)), done=not skip, stop=stopping > 0)

    def _taught(self, batch: Batch) -> Batch:
        if self.teacher is None:
            return batch
        return batch._replace(labels=self.teacher(batch.anchors))

    def _divisors(self, passes: list[Batch]) -> Callable[[], Divisors]:
        if len(passes) > 1:
            # What counts depends on the predictions, and a gradient that was added up cannot be
            # divided term by term afterwards: a pass without gradient counts first.
            parts = len(passes) * self.fabric.world_size
            return partial(KnownDivisors, self._count(passes), parts)
        if self.fabric.world_size > 1:
            return partial(DivisorsOverProcesses, self._add_up, self.fabric.world_size)
        return Divisors

    @torch.no_grad()
    def _count(self, passes: list[Batch]) -> Tensor:
        """Places of every term in all passes of all processes."""
        seen = []
        statistics = Statistics(self.objective)
        for part in passes:
            divisors = DivisorsToCome()
            self.objective(part, divisors)
            seen.append(divisors.all())
        statistics.restore()
        return self._add_up(torch.stack(seen).sum(dim=0))

    def _add_up(self, count: Tensor) -> Tensor:
        if self.fabric.world_size == 1:
            return count
        total: Tensor = self.fabric.all_reduce(count, reduce_op="sum")
        return total


def unreached(model: Network, config: TrainConfig) -> list[str]:
    """Parameters that no loss depends on, for whose gradients DDP would wait in vain.

    They follow from the config alone, not from the number of views or what they show.
    """
    trial = copy.deepcopy(model).cpu()
    height, width = config.sizes[0]
    random = torch.Generator().manual_seed(0)
    images = torch.rand(2, 2, 3, height, width, generator=random)
    K = torch.tensor([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1.0]])
    cam_from_world = torch.eye(4).repeat(2, 2, 1, 1)
    cam_from_world[:, 1, 0, 3] = -0.2
    views = PosedViews(K.repeat(2, 2, 1, 1), cam_from_world)
    depth = torch.full((2, 2, height, width), 2.0)
    batch = Batch(images, views, views, depth, torch.zeros(2, 2), images[:, 0])
    total = Objective(trial, config)(batch).total
    if total.requires_grad:  # else no parameter is reached
        total.backward()
    return [
        name
        for name, parameter in trial.named_parameters()
        if parameter.requires_grad and parameter.grad is None
    ]
