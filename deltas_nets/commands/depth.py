"""The command `deltas depth`."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import tyro

from deltas_nets.commands.depth_folder import asked_settings, check_settings, prepare_folder
from deltas_nets.commands.depth_options import (
    asked_options,
    fitting_options,
    look_first,
    maps_at_once,
)
from deltas_nets.commands.depth_telling import show, tell
from deltas_nets.commands.flags import Captured, Flag, Prediction, folder_for
from deltas_nets.commands.fuse import fuse_maps
from deltas_nets.commands.measuring import Measuring
from deltas_nets.commands.values import at_least_one, read_shard
from deltas_nets.outputs.alone import Written
from deltas_nets.terminal import progress, warn

if TYPE_CHECKING:
    from deltas_nets.captures.capture import Capture
    from deltas_nets.captures.measured import Measured
    from deltas_nets.captures.view_sets import ViewSet
    from deltas_nets.predict.depth_map import PredictConfig
    from deltas_nets.predict.predictor import Predictor
    from deltas_nets.predict.search import Search


@dataclass(frozen=True)
class Depth(Captured, Measuring, Prediction):
    """Write a depth map for every frame of a posed capture.

    The capture is a COLMAP model with its photos, a transforms.json, a phone's or a tracker's
    export, or frames.json of your own: docs/captures.md lists them all. Writes DIR/depth/ID.png
    (16-bit millimetres), DIR/confidence/ID.png, DIR/points/ID.ply, DIR/summary.json, and
    DIR/index.html to look at. Where the capture has no metres, neither have these: they are in its
    own unit, as the summary says. The network that the authors of the paper published states no
    confidence, so with its checkpoint none is written.

    Example: deltas depth my_capture --views 5
    """

    capture: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="CAPTURE")] = field(
        kw_only=True
    )
    """Folder with images, poses and intrinsics, or a file that names them."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Folder to write to, CAPTURE-depth here if not given; the same command continues a run that
    was stopped."""
    depth_range: Annotated[tuple[float, float] | None, tyro.conf.arg(metavar="NEAR FAR")] = None
    """Nearest and farthest depth searched, in the capture's unit. If not given it follows from the
    capture for each frame: its ranges, its sparse points, or a first look; 0.5 10 in rooms."""
    view_sets: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """JSON: [{"anchor": 10, "sources": [8, 12]}, ...], here or in the capture; chosen by angle and
    overlap if not given."""
    views: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Views per depth map, the anchor included; all of the view sets', or 5, if not given."""
    keyframes: Flag = False
    """Of a video: maps of those frames alone that see something new."""
    format: Literal["png", "npz", "tiff", "pfm"] = "png"
    """Of depth maps: png holds 16-bit steps, the others float32 in the capture's unit."""
    depth_scale: Annotated[float | None, tyro.conf.arg(metavar="STEPS")] = None
    """Steps of depth/ID.png in a unit: 1000 in a metre, which reaches 65.5 m, if not given; of a
    capture without metres so many that they are fine enough. The summary states it."""
    size: Annotated[tuple[int, int] | None, tyro.conf.arg(metavar="HEIGHT WIDTH")] = None
    """Size of the maps; the colour image's if not given."""
    min_confidence: float = 0.0
    """Leave out pixels of less confidence, 0 to 1."""
    passes: int = 3
    """From the second on each map hears those of the frames around it, where three or more agree on
    a place, and those of sources that get no map themselves; 1 is the network alone."""
    workers: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Maps computed at once, each by one thread; as many as there are cores if not given."""
    mesh: Flag = False
    """Fuse the maps at the end: mesh.ply in the folder; `deltas fuse` has more options."""
    cloud: Flag = False
    """The same: cloud.ply."""
    page: bool = True
    """Also write index.html to look at, contact_sheet.jpg and preview/ID.jpg."""
    shard: str = "1/1"
    """I/N: this run does every N-th frame from the I-th, for N runs at once; in later passes it
    hears no map that another run writes."""
    overwrite: Flag = False
    """Start again instead of continuing, or write into a folder that holds other things."""

    groups: ClassVar = {
        "the capture": ("CAPTURE", "--intrinsics", "--scale", "--scale-from"),
        "what is written": (
            "--out", "--size", "--format", "--depth-scale", "--min-confidence", "--mesh",
            "--cloud", "--page", "--overwrite",
        ),
        "how depth is searched": (
            "--depth-range", "--views", "--view-sets", "--keyframes", "--passes",
            "--sensor-depth", "--sensor-deviation",
        ),
        "the network, and how fast": (
            "--weights", "--work-size", "--precision", "--device", "--workers", "--shard",
        ),
    }  # fmt: skip
    checks: ClassVar = {"workers": at_least_one}

    @property
    def written(self) -> Written:
        """What no other run may write meanwhile."""
        return Written(self.folder, "depth", "" if self.shard == "1/1" else self.shard)

    def run(self) -> None:
        """Run the command."""
        from deltas_nets.captures.companions import companions
        from deltas_nets.captures.keyframes import keyframes
        from deltas_nets.captures.sets_file import sets_file
        from deltas_nets.captures.usable import check_all, lone_frames, usable_view_sets, warn_of
        from deltas_nets.captures.view_sets import read_view_sets
        from deltas_nets.check.quick import TOLD_BEFORE, quick_findings
        from deltas_nets.outputs.prepare import check_place
        from deltas_nets.predict.capture import predict_capture
        from deltas_nets.predict.depth_map import ENLARGED

        shard = read_shard(self.shard)
        config = self.config(size=self.size, min_confidence=self.min_confidence, enlarged=ENLARGED)
        options = asked_options(self.depth_scale, self.format)
        capture = self.opened(self.capture).remembering()
        check_place(self.folder, overwrite=self.overwrite, forbidden=capture.path)
        predictor = self.predictor()
        self.check_measuring(predictor, capture)
        capture = self.in_metres(capture, predictor, config)
        measured = self.measured(capture)
        # What is wrong is told before any look, as far as it is known by now.
        asked = asked_settings(self, capture, predictor, config)
        check_settings(self.folder, asked, capture.scaled_by, overwrite=self.overwrite)
        if self.view_sets is not None:
            file = sets_file(self.view_sets, capture.path)
            read_view_sets(file, capture, allow_no_sources=self.views == 1)
        if self.depth_range is not None and capture.metric:
            fitting_options(options, capture, None, self.depth_scale, self.depth_range)
        depth = None
        if self.views != 1 or not capture.metric:  # nothing is searched, and no unit to be found
            depth = look_first(predictor, capture, config, self.workers, self.device)
        few = keyframes(capture, working_depth=depth) if self.keyframes else None
        if self.views == 1:
            found = lone_frames(capture, self.view_sets, few)
        else:
            found = usable_view_sets(
                capture, self.view_sets, self.views, working_depth=depth, anchors=few
            )
        check_all(capture, found.view_sets)
        if self.views != 1:
            warn_of(capture, found.view_sets, self.view_sets, self.range)
        for finding in quick_findings(capture):
            if finding.cause not in TOLD_BEFORE:
                warn(f"{finding.cause.value} ({finding.evidence}): {finding.cure}")
        options = fitting_options(options, capture, depth, self.depth_scale, self.depth_range)
        options = replace(options, confidence=predictor.states_confidence)
        predictor.check_asked(config, capture, found.view_sets)
        mine = found.view_sets[shard[0] - 1 :: shard[1]]
        anchors = [views.anchor for views in found.view_sets]
        heard = (
            companions(capture, mine, working_depth=depth, elsewhere=anchors)
            if self.passes_made > 1
            else ()
        )
        search = self._search(capture, measured, depth, [views.anchor for views in mine])
        threads = self._threads(len(mine))
        config = self._sized(config, predictor, capture, found.view_sets, search, threads)
        folder = prepare_folder(self, capture, found, shard, options, predictor, config)
        outcome = predict_capture(
            predictor,
            capture,
            mine,
            folder,
            config,
            heard=heard,
            search=search,
            short=found.short,
            passes=self.passes_made,
            threads=threads,
            progress=progress,
        )
        tell(outcome, folder, options, self.format)
        if self.mesh or self.cloud:
            wanted = {"mesh": self.mesh, "cloud": self.cloud, "overwrite": self.overwrite}
            fuse_maps(capture, self.folder, device=self.device, **wanted)
        if self.page:
            show(capture, self.folder, self.range)

    def _search(
        self,
        capture: "Capture",
        measured: "Measured | None",
        depth: float | None,
        anchors: list[str],
    ) -> "Search":
        from deltas_nets.predict.search import Asked, Completed, Followed

        self.check_whole(capture, anchors)
        if self.views == 1:
            assert measured is not None  # or the flag would have been refused
            self.check_completes(measured, capture, anchors)
            return Completed(capture, measured)
        if self.depth_range is None:
            return Followed(capture, measured, as_rooms=depth is None)
        return Asked(capture, self.depth_range, measured)

    def _sized(
        self,
        config: "PredictConfig",
        predictor: "Predictor",
        capture: "Capture",
        view_sets: Sequence["ViewSet"],
        search: "Search",
        threads: int,
    ) -> "PredictConfig":
        """With the size at which the network is surest, unless one is given or depth is.

        A folder that has maps keeps what was chosen for them.
        """
        from deltas_nets.outputs.summary import recorded_pixels
        from deltas_nets.predict.trial import TRIED, surest_config

        if self.work_size is not None or self.views == 1 or self.sensor_depth is not None:
            return config
        known = None if self.overwrite else recorded_pixels(self.folder)
        if known is not None:
            return replace(config, work_pixels=known)
        count = min(TRIED, len(view_sets))
        with progress("size of images", count) as report:
            found = surest_config(
                predictor, capture, view_sets, config, search, threads=threads, report=report
            )
        if found != config:
            print("larger images are as sure: maps take longer (--work-size)")
        return found

    def _threads(self, maps: int) -> int:
        """Maps at once of those that are written."""
        count = maps_at_once(maps, self.workers, self.device)
        if self.workers is None and count > 1:
            print(f"{count} maps at a time, a core each (--workers)")
        return count

    @property
    def going_on(self) -> str:
        """With --overwrite what is finished would be removed again."""
        without = ", without --overwrite once maps are written" if self.overwrite else ""
        return f"the same command goes on{without}"

    @property
    def passes_made(self) -> int:
        """Maps that rest on one image alone hear no others."""
        return 1 if self.views == 1 else self.passes

    @property
    def folder(self) -> Path:
        """Where outputs go."""
        return self.out or folder_for(self.capture, "depth")
