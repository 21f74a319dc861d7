"""Does training lower every one of the paper's five losses on rooms that it never sees?

python benchmarks/losses_fall.py deltas-vgg9 [--steps 300] [--size 96 128] [--cache DIR]

Prints each loss before and after, with the weights that the paper gives them.
"""

import argparse
import dataclasses

import torch
from torch import Tensor

from deltas_nets.config import TRAIN_CONFIGS, DataConfig, TrainConfig
from deltas_nets.losses.losses import Losses
from deltas_nets.network.deltas import Deltas
from deltas_nets.train.batches import BatchMaker
from deltas_nets.train.loader import room_loader
from deltas_nets.train.optimiser import make_optimizer, set_learning_rate
from deltas_nets.train.step import Objective

FIVE = ("detector", "match", "point", "smoothness", "depth")
HELD_OUT = 8  # batches, of rooms whose seeds no training uses


def config_of(arguments: argparse.Namespace) -> TrainConfig:
    """A short training, on smaller images than the real one."""
    height, width = arguments.size
    named = TRAIN_CONFIGS[arguments.network]
    return dataclasses.replace(
        named,
        data=DataConfig(
            num_rooms=arguments.rooms, height=192, width=256, cache=arguments.cache, workers=0
        ),
        steps=arguments.steps,
        sizes=((height, width),),
        batch_size=4,
        num_keypoints=192,
        learning_rate=max(named.learning_rate, 5e-4),
        min_views=3,
        max_views=3,
    )


def losses_of(model: Deltas, config: TrainConfig) -> dict[str, float]:
    """Means over held-out rooms."""
    held_out = dataclasses.replace(
        config, data=dataclasses.replace(config.data, seed=500, num_rooms=4 * HELD_OUT)
    )
    objective = Objective(model, held_out)
    maker, total = BatchMaker(held_out), dict.fromkeys(FIVE, 0.0)
    with torch.no_grad():
        for step, rooms in enumerate(room_loader(held_out, start=0, stop=HELD_OUT)):
            losses: Losses = objective(maker(rooms, step))
            for name in FIVE:
                total[name] += float(losses.terms[name]) / HELD_OUT
    return total


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser()
    parser.add_argument(
        "network", choices=[name for name in TRAIN_CONFIGS if name != "cost-volume"]
    )
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--rooms", type=int, default=400)
    parser.add_argument("--size", type=int, nargs=2, default=(96, 128))
    parser.add_argument("--cache")
    config = config_of(parser.parse_args())
    torch.manual_seed(config.seed)
    model = Deltas(config.network)
    before = losses_of(model.train(), config)
    optimizer, maker = make_optimizer(model, config), BatchMaker(config)
    objective = Objective(model, config)
    for step, rooms in enumerate(room_loader(config, start=0, stop=config.steps)):
        set_learning_rate(optimizer, step, config)
        total: Tensor = objective(maker(rooms, step)).total
        optimizer.zero_grad()
        total.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(model.parameters(), config.clip_gradient)
        optimizer.step()
    after = losses_of(model, config)
    weights = {name: getattr(config.loss, name) for name in FIVE}
    print(f"{config.network.name}, {config.steps} steps, held-out rooms")
    for name in FIVE:
        fell = after[name] < before[name]
        print(
            f"{name:<12} weight {weights[name]:.2f}: {before[name]:.4f} to {after[name]:.4f}"
            f"{'' if fell else '  did not fall'}"
        )


if __name__ == "__main__":
    main()
