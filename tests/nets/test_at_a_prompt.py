"""What a person at a prompt meets: completion, how objects print, and slips of arguments."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import deltas_nets
from deltas_geom import PosedViews
from deltas_nets import Deltas, NetworkConfig, load_model, load_predictor
from deltas_nets.captures.frame import Frame
from deltas_nets.captures.frames import Frames
from deltas_nets.captures.saving import save_capture
from deltas_nets.captures.view_choice import choose_view_sets
from deltas_nets.check.verdict import check_capture
from deltas_nets.errors import UserError
from deltas_nets.network.known_depth import KnownDepth
from deltas_nets.outputs.their_capture import made_of
from deltas_nets.predict.depth_map import PredictConfig
from deltas_nets.predict.look import look
from deltas_nets.predict.reach import Reach
from deltas_nets.predict.search import Asked, Followed

K, POSES = torch.eye(3).expand(2, 3, 3), torch.eye(4).expand(2, 4, 4)
KNOWN = KnownDepth(torch.ones(1, 4, 4), torch.ones(1, 4, 4))


def test_completion_offers_what_the_package_has() -> None:
    assert set(deltas_nets.__all__) <= set(dir(deltas_nets))
    assert all(getattr(deltas_nets, name) for name in deltas_nets.__all__)


@pytest.mark.parametrize(
    ("count", "shown"),
    [(0, "Frames(0)"), (2, "Frames(2: '0', '1')"), (9, "Frames(9: '0', '1', '2', ..., '8')")],
)
def test_frames_print_their_ids(count: int, shown: str) -> None:
    def frame(id: int) -> Frame:
        return Frame(str(id), Path(f"{id}.jpg"), (4, 6), np.eye(3), np.eye(4))

    frames = Frames.of(map(frame, range(count)))
    assert repr(frames) == shown and frames.get("nine") is None
    number: Any = 0
    with pytest.raises(KeyError, match=r"no frame has the id 0; Capture\.frame takes numbers"):
        frames[number]


@pytest.mark.parametrize(
    ("name", "shown"),
    [("deltas-small", "DeltasPredictor(deltas-small)"), ("plane-sweep", "PlaneSweep(plane-sweep)")],
)
def test_networks_print_their_names(name: str, shown: str) -> None:
    assert repr(load_predictor(name)) == shown


@pytest.mark.parametrize("views", [K, (K, POSES), None])
def test_cameras_that_are_no_views_are_told(views: Any) -> None:
    model = Deltas(NetworkConfig())
    with pytest.raises(TypeError, match=r"views must be PosedViews, got .*: use PosedViews\(K"):
        model(torch.rand(2, 3, 32, 32), views)
    with pytest.raises(ValueError, match=r"for one K of all views pass K.expand\(2, 3, 3\)"):
        model(torch.rand(2, 3, 32, 32), PosedViews(K[0], POSES))


@pytest.mark.parametrize("tolerance", [0.0, -0.05, float("nan")])
def test_no_probability_is_negative_or_nan(tolerance: float) -> None:
    with pytest.raises(ValueError, match="tolerance must be a positive share of the depth"):
        KNOWN.confidence(tolerance)


@pytest.mark.parametrize("size", [480, (480,), (480.0, 640), (480, 16)])
def test_sizes_that_are_none_are_told(size: Any) -> None:
    for name in ("work_size", "size"):
        with pytest.raises(ValueError, match="must be HEIGHT WIDTH of 32 or more, got"):
            PredictConfig(**{name: size})


def test_slips_of_names_are_told() -> None:
    precision: Any = "float16"
    with pytest.raises(ValueError, match=r"precision must be one of .*bfloat16.*'float16'"):
        load_predictor("deltas-small", precision=precision)
    with pytest.raises(UserError, match=r"cannot compute there \(.*, --device gpu: use cpu"):
        load_model(device="gpu")
    with pytest.raises(UserError, match=r"cannot compute there \(.*, --device gpu: use cpu"):
        load_predictor("plane-sweep", "gpu")
    name: Any = "deltas-small"
    with pytest.raises(TypeError, match=r"config must be NetworkConfig.*use load_model"):
        Deltas(name)


def test_what_is_no_capture_and_no_network_is_told(tmp_path: Path) -> None:
    path: Any = tmp_path
    doors: list[Callable[[], object]] = [
        lambda: choose_view_sets(path, 3),
        lambda: Followed(path),
        lambda: Asked(path, (0.5, 9.0)),
        lambda: made_of(path, path),
        lambda: save_capture(path, path / "out"),
        lambda: check_capture(path, path),
    ]
    for door in doors:
        with pytest.raises(TypeError, match=r"capture must be Capture, got .*: use open_capture"):
            door()
    network: Any = Deltas(NetworkConfig())
    with pytest.raises(TypeError, match="must be a Predictor, got Deltas: use load_predictor"):
        look(network, [], PredictConfig(), Reach(0.5, 9.0, 1.0))
