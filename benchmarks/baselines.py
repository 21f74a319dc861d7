"""Ours, what needs no learning, a cost volume and networks of others: one run, one table.

    python benchmarks/baselines.py CAPTURE [VIEWS] [SETS] [--threads N] [--volume FILE]
        [--ours FILE] [--peers PEERS/run.py] [--only NAME ...] [--json FILE]

CAPTURE has view_sets.json and sensor depth; SETS of its sets are looked at, by all methods the
same. Each method runs in a process of its own, whose peak memory is in the table together with
that of a process that does nothing but load torch and the images. --volume names weights of the
cost-volume network, --ours those of the deltas network that was trained as long
(benchmarks/cost_volume.py makes both). PEERS/run.py is a program with a table MK of networks:
called with images in BGR, K, poses, NEAR and FAR they give a map. --json writes a record of
results, as that of `deltas evaluate` does.

Every map is made anew, nothing is remembered from the one before. GMACs are counted by deltas_nets
as in `deltas cost`, of one map: those of convolutions and matrix products, and those of all
operators with a formula.
"""

import argparse
import importlib.util
import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import nn

from deltas_nets import open_capture
from deltas_nets.captures.frame import Frame
from deltas_nets.captures.usable import usable_view_sets
from deltas_nets.captures.work_size import depth_at_image
from deltas_nets.config.baselines import BASELINES
from deltas_nets.cost.operations import OperationCounter
from deltas_nets.cost.report import gmacs
from deltas_nets.evaluate.depth_metrics import depth_metrics, mean_metrics
from deltas_nets.evaluate.record import Record, command_line, machine, write_record
from deltas_nets.evaluate.scores import resize_nearest
from deltas_nets.predict.depth_map import PredictConfig, frames_of
from deltas_nets.predict.look import look
from deltas_nets.predict.ours import DeltasPredictor
from deltas_nets.predict.predictor import load_predictor
from deltas_nets.predict.reach import ROOM, Reach

NOTHING = "nothing"
"""The method that loads torch and images, for its memory."""
PEERS = ("mvsn_demon", "itermvs_dtu", "itermvs_blended", "patchmatchnet")


class Method(NamedTuple):
    """A way from frames to a map, and the networks in it."""

    map: Callable[[Sequence[Frame]], Any]
    networks: tuple[nn.Module, ...] = ()


def method(name: str, capture: Any, view_sets: Any, peers: Path | None) -> Method:
    """A method by name: weights of ours, a baseline, or a peer."""
    if name == NOTHING:
        return Method(lambda frames: np.zeros(frames[0].image_size))
    if name in PEERS:
        assert peers is not None, "--peers"
        return of_peers(name, peers)
    predictor, config = load_predictor(name), PredictConfig()
    predictor.check_asked(config, capture, view_sets)

    def found(frames: Sequence[Frame]) -> Any:
        if isinstance(predictor, DeltasPredictor):
            fresh = DeltasPredictor(predictor.encode.model, without_points=predictor.without_points)
            return look(fresh, frames, config, Reach(*ROOM)).depth
        if hasattr(predictor, "encode"):
            predictor.encode = type(predictor.encode)(predictor.encode.model)
        return look(predictor, frames, config, Reach(*ROOM)).depth

    encode = getattr(predictor, "encode", None)
    model = getattr(predictor, "model", None) if encode is None else encode.model
    return Method(found, () if model is None else (model,))


def of_peers(name: str, program: Path) -> Method:
    """A network of others, by the table of their program."""
    spec = importlib.util.spec_from_file_location("peers_run", program)
    assert spec is not None and spec.loader is not None
    threads = torch.get_num_threads()
    module = importlib.util.module_from_spec(spec)
    sys.modules["peers_run"] = module
    spec.loader.exec_module(module)
    torch.set_num_threads(threads)
    network = module.MK[name]()

    @torch.no_grad()
    def found(frames: Sequence[Frame]) -> Any:
        images = [np.ascontiguousarray(frame.read_image()[..., ::-1]) for frame in frames]
        poses = [np.linalg.inv(frame.cam_from_world) for frame in frames]
        return network(images, frames[0].K.copy(), poses, *ROOM)

    return Method(found, (network.m,))


def measured(arguments: argparse.Namespace) -> dict[str, Any]:
    """One method's row, in this process."""
    torch.set_num_threads(arguments.threads)
    capture = open_capture(arguments.capture).remembering()
    file = capture.path / "view_sets.json"
    sets = usable_view_sets(capture, file, arguments.views).view_sets
    sets = sets[:: max(1, len(sets) // arguments.sets)][: arguments.sets]
    way = method(arguments.method, capture, sets, arguments.peers)
    scores, seconds = [], []
    for number, chosen in enumerate([sets[0], *sets]):  # the first map is not timed
        frames = frames_of(capture, chosen)
        for frame in frames:
            frame.read_image()
        began = time.perf_counter()
        found = np.asarray(way.map(frames), dtype=np.float32)
        if number:
            seconds.append(time.perf_counter() - began)
            truth = depth_at_image(frames[0])
            found = np.where(np.isfinite(found), found, 0)
            scores.append(depth_metrics(resize_nearest(found, truth.shape), truth))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # before counting, which needs more
    with OperationCounter() as counter:
        way.map(frames_of(capture, sets[0]))
    mean = mean_metrics([score for score in scores if score is not None])
    total = counter.total()
    return {
        "maps": len(sets),
        "abs_rel": mean.abs_rel,
        "delta1": mean.delta1,
        "coverage": mean.coverage,
        "gmacs_products": gmacs(total.products),
        "gmacs_all": gmacs(total.every),
        "without_a_formula": dict(counter.unknown),
        "parameters": sum(p.numel() for model in way.networks for p in model.parameters()),
        "seconds": float(np.median(seconds)),
        "peak_mb": peak / 1024,
    }


def in_a_process(name: str, arguments: argparse.Namespace) -> dict[str, Any]:
    """One method's row, of a process of its own."""
    command = [sys.executable, __file__, *sys.argv[1:], "--method", name]
    environment = os.environ | {"OMP_NUM_THREADS": str(arguments.threads)}
    done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True)
    if done.returncode:
        return {"failed": done.returncode}
    row: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return row


def table(rows: dict[str, dict[str, Any]]) -> str:
    """The rows as Markdown."""
    lines = [
        "| | Abs Rel / delta < 1.25 | GMACs, products (all) | parameters | s a map | peak MB |",
        "|--|--:|--:|--:|--:|--:|",
    ]
    for name, row in rows.items():
        if "failed" in row:
            lines.append(f"| {name} | failed ({row['failed']}) | | | | |")
            continue
        error = "" if name == NOTHING else f"{row['abs_rel']:.3f} / {row['delta1']:.3f}"
        if row["coverage"] < 0.995 and name != NOTHING:
            error += f" of {row['coverage']:.2f}"
        lines.append(
            f"| {name} | {error} | {row['gmacs_products']:.1f} ({row['gmacs_all']:.1f}) "
            f"| {row['parameters'] / 1e6:.2f} M | {row['seconds']:.2f} | {row['peak_mb']:.0f} |"
        )
    return "\n".join(lines)


def main() -> None:
    """Run every method and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("capture", type=Path, help="with view_sets.json and sensor depth")
    parser.add_argument("views", type=int, nargs="?", default=3, help="of a map (3)")
    parser.add_argument("sets", type=int, nargs="?", default=8, help="maps of each method (8)")
    parser.add_argument("--volume", help="weights of the cost-volume network")
    parser.add_argument("--ours", help="weights of deltas-small, trained as long as it")
    parser.add_argument("--peers", type=Path, help="run.py of networks of others")
    only = f"of {', '.join((NOTHING, 'deltas-small', *BASELINES, *PEERS))}, or weights"
    parser.add_argument("--only", nargs="+", metavar="NAME", help=only)
    threads = "of torch and of what counts like it (all cores)"
    parser.add_argument("--threads", type=int, default=torch.get_num_threads(), help=threads)
    parser.add_argument("--json", type=Path, help="file for a record of the table")
    parser.add_argument("--method", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.method:
        print(json.dumps(measured(arguments)))
        return
    names = [NOTHING, "deltas-small", *BASELINES]
    names += [file for file in (arguments.ours, arguments.volume) if file]
    names += PEERS if arguments.peers else ()
    rows = {}
    for name in arguments.only or names:
        rows[name] = in_a_process(name, arguments)
        print(name, json.dumps(rows[name]), file=sys.stderr, flush=True)
    title = f"{arguments.capture.name}, {arguments.views} views, {arguments.sets} maps"
    print(f"{title}, {arguments.threads} threads\n\n{table(rows)}")
    if arguments.json is not None:
        write_record(arguments.json, record_of(rows, arguments))


def record_of(rows: dict[str, dict[str, Any]], arguments: argparse.Namespace) -> Record:
    """The table as it is stored."""
    flat = []
    for name, row in rows.items():
        unknown = ", ".join(row.get("without_a_formula", {}))
        flat.append({"method": Path(name).name, **row, "without_a_formula": unknown})
    return Record(
        "baselines",
        protocol={"views": arguments.views},
        command=f"python benchmarks/{command_line()}",
        data=[{"name": arguments.capture.name, "view_sets": arguments.sets}],
        rows=flat,
        machine={**machine(), "threads": arguments.threads},
    )


if __name__ == "__main__":
    main()
