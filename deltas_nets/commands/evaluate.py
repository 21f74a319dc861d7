"""The command `deltas evaluate`."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from deltas_nets.commands.flags import Prediction
from deltas_nets.errors import UserError
from deltas_nets.terminal import progress, warn

if TYPE_CHECKING:
    from deltas_nets.evaluate.scores import CaptureScores


@dataclass(frozen=True)
class Evaluate(Prediction):
    """Score depth against a capture's sensor depth, or on rooms: the paper's metrics.

    Of networks that state a standard deviation also: how much smaller the error of the half of each
    map is that is most certain, and predicted against true errors.

    Example: deltas evaluate my_capture --views 3 --json scores.json
    """

    capture: Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="[CAPTURE]")] = (
        field(default=None, kw_only=True)
    )
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
        """Run the command."""
        from rich.console import Console

        from deltas_nets.evaluate.report import (
            calibration_table,
            metrics_table,
            scores_as_json,
            scores_by_name,
            sparsification_line,
        )
        from deltas_nets.outputs.atomic_files import check_writable, write_json

        if self.capture is None and self.rooms is None:
            raise UserError("score what?", "command line", "give a capture, or --rooms N")
        if self.capture is not None and self.rooms is not None:
            what = "a capture and rooms are not scored together"
            raise UserError(what, "command line", f"leave out --rooms or {self.capture}")
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
        from deltas_nets.captures.opening import open_capture
        from deltas_nets.captures.usable import (
            check_all,
            usable_view_sets,
            warn_of,
            with_depth_only,
        )
        from deltas_nets.evaluate.capture import evaluate_files, evaluate_network
        from deltas_nets.outputs.summary import SUMMARY, read_summary, recorded_view_sets

        config = self.config()
        capture = open_capture(path).remembering()
        if self.predictions is not None and self.view_sets is None:
            view_sets = recorded_view_sets(self.predictions)
        else:
            view_sets = usable_view_sets(capture, self.view_sets, self.views).view_sets
        warn_of(capture, view_sets, self.view_sets or self.predictions, self.range)
        view_sets = with_depth_only(capture, view_sets)
        check_all(capture, view_sets, with_depth=True)
        if self.predictions is not None:
            settings = (read_summary(self.predictions / SUMMARY) or {}).get("settings", {})
            if settings.get("sensor_depth", {}).get("from") == "sensor":
                warn("the maps were made with the sensor depth that they are scored against")
            return evaluate_files(self.predictions, capture, view_sets, depth_range=self.range)
        predictor = self.predictor()
        predictor.check_asked(config, capture, view_sets)
        with progress("evaluate", len(view_sets)) as report:
            return evaluate_network(predictor, capture, view_sets, config, report=report)

    def _of_rooms(self, count: int) -> "CaptureScores":
        from deltas_nets.evaluate.rooms import EVALUATION_SEEDS, held_out_rooms, score_rooms

        config, views = self.config(), self.views or 3
        for given, name in ((self.view_sets, "--view-sets"), (self.predictions, "--predictions")):
            if given is not None:
                raise UserError("rooms have none", name, "leave it out")
        if not 1 <= count <= len(EVALUATION_SEEDS):
            raise UserError(f"no {count} rooms", "--rooms", f"give 1 to {len(EVALUATION_SEEDS)}")
        if not 2 <= views <= 12:
            raise UserError(f"no rooms of {views} views", "--views", "give 2 to 12")
        what = "the reference network has one camera, and rooms have others"
        model = self.predictor().deltas(what, self.weights, "name a capture")
        rooms = held_out_rooms(
            count,
            EVALUATION_SEEDS,
            num_views=views,
            image_size=config.work_size or (288, 384),
            conditions=self.conditions,
        )
        with progress("evaluate", count) as report:
            return score_rooms(model, rooms, depth_range=self.range, report=report)
