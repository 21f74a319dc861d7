"""The command `deltas depth`."""

import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import tyro

from deltas_nets import __version__
from deltas_nets.commands.flags import Flag, Prediction, sensible
from deltas_nets.config import to_dict
from deltas_nets.errors import UserError
from deltas_nets.terminal import progress, warn


def read_shard(text: str) -> tuple[int, int]:
    """I and N of ``--shard I/N``.

    Raises:
        UserError: it is not of that form, or I is not among 1 to N.
    """
    match = re.fullmatch(r"(\d+)/(\d+)", text)
    if match is None or not 1 <= int(match[1]) <= int(match[2]):
        raise UserError("not a shard", f"--shard {text}", "use I/N with 1 <= I <= N, as 2/4")
    return int(match[1]), int(match[2])


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
    depth_scale: float = 1000.0
    """Steps of depth/N.png in a metre: 1000 are millimetres, up to 65.5 m; 100 reach 655 m."""
    size: Annotated[tuple[int, int] | None, tyro.conf.arg(metavar="HEIGHT WIDTH")] = None
    """Size of the maps; the colour image's if not given."""
    min_confidence: float = 0.0
    """Leave out pixels of less confidence, 0 to 1."""
    shard: str = "1/1"
    """I/N: this run does every N-th frame from the I-th, for N runs at once."""
    overwrite: Flag = False
    """Start again instead of continuing, or write into a folder that holds other things."""

    going_on = "the same command goes on"

    def run(self) -> None:
        """Run the command."""
        import torch

        from deltas_nets.captures.ids import id_in_json
        from deltas_nets.captures.opening import open_capture
        from deltas_nets.captures.usable import check_all, usable_view_sets, warn_of
        from deltas_nets.outputs.folder import prepare_output
        from deltas_nets.outputs.products import MILLIMETRES, OutputOptions, check_depth_fits
        from deltas_nets.outputs.summary import SCALE, SUMMARY, read_summary, view_sets_in_json
        from deltas_nets.predict.capture import predict_capture

        shard = read_shard(self.shard)
        config = self.config(size=self.size, min_confidence=self.min_confidence)
        options = sensible(OutputOptions, depth_scale=self.depth_scale)
        check_depth_fits(self.depth_range, options)
        capture = open_capture(self.capture).remembering()
        view_sets = usable_view_sets(capture, self.view_sets, self.views)
        check_all(capture, view_sets)
        warn_of(capture, view_sets, self.view_sets, self.depth_range)
        predictor = self.predictor()
        predictor.check_asked(config, capture, view_sets)
        mine = view_sets[shard[0] - 1 :: shard[1]]
        scale = {} if self.depth_scale == MILLIMETRES else {SCALE: self.depth_scale}
        folder = prepare_output(
            self.out,
            settings={
                "predict": to_dict(config),
                "network": predictor.network_record(),
                "weights": predictor.weights_record(self.weights),
                "capture": {"path": capture.path.resolve(), "cameras": capture.fingerprint()},
                "precision": self.precision,
                "views": self.views,
                "view_sets": view_sets_in_json(view_sets),
                **scale,
            },
            overwrite=self.overwrite,
            forbidden=capture.path,
            shard=shard,
            frame_ids=[views.anchor for views in mine],
            options=replace(options, confidence=predictor.states_confidence),
            head={
                "versions": {"deltas-depth": __version__, "torch": torch.__version__},
                "lost_poses": list(map(id_in_json, capture.lost)),
            },
        )
        with progress("depth", len(mine)) as report:
            outcome = predict_capture(predictor, capture, mine, folder, config, report=report)
        kept = f", {outcome.kept} kept from an earlier run" if outcome.kept else ""
        print(f"{outcome.written} depth maps in {self.out}{kept}")
        if not predictor.states_confidence:
            print("no confidence is written: the reference network states none")
        if outcome.blind:
            warn(f"{outcome.blind} maps without a triangulated point are guesses: see summary.json")
        saturated = sum("saturated_pixels" in record for record in folder.frames.values())
        if saturated:
            most = f"{options.max_depth:g} m"
            warn(
                f"{saturated} maps have depth beyond {most} that is written as {most}: add "
                f"--depth-scale {self.depth_scale / 10:g}; see summary.json"
            )
        waiting = (read_summary(self.out / SUMMARY) or {}).get("waiting_for", ())
        if waiting:
            print(f"the folder is complete after --shard {', '.join(waiting)}")
