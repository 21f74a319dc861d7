"""The benchmark's interface, called as its program calls it."""

from pathlib import Path

import numpy as np
import pytest
from room_capture import write_scene

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.opening import open_capture
from deltas_nets.captures.view_sets import ViewSet
from deltas_nets.evaluate.depth_metrics import depth_metrics
from deltas_nets.evaluate.robust_mvd import RobustMvdModel, robust_mvd_metrics
from deltas_nets.predict.depth_map import PredictConfig, Wanted
from deltas_nets.predict.ours import DeltasPredictor
from deltas_nets.predict.predictor import load_predictor
from deltas_nets.predict.search import Followed
from deltas_nets.rooms import render_room

Arrays = list[np.ndarray]
NUM = 3


@pytest.fixture(scope="module")
def model() -> RobustMvdModel:
    return RobustMvdModel()


@pytest.fixture(scope="module")
def sample(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    folder = tmp_path_factory.mktemp("mvd") / "room"
    write_scene(folder, render_room(1, num_views=NUM, image_size=(96, 128)))
    return open_capture(folder)


def arrays_of(sample: Capture) -> dict[str, Arrays]:
    """A sample as the benchmark's loader gives it: lists of views, a batch in front."""
    frames = list(sample.frames.values())
    world_from_key = np.linalg.inv(frames[0].cam_from_world)
    return {
        "images": [f.read_image().transpose(2, 0, 1)[None].astype(np.float32) for f in frames],
        "poses": [(f.cam_from_world @ world_from_key)[None].astype(np.float32) for f in frames],
        "intrinsics": [f.K[None].astype(np.float32) for f in frames],
    }


def test_the_map_is_that_of_the_capture(model: RobustMvdModel, sample: Capture) -> None:
    given = arrays_of(sample)
    adapted = model.input_adapter(**given, keyview_idx=np.array([0]), depth_range=None)
    pred, aux = model.output_adapter(model(**adapted))
    network = load_predictor("deltas-small")
    assert isinstance(network, DeltasPredictor)
    # The same frames, from files.
    frames = list(sample.frames.values())
    expected = network.depth_map(Wanted(frames, PredictConfig()))
    assert pred["depth"].shape == pred["depth_uncertainty"].shape == (1, 1, 96, 128)
    assert (pred["depth_uncertainty"] > 0).all()
    assert aux == {}
    metrics = robust_mvd_metrics(pred["depth"][0, 0], frames[0].read_depth())
    assert metrics is not None
    assert metrics.rel < 15  # of a network that saw nothing it would be 40 or more
    ranged = model.input_adapter(
        **given, keyview_idx=np.array([0]), depth_range=(np.array([0.5]), np.array([10.0]))
    )
    assert model(**ranged)["depth"][0, 0] == pytest.approx(expected.depth, rel=2e-3)


@pytest.mark.shared
def test_the_benchmarks_own_sample_is_as_the_capture_of_its_folder(
    shared_data: Path,
) -> None:
    """A room's corner, 0.5 to 1.2 m away: no range is given, and none of it is missed."""
    capture = open_capture(shared_data / "formats" / "robustmvd")
    chosen = ["0", "key", "2"]
    given = {
        name: [dict(zip(capture.frames, views, strict=True))[id] for id in chosen]
        for name, views in arrays_of(capture).items()
    }
    small = PredictConfig(size=(96, 160))
    model = RobustMvdModel(config=small)
    found = model(**model.input_adapter(**given, keyview_idx=1))
    views = ViewSet("key", ("0", "2"))
    expected = Followed(capture)(load_predictor("deltas-small"), views, small).map
    assert found["depth"][0, 0] == pytest.approx(expected.depth, rel=1e-3)
    assert 0.5 < np.median(found["depth"]) < 1.0


def test_the_key_view_may_be_any_and_items_of_a_batch_are_alone(
    model: RobustMvdModel, sample: Capture
) -> None:
    given = arrays_of(sample)
    turned = {name: [*views[1:], views[0]] for name, views in given.items()}
    together = {
        name: [np.concatenate(pair) for pair in zip(given[name], turned[name], strict=True)]
        for name in given
    }
    both = model(**model.input_adapter(**together, keyview_idx=np.array([0, NUM - 1])))["depth"]
    alone = model(**model.input_adapter(**given, keyview_idx=0))["depth"]
    assert both[0] == pytest.approx(alone[0], rel=1e-4)
    # The same key view, elsewhere in the list; its sources are in the same order.
    assert both[1] == pytest.approx(alone[0], rel=1e-4)


def test_without_poses_there_is_nothing_to_triangulate(
    model: RobustMvdModel, sample: Capture
) -> None:
    given = arrays_of(sample)
    with pytest.raises(ValueError, match="poses and intrinsics must be given"):
        model.input_adapter(given["images"], 0)
    with pytest.raises(ValueError, match="of as many views"):
        model.input_adapter(given["images"], 0, given["poses"][1:], given["intrinsics"])
    for key in (-1, NUM, 0.5):  # -1 was the last view, and among its own sources
        with pytest.raises(ValueError, match=r"keyview_idx must be in 0\.\.2"):
            model.input_adapter(**given, keyview_idx=np.array([0, key]))


def test_metrics_are_per_cent_at_the_size_of_the_truth() -> None:
    truth = np.array([[2.0, 0.0], [40.0, 0.2]], np.float32)  # beyond any range of ours
    depth = np.repeat(np.repeat(truth * [[1.02, 1], [1.1, 1.01]], 3, 0), 3, 1)
    found = robust_mvd_metrics(depth, truth, np.abs(depth))
    assert found is not None
    plain = depth_metrics(depth[::3, ::3], truth, depth_range=(1e-6, 1e6))
    assert plain is not None
    assert found.rel == pytest.approx(100 * plain.abs_rel)
    assert found.rel == pytest.approx((2 + 10 + 1) / 3, rel=1e-4)
    assert found.tau == pytest.approx(100 * 2 / 3)
    assert found.ause >= 0
    assert robust_mvd_metrics(depth, 0 * truth) is None
