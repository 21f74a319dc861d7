"""The reference mode against arrays of the original network with formula weights."""

import json
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import skimage.data
import torch
from numpy.typing import NDArray
from reference_tables import formula_tensor
from torch import Tensor

from deltas_nets import reference
from deltas_nets.reference import ReferenceNetwork

pytestmark = pytest.mark.shared

Arrays = dict[str, NDArray[Any]]

# max |a - b| / max |b|
RELATIVE = {
    **dict.fromkeys(("stem_mean", *(f"layer{n}_mean" for n in (1, 2, 3, 4))), 1e-4),
    **dict.fromkeys(("det_upsampled_mean", "detector_logits", "desc_fuse1_in_mean"), 1e-4),
    **dict.fromkeys(("desc_fuse2_in_mean", "desc_raw_norm", "descriptors", "heatmap"), 1e-4),
    **dict.fromkeys(("detected_score", "detected_top32_score"), 1e-4),
    **dict.fromkeys(("evalnorm_layer4_mean", "evalnorm_logits_mean"), 1e-4),
    **dict.fromkeys(("confidence", "edge_confidence", "probe_dlt", "dlt_singular_values"), 1e-5),
    **dict.fromkeys(("sharp_confidence", "sharp_dlt_singular_values"), 1e-4),
    **dict.fromkeys(("edge_points_3d", "sparse_depth", "sharp_dense_depth"), 1e-4),
    **dict.fromkeys(("depth_stem_mean", *(f"depth_layer{n}_mean" for n in (1, 2, 3, 4))), 1e-4),
    **dict.fromkeys(("pyramid_mean", *(f"up{n}_mean" for n in (1, 2, 3, 4, 5))), 1e-4),
    **dict.fromkeys(("dense_depth", "depth_half", "depth_quarter", "depth_eighth"), 1e-4),
    "sharp_sparse_depth": 1e-3,
    "metric_result": 1e-5,
}
# px
ABSOLUTE = {
    **dict.fromkeys(("project_near", "project_far", "segment_center", "segment_length"), 1e-3),
    **dict.fromkeys(("matches", "edge_matches"), 1e-3),
    "sharp_matches": 5e-3,
}
EXACT = ("nms_kept", "in_range", "edge_in_range", "image_crc32")
# Near-ties may change places on other hardware.
SETS = ("detected_xy", "detected_top32_xy", "detected_radius3_xy", "detected_over12_xy")
# Along a line either way round: for a pure translation the direction's sign is noise.
MAPS = {"probe_grid": 1e-3}  # px
MAPS |= dict.fromkeys(("probe_corr", "probe_corr_act", "sharp_probe_corr_act"), 1e-4)  # relative
# Of a point's distance, where a view has it in range; else 1e-2.
POINTS = {"points_3d": 1e-4, "sharp_points_3d": 1e-3}
INPUTS = (
    "keypoints",
    "intrinsics",
    "cam_from_anchor",
    "probe_points",
    "edge_keypoints",
    "edge_cam_from_anchor",
    "metric_truth",
    "metric_prediction",
)


@pytest.fixture(scope="module")
def folder(shared_data: Path) -> Path:
    return shared_data.parent / "reference"


@pytest.fixture(scope="module")
def expected(folder: Path) -> Arrays:
    with np.load(folder / "outputs.npz") as arrays:
        return dict(arrays)


@pytest.fixture(scope="module")
def network(folder: Path) -> ReferenceNetwork:
    shapes = json.loads((folder / "state_dicts.json").read_text())
    tables = {
        entry: {
            key: np.zeros((), np.int64)
            if key.endswith("tracked")
            else formula_tensor(entry, key, s)
            for key, s in table.items()
        }
        for entry, table in shapes.items()
    }
    return reference.load(tables)


@pytest.fixture(scope="module")
def pixels() -> NDArray[np.uint8]:
    """``(3, 240, 320, 3)``: an anchor and two sources."""
    left, right, _ = skimage.data.stereo_motorcycle()
    views = (left[100:340, 200:520], right[100:340, 200:520], left[104:344, 206:526])
    return np.stack(views)


@pytest.fixture(scope="module")
def found(network: ReferenceNetwork, expected: Arrays, pixels: NDArray[np.uint8]) -> Arrays:
    """All arrays, from one run."""
    given = {name: torch.from_numpy(expected[name]) for name in INPUTS}
    cameras = (given["intrinsics"], given["cam_from_anchor"])
    keypoints, probe = given["keypoints"], given["probe_points"]
    images = torch.from_numpy(pixels).permute(0, 3, 1, 2).float() / 255
    run = network.run(images, keypoints, *cameras, probe_points=probe)
    results: dict[str, Tensor] = run._asdict()
    results["image_crc32"] = torch.tensor(zlib.crc32(pixels.tobytes()))

    anchor = run.detector_logits[0]
    top32 = network.pick(anchor, num_points=64)
    results |= {
        "detected_top32_xy": top32.detected_xy,
        "detected_top32_score": top32.detected_score,
    }
    radius3 = network.pick(anchor, num_points=16384, radius=3)
    over12 = network.pick(anchor, threshold=0.12)
    results |= {
        "detected_radius3_xy": radius3.detected_xy,
        "detected_over12_xy": over12.detected_xy,
    }

    evaluated = network.features(reference.evaluation_input(images))
    results["evalnorm_layer4_mean"] = evaluated.taps.deepest.mean(dim=1)
    results["evalnorm_logits_mean"] = evaluated.detector.logits.mean(dim=1)

    seven = run.descriptors[[0, 1, 2, 1, 2, 1, 2, 1]]
    edge = network.match(seven, given["edge_keypoints"], cameras[0], given["edge_cam_from_anchor"])
    for name in ("in_range", "matches", "confidence", "points_3d"):
        results[f"edge_{name}"] = getattr(edge, name)

    results["metric_result"] = reference.metric_result(
        given["metric_truth"], given["metric_prediction"]
    )

    norm = network.match_norm.bn_match_convD
    before = norm.weight.clone(), norm.bias.clone()
    norm.weight.fill_(30)
    norm.bias.fill_(-24)
    sharp = network.match(run.descriptors, keypoints, *cameras, probe_points=probe)
    norm.weight.copy_(before[0])
    norm.bias.copy_(before[1])
    anchor_taps = network.features(images[:1]).taps
    dense = network.densify(anchor_taps, keypoints, sharp.points_3d, sharp.in_range)
    for name in ("probe_corr_act", "matches", "confidence", "dlt_singular_values", "points_3d"):
        results[f"sharp_{name}"] = getattr(sharp, name)
    results["sharp_sparse_depth"], results["sharp_dense_depth"] = (
        dense.sparse_depth,
        dense.dense_depth,
    )
    return {name: result.numpy() for name, result in results.items()}


def largest(values: NDArray[Any]) -> float:
    return float(np.abs(values).max())


def test_every_array_is_compared(expected: Arrays, found: Arrays) -> None:
    compared = {*RELATIVE, *ABSOLUTE, *EXACT, *SETS, *MAPS, *POINTS, "segment_angle"}
    assert compared | set(INPUTS) == set(expected)
    assert compared == set(found)
    for name in compared:
        assert found[name].shape == expected[name].shape, name


# In one test each: workers that take parts of a module each make its arrays, which take long.
def test_maps_scores_and_lengths(expected: Arrays, found: Arrays) -> None:
    for name, relative in RELATIVE.items():
        difference = largest(found[name] - expected[name])
        assert difference <= relative * largest(expected[name]), name


def test_pixels(expected: Arrays, found: Arrays) -> None:
    for name, absolute in ABSOLUTE.items():
        assert largest(found[name] - expected[name]) <= absolute, name


def test_exact(expected: Arrays, found: Arrays) -> None:
    for name in EXACT:
        np.testing.assert_array_equal(found[name], expected[name], err_msg=name)


def test_sets_of_pixels(expected: Arrays, found: Arrays) -> None:
    for name in SETS:
        assert set(map(tuple, found[name])) == set(map(tuple, expected[name])), name


def test_scores_belong_to_their_pixels(expected: Arrays, found: Arrays) -> None:
    for name in ("detected", "detected_top32"):
        of_pixel = dict(
            zip(map(tuple, expected[f"{name}_xy"]), expected[f"{name}_score"], strict=True)
        )
        pairs = zip(map(tuple, found[f"{name}_xy"]), found[f"{name}_score"], strict=True)
        for pixel, score in pairs:
            assert score == pytest.approx(of_pixel[pixel], rel=1e-4)


def test_angles_modulo_half_a_turn(expected: Arrays, found: Arrays) -> None:
    difference = found["segment_angle"].astype(float) - expected["segment_angle"]
    assert largest(difference - np.pi * np.round(difference / np.pi)) <= 1e-5


def test_maps_up_to_half_a_turn(expected: Arrays, found: Arrays) -> None:
    for name, limit in MAPS.items():
        most = limit * (1 if name == "probe_grid" else largest(expected[name]))
        for view, point in np.ndindex(found[name].shape[1:3]):
            one, other = found[name][0, view, point], expected[name][0, view, point]
            assert min(largest(one - other), largest(one[::-1, ::-1] - other)) <= most, name


def test_points(expected: Arrays, found: Arrays) -> None:
    seen = expected["in_range"].any(axis=1)
    assert seen.sum() == 489
    for name, limit in POINTS.items():
        distance = np.linalg.norm(expected[name], axis=-1)
        error = np.linalg.norm(found[name] - expected[name], axis=-1) / distance
        assert error[seen].max() <= limit, name
        assert error.max() <= max(1e-2, limit), name


def test_sparse_depth_is_empty_in_the_same_places(expected: Arrays, found: Arrays) -> None:
    for name in ("sparse_depth", "sharp_sparse_depth"):
        np.testing.assert_array_equal(found[name] == 0, expected[name] == 0, err_msg=name)
