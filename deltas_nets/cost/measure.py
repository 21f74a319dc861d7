"""Cost of a network on posed images, by stage."""

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from statistics import median
from typing import NamedTuple

import torch
from torch import Tensor, nn

from deltas_geom import PosedViews
from deltas_nets.cost.memory import PeakMemory
from deltas_nets.cost.operations import Flops, OperationCounter
from deltas_nets.cost.stages import (
    followed_stages,
    parameters_by_stage,
    stage_names,
    timed_stages,
)


class StageCost(NamedTuple):
    """Cost of one stage, or of all.

    Attributes:
        parameters: numbers in its weights.
        flops: operations; two are a multiply-accumulate.
        seconds: median over the runs.
    """

    parameters: int
    flops: Flops
    seconds: float


class Cost(NamedTuple):
    """Cost of a forward pass.

    Attributes:
        stages: by name, in the order of the network's children, geometry last.
        total: of all; its seconds are the median of whole runs, not the sum of medians.
        peak_bytes: most memory held by intermediate tensors at once.
        unknown: calls of operators that are not counted for want of a formula, by name.
    """

    stages: dict[str, StageCost]
    total: StageCost
    peak_bytes: int
    unknown: dict[str, int]


def cost_of(
    model: nn.Module,
    num_views: int = 2,
    image_size: tuple[int, int] = (240, 320),
    num_keypoints: int = 512,
    *,
    repeats: int = 5,
) -> Cost:
    """Cost of one anchor's depth, without gradients, where the model is.

    Args:
        model: called as `Deltas` is; its children are its stages.
        num_views: the anchor and its sources.
        image_size: (height, width).
        num_keypoints: points to triangulate.
        repeats: runs that are timed, after one that is not.
    """
    images, views = posed_noise(num_views, image_size=image_size)
    weight = next(model.parameters())
    images, views = images.to(weight), views.to(weight)

    def run() -> object:
        return model(images, views, num_keypoints=num_keypoints)

    return cost_of_run(model, run, repeats=repeats)


def cost_of_run(model: nn.Module, run: Callable[[], object], *, repeats: int = 5) -> Cost:
    """Cost of ``run``, for networks with inputs and entry points of their own.

    Args:
        model: its children are the stages.
        run: calls the model; whatever it computes outside the children counts as geometry, so
            inputs are better made before.
        repeats: runs that are timed, after one that is not.

    Raises:
        ValueError: there is nothing to take the median of.
    """
    if repeats < 1:
        raise ValueError(f"repeats must be at least 1, got {repeats}")
    with torch.no_grad(), _evaluating(model):
        # Counting comes first: it also warms up.
        counted = _counted(model, run)
        with PeakMemory() as memory:
            run()
        runs = [_timed(model, run) for _ in range(repeats)]
    parameters = parameters_by_stage(model)
    stages = {
        name: StageCost(
            parameters[name],
            counted.flops.get(name, Flops(0, 0)),
            median(seconds[name] for seconds in runs),
        )
        for name in stage_names(model)
    }
    total = StageCost(
        sum(parameters.values()),
        counted.total(),
        median(sum(seconds.values()) for seconds in runs),
    )
    return Cost(stages, total, memory.peak, dict(counted.unknown))


def posed_noise(num_views: int, *, image_size: tuple[int, int]) -> tuple[Tensor, PosedViews]:
    """Images ``(V, 3, H, W)`` of noise, always the same, and cameras 10 cm apart in a row.

    What is in the images hardly matters: the number of keypoints is fixed, and only points that
    the triangulation has to solve a second way cost more.
    """
    height, width = image_size
    images = torch.rand(num_views, 3, height, width, generator=torch.Generator().manual_seed(0))
    K = torch.tensor(
        [
            [0.9 * width, 0, (width - 1) / 2],
            [0, 0.9 * width, (height - 1) / 2],
            [0, 0, 1],
        ]
    )
    cam_from_world = torch.eye(4).repeat(num_views, 1, 1)
    cam_from_world[:, 0, 3] = -0.1 * torch.arange(num_views)
    return images, PosedViews(K.repeat(num_views, 1, 1), cam_from_world)


def _counted(model: nn.Module, run: Callable[[], object]) -> OperationCounter:
    counter = OperationCounter()
    with followed_stages(model, counter.enter), counter:
        run()
    return counter


def _timed(model: nn.Module, run: Callable[[], object]) -> Mapping[str, float]:
    """Seconds of each stage in one run."""
    seconds: dict[str, float] = defaultdict(float)
    with timed_stages(model) as laps:
        run()
    for stage, lap in laps:
        seconds[stage] += lap
    return seconds


@contextmanager
def _evaluating(model: nn.Module) -> Iterator[None]:
    """Put it in eval mode for the block, then each module back as it was."""
    modes = {module: module.training for module in model.modules()}
    model.eval()
    try:
        yield
    finally:
        for module, training in modes.items():
            module.training = training
