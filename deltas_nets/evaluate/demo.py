"""The demo: a real stereo pair in, depth, errors, times and a figure out."""

import time
from collections.abc import Sequence
from pathlib import Path

import torch
from rich.box import SIMPLE_HEAD
from rich.table import Table

from deltas_nets import __version__
from deltas_nets.captures.motorcycle import StereoPair, motorcycle
from deltas_nets.config import to_dict
from deltas_nets.cost.stages import Lap, timed_stages
from deltas_nets.evaluate.depth_metrics import depth_metrics
from deltas_nets.evaluate.figure import draw_prediction
from deltas_nets.evaluate.points import median_point_error, score_points
from deltas_nets.evaluate.report import metrics_table
from deltas_nets.network.deltas import Deltas
from deltas_nets.outputs.prepare import prepare_output
from deltas_nets.outputs.products import FrameOutput
from deltas_nets.predict.depth_map import PredictConfig
from deltas_nets.predict.encoded_frames import EncodedFrames
from deltas_nets.predict.ours import predict_frame
from deltas_nets.predict.trial import surer, with_larger_images
from deltas_nets.terminal import table_console

STAGES = ("encoder", "detector", "descriptor", "matcher", "densifier")
BETWEEN = "triangulation and sparse depth"


def run_demo(
    model: Deltas, config: PredictConfig, out: Path, weights: str, *, overwrite: bool = False
) -> None:
    """Predict the motorcycle pair, print what came out and write it to ``out``.

    Raises:
        UserError: the folder cannot be written, or scikit-image carries no pair.
    """
    pair = motorcycle()
    if config.work_size is None:
        config = surer(config, [_gain(EncodedFrames(model), pair, config)])
    folder = prepare_output(
        out,
        settings={
            "demo": "motorcycle",
            "predict": to_dict(config),
            "network": to_dict(model.config),
            "weights": weights,
            "precision": str(model.dtype).removeprefix("torch."),
        },
        overwrite=overwrite,
        head={"versions": {"deltas-depth": __version__, "torch": torch.__version__}},
    )
    started = time.perf_counter()
    with timed_stages(model) as laps:
        result = predict_frame(EncodedFrames(model), [pair.left, pair.right], config)
    elapsed = time.perf_counter() - started
    seconds = _seconds_by_stage(laps)
    dense = depth_metrics(result.map.depth, pair.depth, depth_range=config.depth_range)
    sparse = score_points(result.prediction, pair.depth, config.depth_range)
    assert dense is not None
    assert sparse is not None
    median = median_point_error(result.prediction, pair.depth, config.depth_range)
    record = {
        "status": "ok",
        "sources": ["right"],
        "seconds": round(elapsed, 4),
        "stages": {name: round(value, 4) for name, value in seconds.items()},
        "dense": dense._asdict(),
        "sparse": sparse._asdict() | {"median_relative_error": median},
    }
    folder.write_frame(
        FrameOutput(
            pair.left, result.map.depth, result.map.confidence, result.map.points, result.map.colors
        ),
        record,
    )
    figure = out / "demo.png"
    title = f"{model.config.name} on Middlebury Motorcycle, left and right image"
    draw_prediction(figure, result, pair.depth, depth_range=config.depth_range, title=title)
    folder.write_summary("complete", seconds=round(time.perf_counter() - started, 3))

    console = table_console()
    rows = {"dense": dense, "sparse points": sparse}
    console.print(metrics_table(rows, title="Middlebury Motorcycle"))
    console.print(f"sparse median error {100 * median:.2f} %")
    console.print(_stage_table(seconds))
    console.print(f"figure in {figure}, depth in {folder.file('depth', 'left')}", soft_wrap=True)


def _gain(encode: EncodedFrames, pair: StereoPair, config: PredictConfig) -> float:
    """Confidence that larger images add to the map."""
    usual, large = (
        predict_frame(encode, [pair.left, pair.right], each).map.confidence
        for each in (config, with_larger_images(config))
    )
    assert usual is not None and large is not None  # a network of deltas states it
    return float(large.mean() - usual.mean())


def _seconds_by_stage(laps: Sequence[Lap]) -> dict[str, float]:
    """Seconds of each stage, and from the first to the last of them."""
    seconds = dict.fromkeys((*STAGES, BETWEEN), 0.0)
    # Before the first stage images are read, and after the last one results are resized.
    for name, time_of_lap in laps[1:-1]:
        seconds[name if name in STAGES else BETWEEN] += time_of_lap
    return seconds | {"total": sum(seconds.values())}


def _stage_table(seconds: dict[str, float]) -> Table:
    table = Table(title="time of each stage", title_justify="left", box=SIMPLE_HEAD)
    table.add_column("stage")
    table.add_column("ms", justify="right")
    for name, value in seconds.items():
        table.add_row(name, f"{1000 * value:.1f}")
    return table
