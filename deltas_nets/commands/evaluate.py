"""The command `deltas evaluate`."""

import math
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import tyro

from deltas_nets.commands.evaluate_flags import warn_of, warn_of_maps, without_effect
from deltas_nets.commands.flags import Flag, Prediction
from deltas_nets.commands.unused import refuse_unused
from deltas_nets.commands.values import at_least_one
from deltas_nets.config.varied import NetworkSettings
from deltas_nets.errors import UserError
from deltas_nets.extras import usable_device
from deltas_nets.terminal import counted, progress, table_console, warn

if TYPE_CHECKING:
    from deltas_nets.evaluate.dataset import DatasetScores
    from deltas_nets.evaluate.protocols.view_protocol import ViewProtocol
    from deltas_nets.predict.predictor import Predictor


@dataclass(frozen=True)
class Evaluate(Prediction):
    """Score depth against sensor depth, of one scene or many, or on rooms: the paper's metrics.

    Of networks that state a standard deviation also: how much smaller the error of the half of each
    map is that is most certain, and predicted against true errors. What fails is counted and named,
    and the exit code is 1 then. docs/evaluation.md has the protocols and the metrics.

    Example: deltas evaluate my_capture --views 3 --json scores.json
    """

    captures: Annotated[
        tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="[CAPTURE ...]")
    ] = field(default=(), kw_only=True)
    """Folders with images, poses, intrinsics and depth/N.png, or folders of such scenes."""
    scenes: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """A scene on each line, relative to the folder that is named, or to the file's."""
    data: Annotated[Literal["scannet"] | None, tyro.conf.arg(metavar="scannet")] = None
    """The folder that is named holds ScanNet; --split says which of its scenes."""
    split: Annotated[str, tyro.conf.arg(metavar="NAME-OR-FILE")] = "test"
    """Of --data scannet: test (scene0707 to scene0806), train, all, or a file of names."""
    rooms: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Instead of a capture: the first N, at most 500, of the procedural rooms that neither training
    nor calibration sees, at --work-size, 288 384 if not given."""
    conditions: Literal["ideal", "real"] = "real"
    """Of rooms: ideal is as rendered, real has blur, noise and usual pose errors."""
    protocol: Literal["chosen", "paper", "deepvideomvs"] = "chosen"
    """Which views go together: as deltas depth chooses; the paper's sequences of a fixed gap;
    DeepVideoMVS's key frames."""
    view_sets: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """JSON: [{"anchor": 10, "sources": [8, 12]}, ...]; of several scenes, a file in each."""
    views: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Views per depth map, the anchor included; 3 of rooms and protocols if not given."""
    sets: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """So many view sets of each scene, spread over all; every one if not given."""
    gap: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Of --protocol paper: frames from one view to the next; the paper's for its number of views if
    not given (20 for 2 and 3, 15, 12, 10 for 4, 5, 7)."""
    every: Annotated[int, tyro.conf.arg(metavar="N")] = 20
    """Of --protocol paper: anchors are frames whose number it divides."""
    settings: Annotated[NetworkSettings, tyro.conf.arg(name="")] = field(
        default_factory=NetworkSettings
    )
    """What the paper's supplement varies."""
    predictions: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Score the maps that `deltas depth` wrote here instead of predicting; of several scenes, in a
    folder for each."""
    truth_size: Literal["map", "own"] = "map"
    """Score at the pixels of the map, or at the sensor's own, which are the same for maps of any
    size."""
    consistency: Flag = False
    """Also compare the maps of a scene with each other."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Also write everything to this file."""
    csv: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Also write a row for each frame to this file."""

    checks: ClassVar[Mapping[str, Callable[[Any, str], object]]] = {
        "gap": at_least_one,
        "sets": at_least_one,
        "every": at_least_one,
    }

    def run(self) -> None:
        """Run the command."""
        from deltas_nets.outputs.atomic_files import check_file

        self._check_what()
        for file in (self.json, self.csv):
            if file is not None:
                check_file(file)
        scores, title = self._of_rooms() if self.rooms is not None else self._of_scenes()
        self._write(scores)  # before the reader of what is printed may have had enough
        self._print(scores, title)
        if self.predictions is not None:
            warn_of_maps(scores.total)
        if scores.failures:
            failed = {**scores.total.failed, **scores.failed}
            said = f"frames and scenes that failed: {scores.failures}; the first, "
            warn(said + ": ".join(next(iter(failed.items()))))
            sys.exit(1)

    def _check_what(self) -> None:
        """Refuse flags that contradict each other."""
        where = "command line"
        if not self.captures and self.scenes is None and self.rooms is None:
            raise UserError("score what?", where, "give a capture, or --rooms N")
        if (self.captures or self.scenes is not None) and self.rooms is not None:
            what = "a capture and rooms are not scored together"
            raise UserError(what, where, f"leave out --rooms or {(*self.captures, '--scenes')[0]}")
        if self.data is not None and (len(self.captures) != 1 or self.scenes is not None):
            what = "a data set is one folder"
            raise UserError(what, f"--data {self.data}", "name the folder that holds scans_test")
        if self.protocol != "chosen" and self.view_sets is not None:
            what = "view sets come from a file or by a protocol"
            raise UserError(what, f"--protocol {self.protocol}", "leave out it or --view-sets")
        if self.predictions is not None and self.settings.given():
            what = "maps are there already, whatever the settings"
            raise UserError(what, "--predictions", "leave it out, or the settings")
        chosen = self.view_sets is None and self.protocol == "chosen"
        wanted = without_effect(
            scannet=self.data is not None,
            rooms=self.rooms is not None,
            paper=self.protocol == "paper",
            maps=self.predictions is not None,
            recorded_sets=self.predictions is not None and chosen,
        )
        refuse_unused(self, wanted)

    def _of_scenes(self) -> tuple["DatasetScores", str]:
        from deltas_nets.evaluate.dataset import evaluate_scenes
        from deltas_nets.evaluate.scenes import named_scenes, scenes_of_split

        if self.data is not None:
            scenes = scenes_of_split(self.captures[0], self.split)
        else:
            scenes = named_scenes(self.captures, self.scenes)
        many = len(scenes) > 1

        def protocol(name: str, path: Path) -> "ViewProtocol":
            return self._protocol(name, path, many=many)

        scorer = self._scorer(many=many)
        scores = evaluate_scenes(scenes, protocol, scorer, depth_range=self.range)
        one = str((*self.captures, *scenes.values())[0])
        return scores, counted(len(scenes), "scene") if many else one

    def _protocol(self, name: str, path: Path, *, many: bool) -> "ViewProtocol":
        from deltas_nets.evaluate.protocols.view_protocol import ViewProtocol

        file = self.view_sets
        if file is not None and many:
            file = path / file
        predictions = self.predictions
        if predictions is not None and many:
            predictions = predictions / name
        return ViewProtocol(
            self.protocol, self.views, self.gap, self.every, file, predictions, self.sets
        )

    def _scorer(self, *, many: bool) -> Any:
        """What scores a scene: the network, or maps in files."""
        from deltas_nets.captures.capture import Capture
        from deltas_nets.evaluate.calibration import CalibrationMeter
        from deltas_nets.evaluate.capture import Scoring, evaluate_files, evaluate_network
        from deltas_nets.evaluate.protocols.view_protocol import SceneViews
        from deltas_nets.evaluate.scores import CaptureScores

        config = self.config()
        scoring = Scoring(self.range, self.truth_size, self.consistency)
        predictor = None if self.predictions is not None else self.network

        def score(
            name: str, capture: Capture, views: SceneViews, meter: CalibrationMeter
        ) -> CaptureScores:
            sets = views.view_sets
            folder = self.predictions
            folder = folder / name if folder is not None and many else folder
            warn_of(name, capture, folder)
            with progress(f"evaluate {name}" if many else "evaluate", len(sets)) as report:
                if predictor is not None:
                    predictor.check_asked(config, capture, sets)
                    return evaluate_network(
                        predictor, capture, sets, config, scoring, meter=meter, report=report
                    )
                assert folder is not None
                return evaluate_files(folder, capture, sets, scoring=scoring, report=report)

        return score

    @cached_property
    def network(self) -> "Predictor":
        """The network, under the settings that are given; loaded when it is first asked for."""
        network = self.predictor()
        return network.varied(self.settings) if self.settings.given() else network

    def _of_rooms(self) -> tuple["DatasetScores", str]:
        from deltas_nets.evaluate.dataset import DatasetScores
        from deltas_nets.evaluate.protocols.view_protocol import VERSION, SceneViews
        from deltas_nets.evaluate.room_scores import score_rooms
        from deltas_nets.evaluate.rooms import EVALUATION_SEEDS, held_out_rooms

        config, views, count = self.config(), self.views or 3, self.rooms or 0
        for name in ("view_sets", "sets", "predictions"):
            if getattr(self, name) is not None:
                flag = f"--{name.replace('_', '-')}"
                raise UserError("rooms have none", flag, "leave it out")
        if self.protocol != "chosen" or self.consistency or self.truth_size != "map":
            what = "rooms are sets of views, each by itself, with truth at every pixel"
            raise UserError(what, "--rooms", "leave out --protocol, --consistency, --truth-size")
        if not 1 <= count <= len(EVALUATION_SEEDS):
            raise UserError(f"no {count} rooms", "--rooms", f"give 1 to {len(EVALUATION_SEEDS)}")
        if not 2 <= views <= 12:
            raise UserError(f"no rooms of {views} views", "--views", "give 2 to 12")
        rooms = held_out_rooms(
            count,
            EVALUATION_SEEDS,
            num_views=views,
            image_size=config.work_size or (288, 384),
            conditions=self.conditions,
        )
        with progress("evaluate", count) as report:
            scores = score_rooms(self.network, rooms, config, report=report)
        rule = {"name": "rooms", "version": VERSION, "views": views, "conditions": self.conditions}
        found = SceneViews((), rule)
        return DatasetScores({"rooms": scores}, {"rooms": found}, {}, scores), (
            f"rooms, {self.conditions}"
        )

    def _print(self, scores: "DatasetScores", title: str) -> None:
        from deltas_nets.evaluate import report

        console, total = table_console(), scores.total
        if len(scores.scenes) + len(scores.failed) > 1:
            console.print(report.scenes_table(scores, title="scenes, means over frames"))
        title = f"{title}: {counted(len(total.frames), 'frame')}"
        columns = report.scores_by_name(total)
        console.print(report.metrics_table(columns, title=title, metric=total.metric))
        if total.sparse is not None and math.isnan(total.sparse.abs_rel):
            print(
                "no triangulated point lies where depth is measured: are poses and depth in the "
                "same unit? deltas check tells"
            )
        if total.calibration is not None:
            heading = "relative errors of dense depth"
            console.print(report.calibration_table(total.calibration, title=heading))
            print(report.sparsification_line(total.calibration))
        if total.ause is not None:
            print(f"area under the sparsification error (AUSE, Abs Rel): {total.ause:.3f}")
        for name, scene in scores.scenes.items():
            if scene.consistency is not None:
                line = report.consistency_line(scene.consistency)
                print(f"{name}: {line}" if len(scores.scenes) > 1 else line)

    def _write(self, scores: "DatasetScores") -> None:
        from deltas_nets.evaluate.record import command_line
        from deltas_nets.evaluate.results import How, write_csv, write_scores

        if self.csv is not None:
            write_csv(self.csv, scores)
        if self.json is not None:
            how = How(self._how(), command_line(), self._weights_record(scores), self._device())
            write_scores(self.json, scores, how)

    def _how(self) -> dict[str, Any]:
        """What decides the figures besides data, views and weights."""
        from deltas_nets.evaluate.results import METRICS_VERSION

        given = {"settings": self.settings.given(), "precision": self.precision}
        return {
            "metrics_version": METRICS_VERSION,
            "depth_range": list(self.range),
            "truth_size": self.truth_size,
            "alignments": "none; median; scale and shift by least squares in depth",
            "work_size": None if self.work_size is None else list(self.work_size),
            **({"predictions": "maps in files"} if self.predictions is not None else given),
        }

    def _weights_record(self, scores: "DatasetScores") -> dict[str, Any]:
        from deltas_nets.outputs.summary import SUMMARY, read_summary

        if self.predictions is None:
            network = {"network": self.network.network_record()}
            return {self.weights: network | self.network.weights_record(self.weights)}
        folders = [self.predictions, *(self.predictions / name for name in scores.scenes)]
        summaries = filter(None, (read_summary(folder / SUMMARY) for folder in folders))
        settings = next(summaries, {}).get("settings", {})
        said = {key: settings[key] for key in ("network", "weights") if key in settings}
        return {self.predictions.name: said}

    def _device(self) -> str:
        return "cpu" if self.predictions is not None else usable_device(self.device)
