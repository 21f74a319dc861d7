"""The folder of `deltas depth`: what its maps depend on, compared with what earlier runs made."""

from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from deltas_nets import __version__
from deltas_nets.commands.measuring import MEASURED
from deltas_nets.config import to_dict

if TYPE_CHECKING:
    from deltas_nets.captures.capture import Capture
    from deltas_nets.captures.usable import UsableViews
    from deltas_nets.outputs.folder import OutputFolder
    from deltas_nets.outputs.products import OutputOptions
    from deltas_nets.predict.depth_map import PredictConfig
    from deltas_nets.predict.predictor import Predictor

FOUND_LATER = "work_pixels"
"""Of the config: what a trial finds."""


class Asked(Protocol):
    """What the flags of `deltas depth` say."""

    @property
    def folder(self) -> Path:
        """Where outputs go."""

    @property
    def weights(self) -> str:
        """Of the network."""

    @property
    def precision(self) -> str:
        """Of its numbers."""

    @property
    def views(self) -> int | None:
        """Per map."""

    @property
    def passes_made(self) -> int:
        """Of the maps that hear each other."""

    @property
    def depth_range(self) -> tuple[float, float] | None:
        """That is searched."""

    @property
    def format(self) -> str:
        """Of depth maps."""

    @property
    def overwrite(self) -> bool:
        """Whether to start again."""

    def measured_record(self) -> dict[str, Any]:
        """Of measured depth."""


def asked_settings(
    command: Asked, capture: "Capture", predictor: "Predictor", config: "PredictConfig"
) -> dict[str, Any]:
    """What maps depend on, as far as it is known before anything is looked at."""
    from deltas_nets.outputs.summary import FORMAT

    predict = to_dict(config)
    if command.depth_range is None:
        predict["depth_range"] = "as the capture suggests, frame by frame"
    return {
        "predict": predict,
        "network": predictor.network_record(),
        "weights": predictor.weights_record(command.weights),
        "capture": {"path": capture.path.resolve(), "cameras": capture.fingerprint()},
        "precision": command.precision,
        "views": command.views,
        "passes": command.passes_made,
        **({} if command.format == "png" else {FORMAT: command.format}),
        **command.measured_record(),
    }


def check_settings(
    folder: Path, settings: dict[str, Any], scaled_by: float | None, *, overwrite: bool
) -> None:
    """Refuse a folder that an earlier run filled with other settings, as far as they are known.

    Args:
        folder: of the maps.
        settings: from `asked_settings`.
        scaled_by: what the capture is multiplied with.
        overwrite: what is there may go.

    Raises:
        UserError: names what differs.
    """
    from deltas_nets.outputs.prepare import check_continues
    from deltas_nets.outputs.summary import FORMAT

    if overwrite:
        return
    predict = {name: value for name, value in settings["predict"].items() if name != FOUND_LATER}
    not_asked = {FORMAT: None, MEASURED: None}
    check_continues(folder, {**not_asked, **settings, "predict": predict}, scaled_by)


def prepare_folder(
    command: Asked,
    capture: "Capture",
    views: "UsableViews",
    shard: tuple[int, int],
    options: "OutputOptions",
    predictor: "Predictor",
    config: "PredictConfig",
) -> "OutputFolder":
    """The folder, made or gone on with."""
    import torch

    from deltas_nets.captures.camera_sums import camera_sums
    from deltas_nets.captures.ids import id_in_json
    from deltas_nets.outputs.depth_formats import MILLIMETRES
    from deltas_nets.outputs.prepare import prepare_output
    from deltas_nets.outputs.summary import CAMERA_SUMS, SCALE, view_sets_in_json

    scale = {} if options.depth_scale == MILLIMETRES else {SCALE: options.depth_scale}
    mine = views.view_sets[shard[0] - 1 :: shard[1]]
    return prepare_output(
        command.folder,
        settings={
            **asked_settings(command, capture, predictor, config),
            "view_sets": view_sets_in_json(views.view_sets),
            **scale,
        },
        overwrite=command.overwrite,
        forbidden=capture.path,
        shard=shard,
        frame_ids=[views.anchor for views in mine],
        options=options,
        head={
            "versions": {"deltas-depth": __version__, "torch": torch.__version__},
            "layout": capture.layout,
            "unit": options.unit,
            "scaled_by": capture.scaled_by,
            "depth_scaled_by": capture.depth_scaled_by,
            CAMERA_SUMS: camera_sums(capture.frames),
            "lost_poses": list(map(id_in_json, capture.lost)),
            "sets_short_of_views": views.short,
        },
    )
