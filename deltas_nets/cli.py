"""The `deltas` command. Each subcommand is a dataclass: its fields are the flags.

Nothing heavy is imported before a command runs, so that --help is instant.
"""

import contextlib
import io
import re
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NoReturn

import tyro

from deltas_nets import __version__
from deltas_nets.cli_calibrate import Calibrate
from deltas_nets.cli_export import Export
from deltas_nets.cli_training import Cost, Flag, Train, preset_of
from deltas_nets.config import TRAIN_CONFIGS, to_dict
from deltas_nets.errors import UserError
from deltas_nets.terminal import progress, warn

if TYPE_CHECKING:
    from deltas_nets.any_network import AnyNetwork
    from deltas_nets.evaluate.scores import CaptureScores
    from deltas_nets.predict import PredictConfig


@dataclass(frozen=True)
class _Prediction:
    """Flags of every command that predicts."""

    weights: str = "deltas-small"
    """A shipped network, a weights file of `deltas train`, or the checkpoint that the paper's
    authors published (for depth and evaluate; it states no confidence)."""
    device: str = "auto"
    """Where to compute: auto, cpu, cuda, cuda:1, mps."""
    depth_range: tuple[float, float] = (0.5, 10.0)
    """Nearest and farthest depth searched, metres."""
    work_size: Annotated[tuple[int, int] | None, tyro.conf.arg(metavar="HEIGHT WIDTH")] = None
    """What the network sees; chosen to suit it if not given."""
    debug: Flag = False
    """Show the traceback of an error."""

    def network(self) -> "AnyNetwork":
        """The network, where it is to run."""
        from deltas_nets.any_network import load_network
        from deltas_nets.checked_inputs import usable_device

        return load_network(self.weights, usable_device(self.device))

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
        from deltas_nets.network.deltas import Deltas

        network = self.network()
        if not isinstance(network, Deltas):
            what = "the demo draws stages that the published network does not have"
            raise UserError(what, self.weights, "use deltas depth")
        run_demo(network, self.config(), self.out, self.weights, overwrite=self.overwrite)


@dataclass(frozen=True)
class Depth(_Prediction):
    """Write a metric depth map for every frame of a posed capture.

    The capture is a folder in ScanNet's export layout: color/N.jpg, pose/N.txt,
    intrinsic/intrinsic_color.txt. Writes DIR/depth/N.png (16-bit millimetres),
    DIR/confidence/N.png, DIR/points/N.ply and DIR/summary.json. The network that the authors of the
    paper published states no confidence, so with its checkpoint none is written.

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

        from deltas_nets.any_network import file_record, network_record
        from deltas_nets.checked_inputs import (
            check_all,
            read_shard,
            usable_view_sets,
            warn_of_lost,
        )
        from deltas_nets.data.capture import open_capture
        from deltas_nets.outputs import prepare_output
        from deltas_nets.predict import check_asked, states_confidence
        from deltas_nets.predict_capture import predict_capture

        shard = read_shard(self.shard)
        config = self.config(size=self.size, min_confidence=self.min_confidence)
        capture = open_capture(self.capture)
        view_sets = usable_view_sets(capture, self.view_sets, self.views)
        check_all(capture, view_sets)
        warn_of_lost(capture, self.view_sets)
        network = self.network()
        check_asked(network, config, capture, view_sets)
        mine = view_sets[shard[0] - 1 :: shard[1]]
        folder = prepare_output(
            self.out,
            settings={
                "predict": to_dict(config),
                "network": network_record(network),
                "weights": file_record(self.weights, network),
                "capture": {"path": capture.path.resolve(), "cameras": capture.fingerprint()},
                "views": self.views,
                "view_sets": view_sets,
            },
            overwrite=self.overwrite,
            forbidden=capture.path,
            shard=shard,
            frame_ids=[views.anchor for views in mine],
            confidence=states_confidence(network),
            head={
                "versions": {"deltas-depth": __version__, "torch": torch.__version__},
                "lost_poses": sorted(capture.lost),
            },
        )
        with progress("depth", len(mine)) as report:
            counts = predict_capture(network, capture, mine, folder, config, report=report)
        kept = f", {counts.kept} kept from an earlier run" if counts.kept else ""
        print(f"{counts.written} depth maps in {self.out}{kept}")
        if not states_confidence(network):
            print("no confidence is written: the published network states none")
        if counts.blind:
            warn(f"{counts.blind} maps without a triangulated point are guesses: see summary.json")


@dataclass(frozen=True)
class Evaluate(_Prediction):
    """Score depth against a capture's sensor depth, or on rooms: the paper's metrics.

    Of networks that state a standard deviation also: how much smaller the error of the half of each
    map is that is most certain, and predicted against true errors.

    Example: deltas evaluate my_capture --views 3 --json scores.json
    """

    capture: tyro.conf.Positional[Path | None] = field(default=None, kw_only=True)
    """Folder with images, poses, intrinsics and depth/N.png."""
    rooms: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Instead of a capture: the first N, at most 500, of the procedural rooms that neither training
    nor calibration sees, at --work-size, 288 384 if not given."""
    conditions: Literal["ideal", "real"] = "real"
    """Of rooms: ideal is as rendered, real has blur, noise and usual pose errors."""
    view_sets: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """JSON: [{"anchor": 10, "sources": [8, 12]}, ...]; chosen if not given."""
    views: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Views per depth map, the anchor included; 3 of rooms if not given."""
    predictions: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Score the maps that `deltas depth` wrote here instead of predicting."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Also write the scores to this file."""

    def run(self) -> None:
        """Do it."""
        from rich.console import Console

        from deltas_nets.atomic_files import write_json
        from deltas_nets.evaluate.report import (
            calibration_table,
            metrics_table,
            scores_as_json,
            scores_by_name,
            sparsification_line,
        )
        from deltas_nets.outputs import check_writable

        if (self.capture is None) == (self.rooms is None):
            raise UserError("score what?", "command line", "give a capture, or --rooms N")
        if self.json is not None:
            check_writable(self.json.parent)
        if self.capture is not None:
            scores, title = self._of_capture(self.capture), f"{self.capture}: "
        else:
            scores, title = self._of_rooms(self.rooms or 0), f"rooms, {self.conditions}: "
        title += f"{len(scores.frames)} frames"
        Console().print(metrics_table(scores_by_name(scores), title=title))
        if scores.calibration is not None:
            table = calibration_table(scores.calibration, title="relative errors of dense depth")
            Console().print(table)
            print(sparsification_line(scores.calibration))
        if self.json is not None:
            write_json(self.json, scores_as_json(scores))

    def _of_capture(self, path: Path) -> "CaptureScores":
        from deltas_nets.checked_inputs import check_all, usable_view_sets, with_depth_only
        from deltas_nets.data.capture import open_capture
        from deltas_nets.evaluate.capture import evaluate_files, evaluate_network
        from deltas_nets.outputs import recorded_view_sets
        from deltas_nets.predict import check_asked

        config = self.config()
        capture = open_capture(path)
        if self.predictions is not None and self.view_sets is None:
            view_sets = recorded_view_sets(self.predictions)
        else:
            view_sets = usable_view_sets(capture, self.view_sets, self.views)
        view_sets = with_depth_only(capture, view_sets)
        check_all(capture, view_sets, with_depth=True)
        if self.predictions is not None:
            return evaluate_files(
                self.predictions, capture, view_sets, depth_range=self.depth_range
            )
        network = self.network()
        check_asked(network, config, capture, view_sets)
        with progress("evaluate", len(view_sets)) as report:
            return evaluate_network(network, capture, view_sets, config, report=report)

    def _of_rooms(self, count: int) -> "CaptureScores":
        from deltas_nets.evaluate.rooms import EVALUATION_SEEDS, held_out_rooms, score_rooms
        from deltas_nets.network.deltas import Deltas

        config, views = self.config(), self.views or 3
        for given, name in ((self.view_sets, "--view-sets"), (self.predictions, "--predictions")):
            if given is not None:
                raise UserError("rooms have none", name, "leave it out")
        if not 1 <= count <= len(EVALUATION_SEEDS):
            raise UserError(f"no {count} rooms", "--rooms", f"give 1 to {len(EVALUATION_SEEDS)}")
        if not 2 <= views <= 12:
            raise UserError(f"no rooms of {views} views", "--views", "give 2 to 12")
        network = self.network()
        if not isinstance(network, Deltas):
            what = "the published network has one camera, and rooms have others"
            raise UserError(what, self.weights, "name a capture")
        rooms = held_out_rooms(
            count,
            EVALUATION_SEEDS,
            num_views=views,
            image_size=config.work_size or (288, 384),
            conditions=self.conditions,
        )
        with progress("evaluate", count) as report:
            return score_rooms(network, rooms, depth_range=self.depth_range, report=report)


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


Command = Demo | Depth | Evaluate | Train | Calibrate | Export | Cost


def _parse(arguments: list[str]) -> Command:
    """The command that the arguments name; one line of error where they make no sense."""
    said = io.StringIO()
    preset = preset_of(arguments)
    default = Train(out=Path("runs") / preset, preset=preset, config=TRAIN_CONFIGS[preset])
    train = Annotated[Train, tyro.conf.subcommand(name="train", default=default)]
    try:
        with contextlib.redirect_stderr(said):
            command: Command = tyro.cli(
                Demo | Depth | Evaluate | train | Calibrate | Export | Cost,
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
        # What a config inside the config refused comes with tyro's name for where it is.
        refused = re.fullmatch(r"Value error Error parsing \S+: (.*) For full.*", " ".join(words))
        what = refused[1] if refused else " ".join(words)
        _fail(UserError(what[:200], "command line", _help_of(arguments)))
    return command


def _help_of(arguments: list[str]) -> str:
    commands = ("demo", "depth", "evaluate", "train", "calibrate", "export", "cost")
    known = [word for word in arguments[:1] if word in commands]
    return " ".join(["see deltas", *known, "--help"])


def _fail(error: UserError) -> NoReturn:
    print(f"deltas: {error}", file=sys.stderr)
    sys.exit(2)


if __name__ == "__main__":
    main()
