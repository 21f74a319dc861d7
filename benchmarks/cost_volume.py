"""Points and a densifier against a cost volume: two networks, the same rooms, steps and encoder.

    python benchmarks/cost_volume.py --cache DIR --weights DIR [--steps 400] [--results FILE]

`deltas-small` and `cost-volume` are trained from a pretrained encoder by the budget of
benchmarks/ablations.py, each by its own losses, and scored on rooms that no training uses. Both
weights files stay in --weights, for `deltas evaluate CAPTURE --weights FILE`; the same command goes
on with a run that was stopped.
"""

import argparse
import dataclasses
import json
import platform
import time
from pathlib import Path
from typing import Any

import torch
from ablations import SIZE, VIEWS, budget, prepared_rooms

from deltas_nets.captures.posed_images import PosedImages
from deltas_nets.commands.train import encoder_file
from deltas_nets.config import TRAIN_CONFIGS, TrainConfig
from deltas_nets.cost.measure import cost_of
from deltas_nets.cost.report import gmacs
from deltas_nets.evaluate.room_scores import score_rooms
from deltas_nets.predict.depth_map import PredictConfig
from deltas_nets.predict.predictor import load_predictor
from deltas_nets.train.fit import fit
from deltas_nets.train.start import Start
from deltas_nets.train.step import DEPTH_RANGE
from deltas_nets.weights_file import load_network, read_metadata

NETWORKS = ("deltas-small", "cost-volume")


def training(name: str, shared: TrainConfig) -> TrainConfig:
    """What both share, with the network and the losses of one."""
    own = TRAIN_CONFIGS[name]
    network = own.network
    if name == "deltas-small":  # as many points in evaluation as in training
        detector = dataclasses.replace(network.detector, num_keypoints=shared.num_keypoints)
        network = dataclasses.replace(network, detector=detector)
    return dataclasses.replace(shared, network=network, loss=own.loss)


def trained(name: str, shared: TrainConfig, folder: Path) -> dict[str, float]:
    """Train one, unless its weights are there; what it took."""
    finished = folder / "seconds.json"
    if not finished.exists():
        start, done = Start(encoder_file("pretrained", "lite")), 0
        if (folder / "checkpoint.pt").exists():
            start, done = (
                Start(resume=True),
                int(read_metadata(folder / "weights.safetensors")["step"]),
            )
        began = time.process_time()
        fit(training(name, shared), folder, start, checkpoint_every=50)
        # Of the processor: what else the machine is doing must not look like a network's cost.
        took = {"cpu_seconds_per_step": (time.process_time() - began) / max(1, shared.steps - done)}
        finished.write_text(json.dumps(took))
    read: dict[str, float] = json.loads(finished.read_text())
    return read


def scored(file: Path, rooms: list[PosedImages], num_keypoints: int) -> dict[str, float]:
    """Cost, and errors of dense maps."""
    model = load_network(file)
    config = PredictConfig(DEPTH_RANGE, work_size=SIZE)
    scores = score_rooms(load_predictor(file), rooms, config)
    cost = cost_of(model, VIEWS, SIZE, num_keypoints, repeats=5)
    return {
        "parameters": cost.total.parameters,
        "gmacs": gmacs(cost.total.flops.products),
        "peak_bytes": cost.peak_bytes,
        "abs_rel": scores.dense.abs_rel,
        "delta1": scores.dense.delta1,
    }


def main() -> None:
    """Train both, score both, print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--rooms", type=int, default=600, help="to train on")
    parser.add_argument("--held-out", type=int, default=100, help="rooms to score on")
    parser.add_argument("--cache", required=True, help="folder that keeps rendered rooms")
    parser.add_argument("--weights", type=Path, required=True, help="folder of both runs")
    parser.add_argument("--results", type=Path)
    arguments = parser.parse_args()
    shared = budget(arguments)
    rooms = prepared_rooms(shared, arguments.held_out)
    found: dict[str, Any] = {}
    for name in NETWORKS:
        folder = arguments.weights / f"{name}-{arguments.steps}"
        took = trained(name, shared, folder)
        found[name] = took | scored(folder / "weights.safetensors", rooms, shared.num_keypoints)
        print(name, json.dumps(found[name]), flush=True)
    rows = ["network | parameters | GMACs | CPU s/step | Abs Rel / delta < 1.25"]
    rows.append("-- | --: | --: | --: | --:")
    for name, row in found.items():
        rows.append(
            f"{name} | {row['parameters'] / 1e6:.2f} M | {row['gmacs']:.2f} | "
            f"{row['cpu_seconds_per_step']:.2f} | {row['abs_rel']:.4f} / {row['delta1']:.4f}"
        )
    print("\n".join(f"| {row} |" for row in rows))
    if arguments.results is not None:
        where = {"torch": torch.__version__, "machine": platform.processor() or platform.machine()}
        settings = {name: vars(arguments)[name] for name in ("steps", "rooms", "held_out")}
        arguments.results.write_text(json.dumps({"settings": settings, "networks": found} | where))


if __name__ == "__main__":
    main()
