"""The `deltas` command. Each subcommand is a dataclass: its fields are the flags.

Nothing heavy is imported before a command runs, so that --help is instant.
"""

import contextlib
import io
import re
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import tyro

from deltas_nets import __version__
from deltas_nets.cli_training import Cost, Flag, Train, preset_of
from deltas_nets.config import TRAIN_CONFIGS, to_dict
from deltas_nets.errors import UserError
from deltas_nets.terminal import progress, warn

if TYPE_CHECKING:
    from deltas_nets.network.deltas import Deltas
    from deltas_nets.predict import PredictConfig


@dataclass(frozen=True)
class _Prediction:
    """Flags of every command that predicts."""

    weights: str = "deltas-small"
    """A shipped network, or a weights file of `deltas train`."""
    device: str = "auto"
    """Where to compute: auto, cpu, cuda, cuda:1, mps."""
    depth_range: tuple[float, float] = (0.5, 10.0)
    """Nearest and farthest depth searched, metres."""
    work_size: Annotated[tuple[int, int] | None, tyro.conf.arg(metavar="HEIGHT WIDTH")] = None
    """What the network sees; chosen to suit it if not given."""
    debug: Flag = False
    """Show the traceback of an error."""

    def model(self) -> "Deltas":
        """The network, where it is to run."""
        from deltas_nets.checked_inputs import usable_device
        from deltas_nets.pretrained import load_model

        return load_model(self.weights, usable_device(self.device))

    def config(self, **more: Any) -> "PredictConfig":
        """The flags as a config, with nonsense refused."""
        from deltas_nets.predict import PredictConfig

        try:
            return PredictConfig(depth_range=self.depth_range, work_size=self.work_size, **more)
        except ValueError as error:
            raise UserError(str(error), "command line", "see --help of this command") from None


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
    """Folder with images, poses and intrinsics, or a folder with one such scene inside."""
    out: Path = field(kw_only=True)
    """Folder to write to; the same command continues a run that was stopped."""
    view_sets: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """JSON: [{"anchor": 10, "sources": [8, 12]}, ...]; chosen by baseline and overlap if not
    given."""
    views: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Views per depth map, the anchor included; all of the view sets', or 5, if not given."""
    size: Annotated[tuple[int, int] | None, tyro.conf.arg(metavar="HEIGHT WIDTH")] = None
    """Size of the maps; the colour image's if not given."""
    min_confidence: float = 0.0
    """Leave out pixels of less confidence, 0 to 1."""
    shard: str = "1/1"
    """I/N: this run does every N-th frame from the I-th, for N runs at once."""
    overwrite: Flag = False
    """Start again instead of continuing, or write into a folder that holds other things."""

    def run(self) -> None:
        """Do it."""
        import torch

        from deltas_nets.checked_inputs import (
            check_all,
            read_shard,
            usable_view_sets,
            warn_of_lost,
        )
        from deltas_nets.data.capture import open_capture
        from deltas_nets.outputs import prepare_output
        from deltas_nets.predict import predict_capture
        from deltas_nets.pretrained import weights_record

        shard = read_shard(self.shard)
        config = self.config(size=self.size, min_confidence=self.min_confidence)
        capture = open_capture(self.capture)
        view_sets = usable_view_sets(capture, self.view_sets, self.views)
        check_all(capture, view_sets)
        warn_of_lost(capture, self.view_sets)
        model = self.model()
        mine = view_sets[shard[0] - 1 :: shard[1]]
        folder = prepare_output(
            self.out,
            settings={
                "predict": to_dict(config),
                "network": to_dict(model.config),
                "weights": weights_record(self.weights),
                "capture": {"path": capture.path.resolve(), "cameras": capture.fingerprint()},
                "views": self.views,
                "view_sets": view_sets,
            },
            overwrite=self.overwrite,
            forbidden=capture.path,
            shard=shard,
            frame_ids=[views.anchor for views in mine],
            head={
                "versions": {"deltas-depth": __version__, "torch": torch.__version__},
                "lost_poses": sorted(capture.lost),
            },
        )
        with progress("depth", len(mine)) as report:
            counts = predict_capture(model, capture, mine, folder, config, report=report)
        kept = f", {counts.kept} kept from an earlier run" if counts.kept else ""
        print(f"{counts.written} depth maps in {self.out}{kept}")
        if counts.blind:
            warn(f"{counts.blind} maps without a triangulated point are guesses: see summary.json")


@dataclass(frozen=True)
class Evaluate(_Prediction):
    """Score depth against a capture's sensor depth: the paper's metrics.

    Example: deltas evaluate my_capture --views 3 --json scores.json
    """

    capture: tyro.conf.Positional[Path] = field(kw_only=True)
    """Folder with images, poses, intrinsics and depth/N.png."""
    view_sets: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """JSON: [{"anchor": 10, "sources": [8, 12]}, ...]; chosen if not given."""
    views: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Views per depth map, the anchor included."""
    predictions: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Score the maps that `deltas depth` wrote here instead of predicting."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Also write the scores to this file."""

    def run(self) -> None:
        """Do it."""
        from rich.console import Console

        from deltas_nets.atomic_files import write_json
        from deltas_nets.checked_inputs import check_all, usable_view_sets, with_depth_only
        from deltas_nets.data.capture import open_capture
        from deltas_nets.evaluate.capture import evaluate_files, evaluate_network
        from deltas_nets.evaluate.report import metrics_table, scores_as_json, scores_by_name
        from deltas_nets.outputs import check_writable, recorded_view_sets

        config = self.config()
        if self.json is not None:
            check_writable(self.json.parent)
        capture = open_capture(self.capture)
        if self.predictions is not None and self.view_sets is None:
            view_sets = recorded_view_sets(self.predictions)
        else:
            view_sets = usable_view_sets(capture, self.view_sets, self.views)
        view_sets = with_depth_only(capture, view_sets)
        check_all(capture, view_sets, with_depth=True)
        if self.predictions is not None:
            scores = evaluate_files(
                self.predictions, capture, view_sets, depth_range=self.depth_range
            )
        else:
            model = self.model()
            with progress("evaluate", len(view_sets)) as report:
                scores = evaluate_network(model, capture, view_sets, config, report=report)
        title = f"{capture.path}: {len(scores.frames)} frames"
        Console().print(metrics_table(scores_by_name(scores), title=title))
        if self.json is not None:
            write_json(self.json, scores_as_json(scores))


def main() -> None:
    """Entry point of the `deltas` command."""
    if sys.argv[1:] == ["--version"]:
        print(f"deltas-depth {__version__}")
        return
    command = _parse(sys.argv[1:])
    try:
        command.run()
    except UserError as error:
        if command.debug:
            raise
        _fail(error)
    except KeyboardInterrupt:
        print("deltas: stopped; what is finished is kept", file=sys.stderr)
        sys.exit(130)


Command = Demo | Depth | Evaluate | Train | Cost


def _parse(arguments: list[str]) -> Command:
    """The command that the arguments name; one line of error where they make no sense."""
    said = io.StringIO()
    preset = preset_of(arguments)
    default = Train(out=tyro.MISSING, preset=preset, config=TRAIN_CONFIGS[preset])
    train = Annotated[Train, tyro.conf.subcommand(name="train", default=default)]
    try:
        with contextlib.redirect_stderr(said):
            command: Command = tyro.cli(
                Demo | Depth | Evaluate | train | Cost,
                prog="deltas",
                description="Metric depth from posed images.",
                args=arguments,
            )
    except ValueError as error:
        _fail(UserError(str(error), "command line", _help_of(arguments)))
    except SystemExit as stopped:
        if not stopped.code:
            raise
        # tyro draws a box; what it says fits a line.
        words = re.sub(r"\[/?bold\]|[─│╭╮╰╯]", " ", said.getvalue()).split()
        _fail(UserError(" ".join(words)[:200], "command line", _help_of(arguments)))
    return command


def _help_of(arguments: list[str]) -> str:
    commands = ("demo", "depth", "evaluate", "train", "cost")
    known = [word for word in arguments[:1] if word in commands]
    return " ".join(["see deltas", *known, "--help"])


def _fail(error: UserError) -> NoReturn:
    print(f"deltas: {error}", file=sys.stderr)
    sys.exit(2)


if __name__ == "__main__":
    main()
