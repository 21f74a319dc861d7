"""The `deltas` command. Each subcommand is a dataclass: its fields are the flags.

Nothing heavy is imported before a command runs, so that --help is instant.
"""

import contextlib
import io
import re
import sys
from dataclasses import dataclass, field
from pathlib import Path
from textwrap import shorten
from typing import Annotated, NoReturn, get_args

import tyro

from deltas_nets import __version__
from deltas_nets.cli_calibrate import Calibrate
from deltas_nets.cli_distill import Distill
from deltas_nets.cli_evaluate import Evaluate
from deltas_nets.cli_export import Export
from deltas_nets.cli_prediction import Prediction
from deltas_nets.cli_recipe import Recipe
from deltas_nets.cli_training import Cost, Flag, Train, preset_of
from deltas_nets.config import TRAIN_CONFIGS, to_dict
from deltas_nets.errors import UserError
from deltas_nets.terminal import progress, stopped_like_ctrl_c, warn


@dataclass(frozen=True)
class Demo(Prediction):
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
class Depth(Prediction):
    """Write a metric depth map for every frame of a posed capture.

    The capture is a folder in ScanNet's export layout: color/N.jpg, pose/N.txt,
    intrinsic/intrinsic_color.txt. Writes DIR/depth/N.png (16-bit millimetres),
    DIR/confidence/N.png, DIR/points/N.ply and DIR/summary.json. The network that the authors of the
    paper published states no confidence, so with its checkpoint none is written.

    Example: deltas depth my_capture --out depth --views 5
    """

    capture: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="CAPTURE")] = field(
        kw_only=True
    )
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
            warn_of,
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
        warn_of(capture, view_sets, self.view_sets, self.depth_range)
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
                "precision": self.precision,
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


def main() -> None:
    """Entry point of the `deltas` command."""
    if sys.argv[1:] == ["--version"]:
        print(f"deltas-depth {__version__}")
        return
    command = _parse(sys.argv[1:] or ["--help"])
    try:
        with stopped_like_ctrl_c():
            command.run()
    except UserError as error:
        if command.debug:
            raise
        _fail(error)
    except KeyboardInterrupt:
        print(f"deltas: stopped; {_how_to_go_on(command)}", file=sys.stderr)
        sys.exit(130)


Command = Demo | Depth | Evaluate | Train | Recipe | Distill | Calibrate | Export | Cost


def _parse(arguments: list[str]) -> Command:
    """The command that the arguments name; one line of error where they make no sense."""
    said = io.StringIO()
    preset = preset_of(arguments)
    default = Train(out=Path("runs") / preset, preset=preset, config=TRAIN_CONFIGS[preset])
    train = Annotated[Train, tyro.conf.subcommand(name="train", default=default)]
    try:
        with contextlib.redirect_stderr(said):
            command: Command = tyro.cli(
                Demo | Depth | Evaluate | train | Recipe | Distill | Calibrate | Export | Cost,
                prog="deltas",
                description="Metric depth from posed images.",
                args=arguments,
            )
    except ValueError as error:
        _fail(UserError(str(error), "command line", _help_of(arguments)))
    except SystemExit as stopped:
        if not stopped.code:
            raise
        what = shorten(_in_words(said.getvalue()), 200, placeholder=" ...")
        _fail(UserError(what, "command line", _help_of(arguments)))
    return command


def _in_words(box: str) -> str:
    """What tyro draws a box for, as a line.

    Without the title, which the text below repeats, and the last part, which points to --help.
    """
    inside = [line for line in box.splitlines() if not line.startswith(("╭", "╰"))]
    plain = re.sub(r"\[/?bold\]|│", " ", " ".join(inside))
    parts = [" ".join(part.split()) for part in re.split("─{3,}", plain)]
    said = "; ".join(part for part in parts if part and not part.startswith("For full helptext"))
    # What a config, or one inside it, refused comes with tyro's or Python's name for where it is.
    return re.sub(r"^Error parsing (__tyro\S+|[A-Z]\w+:) ", "", said)


def _how_to_go_on(command: Command) -> str:
    match command:
        case Depth() | Recipe():
            return "the same command goes on"
        case Train():
            return "the same command with --resume goes on"
        case _:
            return "start it again"


def _help_of(arguments: list[str]) -> str:
    names = {command.__name__.lower() for command in get_args(Command)}
    known = [word for word in arguments[:1] if word in names]
    return " ".join(["see deltas", *known, "--help"])


def _fail(error: UserError) -> NoReturn:
    print(f"deltas: {error}", file=sys.stderr)
    sys.exit(2)


if __name__ == "__main__":
    main()
