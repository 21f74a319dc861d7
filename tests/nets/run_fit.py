"""Runs `fit` in processes of their own, for tests that launch, kill and resume them.

    python run_fit.py FOLDER CONFIG.json [OPTION ...]

resume      goes on from the folder's checkpoint
double      computes everything in float64: AdamW divides gradients by their size, so rounding
            of a gradient that ought to be zero moves a weight as far as any other gradient
half=STEP   stops for a minute when half of the checkpoint after STEP is written, and says so by
            a file named "writing" in the folder
poison=RANK that process sees NaN in step 1 and from step 3 on, counted from 0
stop=RANK   that process gets SIGTERM in step 1
stop-all    it and all that it started get it
idle        the network has parameters that no loss depends on
teacher=FILE   weights of the config's teacher
"""

import io
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import IO, Any

import torch
from safetensors.torch import load_file
from torch import Tensor, nn

from deltas_geom import PosedViews
from deltas_nets.captures.posed_images import PosedImages
from deltas_nets.config import (
    DataConfig,
    DetectorConfig,
    MatcherConfig,
    NetworkConfig,
    TrainConfig,
    from_dict,
    to_dict,
)
from deltas_nets.network.deltas import Deltas
from deltas_nets.rooms import Rooms
from deltas_nets.train import fit as fit_module
from deltas_nets.train.batches import Batch, BatchMaker
from deltas_nets.train.fit import Start, fit

# Drawn once for all runs: rendering takes longer than the steps.
KEPT = tempfile.TemporaryDirectory(prefix="rooms-")
HELD_OUT = Rooms(1, num_views=2, image_size=(48, 64), cache_dir=Path(KEPT.name))
"""What small runs are validated on."""

CONFIG = TrainConfig(
    network=NetworkConfig(
        detector=DetectorConfig(num_keypoints=48), matcher=MatcherConfig(num_samples=32)
    ),
    data=DataConfig(num_rooms=4, num_views=3, height=48, width=64, workers=0, cache=KEPT.name),
    sizes=((48, 64),),
    steps=8,
    batch_size=4,
    warmup=2,
    max_views=3,
    num_keypoints=48,
)


def launch(
    folder: Path, config: TrainConfig, *options: str, processes: int = 1
) -> "subprocess.Popen[str]":
    """Start processes that train, without waiting for them."""
    folder.mkdir(parents=True, exist_ok=True)
    file = folder.with_suffix(".json")
    file.write_text(json.dumps(to_dict(config)))
    torchrun = ["-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={processes}"]
    return subprocess.Popen(
        [
            sys.executable,
            *(torchrun if processes > 1 else []),
            __file__,
            str(folder),
            str(file),
            *options,
        ],
        # On a machine with GPUs as well: two processes need two of those.
        env={**os.environ, "OMP_NUM_THREADS": "1", "LT_ACCELERATOR": "cpu"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )


def train(
    folder: Path,
    config: TrainConfig,
    start: Start,
    *,
    stop: int | None = None,
    validate_every: int = 500,
    report: Callable[[str], None] = lambda message: None,
) -> None:
    """Train in this process; validation looks at one small room."""
    rooms, threads = fit_module.validation_rooms, torch.get_num_threads()
    kept = Path(config.data.cache) if config.data.cache else None
    fit_module.validation_rooms = lambda: Rooms(1, num_views=2, image_size=(48, 64), cache_dir=kept)
    torch.set_num_threads(1)  # as in every other process, to the last bit
    try:
        fit(
            config,
            folder,
            start,
            checkpoint_every=3,
            validate_every=validate_every,
            log_every=1,
            stop=stop,
            report=report,
        )
    finally:
        fit_module.validation_rooms = rooms
        torch.set_num_threads(threads)


def finish(process: "subprocess.Popen[str]", *, code: int = 0) -> str:
    """Wait for processes, and return what they said."""
    try:
        said, _ = process.communicate(timeout=120)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)  # those that it started as well
        raise
    assert process.returncode == code, said
    return said


def read_checkpoint(folder: Path) -> dict[str, Any]:
    content: dict[str, Any] = torch.load(folder / "checkpoint.pt", weights_only=True)
    return content


def logged(folder: Path) -> list[dict[str, Any]]:
    """Losses of every step in the log, without times."""
    lines = [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]
    return [
        {name: value for name, value in line.items() if name != "seconds"}
        for line in lines
        if "total" in line
    ]


def assert_same_state(one: Path, other: Path) -> None:
    """Weights, their average, the optimizer and what is shipped agree bit for bit."""
    first, second = read_checkpoint(one), read_checkpoint(other)
    assert first["step"] == second["step"]
    for part in ("model", "average"):
        assert first[part].keys() == second[part].keys()
        for name, tensor in first[part].items():
            assert torch.equal(second[part][name], tensor), f"{part} {name}"
    moments, others = first["optimizer"]["state"], second["optimizer"]["state"]
    assert moments.keys() == others.keys()
    for number, moment in moments.items():
        for name, tensor in moment.items():
            assert torch.equal(others[number][name], tensor), f"{name} of parameter {number}"
    shipped, again = (load_file(folder / "weights.safetensors") for folder in (one, other))
    assert shipped.keys() == again.keys()
    assert all(torch.equal(again[name], tensor) for name, tensor in shipped.items())


@contextmanager
def double_precision() -> Iterator[None]:
    """Computes everything in float64."""
    make, single, validate = BatchMaker.__call__, Tensor.float, fit_module.validate

    def in_double(maker: BatchMaker, rooms: PosedImages, step: int) -> Batch:
        views = PosedViews(*map(Tensor.double, rooms.views))
        batch = make(maker, rooms._replace(views=views), step)
        return batch._replace(depth=batch.depth.double())

    torch.set_default_dtype(torch.float64)
    Tensor.float = Tensor.double  # type: ignore[method-assign]
    BatchMaker.__call__ = in_double  # type: ignore[method-assign, assignment]
    fit_module.validate = lambda model: {}
    try:
        yield
    finally:
        torch.set_default_dtype(torch.float32)
        Tensor.float = single  # type: ignore[method-assign]
        BatchMaker.__call__ = make  # type: ignore[method-assign]
        fit_module.validate = validate


def stop_half_written(folder: Path, step: int) -> None:
    save = torch.save

    def slow(content: Any, file: IO[bytes]) -> None:
        whole = io.BytesIO()
        save(content, whole)
        written = whole.getvalue()
        if content["step"] == step:
            file.write(written[: len(written) // 2])
            file.flush()
            (folder / "writing").touch()
            time.sleep(60)
        file.write(written)

    torch.save = slow  # type: ignore[assignment]


def poison() -> None:
    make = BatchMaker.__call__

    def poisoned(maker: BatchMaker, rooms: PosedImages, step: int) -> Batch:
        batch = make(maker, rooms, step)
        bad = step == 1 or step >= 3
        return batch._replace(images=batch.images * torch.nan) if bad else batch

    BatchMaker.__call__ = poisoned  # type: ignore[method-assign, assignment]


def add_idle_parameters() -> None:
    build = Deltas.__init__

    def with_more(model: Deltas, config: NetworkConfig) -> None:
        build(model, config)
        model.idle = nn.Linear(2, 2)

    Deltas.__init__ = with_more  # type: ignore[method-assign]


def get_told_to_stop(tell: Callable[[int], None]) -> None:
    make = BatchMaker.__call__

    def told(maker: BatchMaker, rooms: PosedImages, step: int) -> Batch:
        if step == 1:
            tell(signal.SIGTERM)
            time.sleep(1)  # until it has reached all
        return make(maker, rooms, step)

    BatchMaker.__call__ = told  # type: ignore[method-assign, assignment]


def main() -> None:
    KEPT.cleanup()  # the config names the one of who started this process
    folder, config = Path(sys.argv[1]), json.loads(Path(sys.argv[2]).read_text())
    options = dict(option.partition("=")[::2] for option in sys.argv[3:])
    rank = os.environ.get("RANK") or os.environ.get("LOCAL_RANK", "0")
    fit_module.PATIENCE = 2
    if "half" in options:
        stop_half_written(folder, int(options["half"]))
    if options.get("poison") == rank:
        poison()
    if "idle" in options:
        add_idle_parameters()
    if options.get("stop") == rank:
        get_told_to_stop(signal.raise_signal)
    if "stop-all" in options:
        get_told_to_stop(lambda number: os.killpg(0, number))
    with double_precision() if "double" in options else nullcontext():
        teacher = Path(options["teacher"]) if "teacher" in options else None
        start = Start(resume="resume" in options, teacher=teacher)
        train(folder, from_dict(TrainConfig, config), start)


if __name__ == "__main__":
    main()
