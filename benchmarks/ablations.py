"""What each part of deltas-small is worth: the same short training with one thing changed.

python benchmarks/ablations.py --cache DIR [--only NAME ...] [--steps 300] [--results FILE]
                               [--figure FILE]

All variants see the same rooms in the same order from the same seed, and are scored on rooms that
no training uses, three views each, with the usual blur, noise and pose errors. The one with
another seed says how far chance alone moves a score. A variant is appended to the results once it
is done; the same command then skips it, and prints the table of all.
"""

import argparse
import dataclasses
import json
import platform
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import torch

from deltas_nets.captures.posed_images import PosedImages
from deltas_nets.commands.train import encoder_file
from deltas_nets.config import DataConfig, TrainConfig
from deltas_nets.cost.measure import cost_of
from deltas_nets.cost.report import gmacs
from deltas_nets.evaluate.room_scores import score_rooms
from deltas_nets.evaluate.rooms import EVALUATION_SEEDS, held_out_rooms
from deltas_nets.predict.depth_map import PredictConfig
from deltas_nets.predict.ours import DeltasPredictor
from deltas_nets.train.data_sets import training_data
from deltas_nets.train.fit import fit
from deltas_nets.train.start import Start
from deltas_nets.train.step import DEPTH_RANGE
from deltas_nets.weights_file import load_model

SIZE = (144, 192)
VIEWS = 3  # of the rooms to score on
WHERE = {"torch": torch.__version__, "machine": platform.processor() or platform.machine()}

Change = Callable[[TrainConfig], TrainConfig]


class Variant(NamedTuple):
    """One thing that is changed, and whether the encoder starts from its pretrained weights."""

    change: Change
    pretrained: bool = True


def training(**fields: Any) -> Change:
    return lambda config: dataclasses.replace(config, **fields)


def network(**fields: Any) -> Change:
    return lambda config: dataclasses.replace(
        config, network=dataclasses.replace(config.network, **fields)
    )


def matcher(**fields: Any) -> Change:
    return lambda config: network(matcher=dataclasses.replace(config.network.matcher, **fields))(
        config
    )


def points(count: int) -> Change:
    """So many in training and in evaluation."""
    return lambda config: network(
        detector=dataclasses.replace(config.network.detector, num_keypoints=count)
    )(dataclasses.replace(config, num_keypoints=count))


def without(*terms: str) -> Change:
    return lambda config: dataclasses.replace(
        config, loss=dataclasses.replace(config.loss, **dict.fromkeys(terms, 0.0))
    )


VARIANTS = {
    "default": Variant(training()),
    "default, other seed": Variant(training(seed=1)),
    # Which need not be spared: it learns at the rate of the rest.
    "encoder from random weights": Variant(training(encoder_rate=1.0), pretrained=False),
    "descriptors at 1/4": Variant(network(descriptor_stride=4)),
    "matcher per view": Variant(matcher(kind="per_view")),
    "no context": Variant(matcher(context_rounds=0)),
    "2 context rounds": Variant(matcher(context_rounds=2)),
    "32 bins": Variant(matcher(num_samples=32)),
    "128 bins": Variant(matcher(num_samples=128)),
    "one sample a bin": Variant(matcher(max_refinement=1)),
    "half the points": Variant(points(160)),
    "no posterior loss": Variant(without("posterior")),
    "no point and match loss": Variant(without("point", "match")),
    "no gradient loss": Variant(without("gradient")),
    "no smoothness loss": Variant(without("smoothness")),
    "no confidence loss": Variant(without("confidence")),
}


def budget(arguments: argparse.Namespace) -> TrainConfig:
    """The training that all variants share; `deltas train` has more of everything."""
    base = points(320)(TrainConfig())  # as many in evaluation as in training
    return dataclasses.replace(
        base,
        data=DataConfig(
            num_rooms=arguments.rooms,
            num_views=4,
            height=SIZE[0],
            width=SIZE[1],
            cache=arguments.cache,
            workers=0,
        ),
        steps=arguments.steps,
        sizes=(SIZE,),
        batch_size=6,
        max_views=4,
    )


def prepared_rooms(shared: TrainConfig, held_out: int) -> list[PosedImages]:
    """Rooms to score on; those to train on are put into the cache, before anything is timed."""
    to_train_on = training_data(shared)
    for number in range(len(to_train_on)):
        to_train_on[number]
    rooms = held_out_rooms(held_out, EVALUATION_SEEDS, num_views=VIEWS, image_size=SIZE)
    return [rooms[number] for number in range(len(rooms))]


def measure(variant: Variant, shared: TrainConfig, rooms: list[PosedImages]) -> dict[str, float]:
    """Train a variant and score the running average of its weights."""
    config = variant.change(shared)
    encoder = encoder_file("pretrained") if variant.pretrained else None
    with tempfile.TemporaryDirectory() as name:
        began = time.process_time()
        model = load_model(fit(config, Path(name), Start(encoder), checkpoint_every=10**9))
        # Of the processor: what else the machine is doing must not look like a variant's cost.
        cpu_seconds = time.process_time() - began
    config = PredictConfig(DEPTH_RANGE, work_size=SIZE)
    scores = score_rooms(DeltasPredictor(model), rooms, config)
    assert scores.sparse is not None, "no point has a true depth"
    cost = cost_of(model, VIEWS, SIZE, config.network.detector.num_keypoints, repeats=1).total
    return {
        "parameters": cost.parameters,
        "gmacs": gmacs(cost.flops.products),
        "cpu_seconds_per_step": cpu_seconds / config.steps,
        "points_abs_rel": scores.sparse.abs_rel,
        "points_delta1": scores.sparse.delta1,
        "points_coverage": scores.sparse.coverage,
        "dense_abs_rel": scores.dense.abs_rel,
        "dense_delta1": scores.dense.delta1,
    }


def finished(file: Path, settings: dict[str, int]) -> dict[str, dict[str, Any]]:
    """Results of the same settings, by variant."""
    lines = file.read_text(encoding="utf-8").splitlines() if file.exists() else []
    records = [json.loads(line) for line in lines]
    return {record["variant"]: record for record in records if record["settings"] == settings}


def table(records: dict[str, dict[str, Any]]) -> str:
    """The variants in their order, as Markdown."""
    rows = [
        "variant | parameters | GMACs | CPU s/step | points Abs Rel/delta | dense Abs Rel/delta",
        " | ".join(["---", *["---:"] * 5]),
    ]
    for name, found in ((name, records[name]) for name in VARIANTS if name in records):
        rows.append(
            f"{name} | {found['parameters'] / 1e6:.2f} M | {found['gmacs']:.2f} | "
            f"{found['cpu_seconds_per_step']:.2f} | "
            f"{found['points_abs_rel']:.4f} / {found['points_delta1']:.4f} | "
            f"{found['dense_abs_rel']:.4f} / {found['dense_delta1']:.4f}"
        )
    return "\n".join(f"| {row} |" for row in rows)


def draw(records: dict[str, dict[str, Any]], file: Path) -> None:
    """The share of the maps within 25 %, by variant; between the lines is what a seed may do."""
    from matplotlib.figure import Figure

    names = [name for name in VARIANTS if name in records]
    shares = [records[name]["dense_delta1"] for name in names]
    figure = Figure(figsize=(8, 0.35 * len(names) + 1), layout="constrained")
    axes = figure.subplots()
    axes.plot(shares, range(len(names)), "o")
    for name, share in zip(names, shares, strict=True):
        if name.startswith("default"):
            axes.axvline(share, color="grey", linewidth=0.8)
    axes.set_yticks(range(len(names)), names)
    axes.invert_yaxis()
    axes.set_xlabel("delta < 1.25 of maps of rooms that no training uses")
    axes.grid(axis="y", alpha=0.3)
    figure.savefig(file, dpi=120)


def main() -> None:
    """Train what is not yet in the results, and print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--only", nargs="+", choices=list(VARIANTS), default=list(VARIANTS))
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--rooms", type=int, default=600, help="to train on")
    parser.add_argument("--held-out", type=int, default=100, help="rooms to score on")
    parser.add_argument("--cache", required=True, help="folder that keeps rendered rooms")
    parser.add_argument("--results", type=Path, default=Path("runs/ablations/results.jsonl"))
    parser.add_argument("--figure", type=Path, help="image file to draw the table to")
    arguments = parser.parse_args()
    settings = {name: vars(arguments)[name] for name in ("steps", "rooms", "held_out")}
    shared, file = budget(arguments), arguments.results
    todo = [name for name in arguments.only if name not in finished(file, settings)]
    rooms = prepared_rooms(shared, arguments.held_out) if todo else []
    file.parent.mkdir(parents=True, exist_ok=True)
    for name in todo:
        print(f"{name}:", flush=True)
        record = {"variant": name, "settings": settings} | measure(VARIANTS[name], shared, rooms)
        with file.open("a", encoding="utf-8") as opened:
            print(json.dumps(record | WHERE), file=opened)
    print(table(finished(file, settings)))
    if arguments.figure is not None:
        draw(finished(file, settings), arguments.figure)


if __name__ == "__main__":
    main()
