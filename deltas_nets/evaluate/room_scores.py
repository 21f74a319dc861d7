"""Any network's scores on procedural rooms, each of which it sees as a capture in files."""

from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from PIL import Image

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.opening import open_capture
from deltas_nets.captures.posed_images import PosedImages
from deltas_nets.captures.view_sets import ViewSet
from deltas_nets.errors import UserError
from deltas_nets.evaluate.calibration import CalibrationMeter
from deltas_nets.evaluate.capture import Scoring, score_view_set
from deltas_nets.evaluate.rooms import RoomViews, in_order
from deltas_nets.evaluate.scores import CaptureScores, MapScores, mean_scores
from deltas_nets.predict.depth_map import PredictConfig
from deltas_nets.predict.predictor import Predictor

__all__ = ["room_in_files", "score_rooms"]


def score_rooms(
    predictor: Predictor,
    rooms: RoomViews,
    config: PredictConfig,
    *,
    report: Callable[[str], None] = lambda _: None,
) -> CaptureScores:
    """Score the maps of all rooms, view 0 of each as anchor; rooms are named by their number.

    Args:
        predictor: a network or a baseline.
        rooms: to score on.
        config: as for prediction.
        report: called with the number of every finished room.

    Raises:
        UserError: it cannot do what is asked, all rooms fail, or none has true depth in range.
    """
    meter, scoring = CalibrationMeter(), Scoring(config.depth_range)
    scores: dict[str, MapScores | None] = {}
    failed: dict[str, UserError] = {}
    for number, room in enumerate(in_order(rooms)):
        with TemporaryDirectory() as folder:
            capture = room_in_files(room, Path(folder) / str(number))
            assert capture.sources is not None  # its key has some
            views = ViewSet("key", capture.sources["key"])
            predictor.check_asked(config, capture, [views])
            try:
                score = score_view_set(predictor, capture, views, config, scoring, meter)
                scores[str(number)] = score
            except UserError as error:
                # The folder is gone when this is read.
                failed[str(number)] = UserError(error.what, f"room {number}", error.remedy)
        report(str(number))
    if failed and not scores:
        raise next(iter(failed.values()))
    if all(score is None for score in scores.values()):
        what = "no room has true depth in range"
        raise UserError(what, "--depth-range", "give another range")
    calibration = None if meter.empty else meter.result()
    return mean_scores(scores, calibration, failed={id: str(e) for id, e in failed.items()})


def room_in_files(room: PosedImages, folder: Path) -> Capture:
    """A room as a sample of the Robust MVD benchmark, whose frames lose nothing in files.

    Args:
        room: images uint8 ``(V, 3, H, W)``, cameras, depth ``(V, H, W)`` metres.
        folder: is made; view 0 is its key.

    Returns:
        The capture, of frames key, 1, 2, ...
    """
    in_world = room.views.cam_from_world.double()
    for view, of_view in enumerate(in_world @ in_world[0].inverse()):
        place = folder / (f"source/{view}" if view else "key")
        place.mkdir(parents=True)
        pixels = np.ascontiguousarray(room.images[view].permute(1, 2, 0).numpy())
        Image.fromarray(pixels).save(place / "image.png", compress_level=1)
        np.save(place / "K.npy", room.views.K[view].double().numpy())
        np.save(place / "to_ref_transform.npy", of_view.numpy())
        np.save(place / "depth.npy", room.depth[view].numpy())
    return open_capture(folder)
