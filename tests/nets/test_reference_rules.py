"""What the reference network's rules do where its arrays do not show it."""

import math

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor
from torch.testing import assert_close

from deltas_geom.checks import ShapeError
from deltas_nets.network.paper.up_projection import insert_zeros
from deltas_nets.reference import fill_keypoints, metric_result, pick_keypoints
from deltas_nets.reference.enlarge import enlarge_by_rows
from deltas_nets.reference.metrics import mean_result
from deltas_nets.reference.outputs import (
    DensifyOutputs,
    FeatureOutputs,
    MatchOutputs,
    ReferenceOutputs,
)
from deltas_nets.reference.points import clamp_if_infinite, draw_sparse_depth, triangulate_pixels
from deltas_nets.reference.scores import correlate_samples, read_matches, sample_descriptors
from deltas_nets.reference.segments import reference_segments, segment_samples

SIZE = (48, 64)
K = torch.tensor([[60.0, 0, 31.5], [0, 60, 23.5], [0, 0, 1]])[None]


def moved(*shift: float) -> Tensor:
    pose = torch.eye(4)
    pose[:3, 3] = torch.tensor(shift)
    return pose[None, None]


def test_a_run_has_the_fields_of_its_stages() -> None:
    detected = ("nms_kept", "detected_xy", "detected_score")
    stages = FeatureOutputs._fields + detected + MatchOutputs._fields + DensifyOutputs._fields
    assert ReferenceOutputs._fields == stages


def test_detections_stay_four_pixels_inside_on_all_sides() -> None:
    heatmap = torch.zeros(SIZE)
    inside = [(4, 4), (59, 4), (4, 43), (59, 43)]  # (x, y)
    outside = [(30, 3), (30, 44), (3, 24), (60, 24)]
    for x, y in inside + outside:
        heatmap[y, x] = 0.5
    picked = pick_keypoints(heatmap, radius=2)
    assert picked.detected_xy.tolist() == [[4, 4], [59, 4], [4, 43], [59, 43]]
    assert picked.nms_kept.sum() == 8


def test_suppression_looks_again_twice_at_what_is_left() -> None:
    heatmap = torch.zeros(20, 60)
    row = [0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3]  # 2 px apart: each suppresses the next
    heatmap[10, 10:24:2] = torch.tensor(row)
    picked = pick_keypoints(heatmap, radius=3)
    assert picked.detected_xy[:, 0].tolist() == [10, 14, 18]


def test_the_budget_takes_the_best_and_raster_order_is_kept_without_it() -> None:
    heatmap = torch.zeros(SIZE)
    for place, score in zip((10, 20, 30, 40), (0.1, 0.4, 0.2, 0.3), strict=True):
        heatmap[place, place] = score
    raster = pick_keypoints(heatmap, num_points=8, radius=3).detected_xy
    assert raster[:, 0].tolist() == [10, 20, 30, 40]
    best = pick_keypoints(heatmap, num_points=6, radius=3)
    assert best.detected_xy[:, 0].tolist() == [20, 40, 30]
    assert_close(best.detected_score, torch.tensor([0.4, 0.3, 0.2]))
    exactly = pick_keypoints(heatmap, radius=3, threshold=float(heatmap[10, 10]))
    assert len(exactly.detected_xy) == 3  # strictly above


def test_random_points_fill_up_to_all_and_reach_every_border() -> None:
    heatmap = torch.zeros(6, 5)
    heatmap[4, 4] = 0.5
    detected = pick_keypoints(heatmap, border=0)
    xy, score = fill_keypoints(
        detected, num_points=2000, generator=torch.Generator().manual_seed(0)
    )
    assert xy.shape == (2000, 2)
    assert xy[0].tolist() == [4, 4]
    assert score[0] == 0.5 and (score[1:] == 0).all()
    assert torch.equal(xy.amin(dim=0), torch.tensor([0.0, 0]))
    assert torch.equal(xy.amax(dim=0), torch.tensor([4.0, 5]))
    counts = torch.unique(xy[1:], dim=0, return_counts=True)[1]
    assert len(counts) == 30  # every pixel, the detected one as well
    assert counts.min() > 35 and counts.max() < 105  # 67 each
    with pytest.raises(ShapeError):
        pick_keypoints(heatmap[None])


def test_a_segment_is_kept_whole_or_dropped() -> None:
    keypoints = torch.tensor([[[31.0, 20.0], [40.0, 20.0], [5.0, 20.0]]])
    found = reference_segments(keypoints, K, moved(-0.15, 0, 0), image_size=SIZE)
    # 60 * 0.15 / 0.5 = 18 px to the left at the near end, 0.9 px at the far one.
    assert_close(found.near[0, 0, :, 0], torch.tensor([13.0, 22, -13]))
    assert_close(found.far[0, 0, :, 0], torch.tensor([30.1, 39.1, 4.1]))
    assert found.in_range.tolist() == [[[True, True, False]]]
    assert_close(found.length, torch.tensor([[[17.1, 17.1, 0]]]))
    assert_close(found.center[0, 0, 2], torch.zeros(2))
    samples = segment_samples(found)
    assert samples.shape == (1, 1, 3, 3, 100, 2)
    ends = samples[0, 0, 0, 1, [0, -1], 0].sort().values
    assert_close(ends, torch.tensor([13.0, 30.1]))
    assert_close(samples[0, 0, 0, :, 50, 1].sort().values, torch.tensor([19.0, 20, 21]))


def test_points_behind_a_source_are_kept() -> None:
    half_turn = torch.diag(torch.tensor([-1.0, 1, -1, 1]))
    half_turn[0, 3] = 0.05
    found = reference_segments(
        torch.tensor([[[31.0, 20.0]]]), K, half_turn[None, None], image_size=SIZE
    )
    assert found.in_range.all()


def test_without_parallax_the_match_is_pixel_zero() -> None:
    found = reference_segments(torch.tensor([[[31.0, 20.0]]]), K, moved(0, 0, 0), image_size=SIZE)
    assert not found.in_range.any()
    matches = read_matches(torch.zeros(1, 1, 1, 3, 100), found)
    assert torch.equal(matches.pixels, torch.zeros(1, 1, 1, 2))
    assert_close(matches.weights, torch.full((1, 1, 1), 0.0005))


@pytest.mark.parametrize("offset", [1.0, 2.0])
@pytest.mark.parametrize("count", [25, 100])
def test_a_match_across_the_line_is_halved(offset: float, count: int) -> None:
    found = reference_segments(
        torch.tensor([[[31.0, 20.0]]]), K, moved(-0.15, 0, 0), image_size=SIZE
    )
    samples = segment_samples(found, num_samples=count, offset=offset)
    scores = torch.zeros(1, 1, 1, 3, count)
    scores[..., 2, 20] = 1000
    match = read_matches(scores, found, offset=offset).pixels[0, 0, 0]
    sampled = samples[0, 0, 0, 2, 20]
    assert abs(sampled[1] - 20) == offset
    assert_close(match[0], sampled[0])
    assert_close(match[1] - 20, (sampled[1] - 20) / 2)
    assert_close(read_matches(scores, found).weights, torch.full((1, 1, 1), 1.001))


def test_descriptors_are_read_too_far_left_and_up() -> None:
    # A map whose value is the column of the cell, told from its direction.
    columns = torch.arange(10.0) / 10
    feature = torch.stack([columns.cos(), columns.sin()]).view(1, 2, 1, 10).expand(1, 2, 6, 10)
    x = torch.tensor([30.0, 40, 50])
    pixels = torch.stack([x, torch.full_like(x, 24)], dim=-1)[None, None]
    read = sample_descriptors(feature, pixels)[0, :, 0]
    assert_close(torch.linalg.vector_norm(read, dim=0), torch.ones(3))
    column = 10 * torch.atan2(read[1], read[0])
    assert_close(column, 10 * (x - 3.5) / (80 - 4.5) - 0.5, rtol=0, atol=5e-3)
    far_outside = sample_descriptors(feature, torch.full((1, 1, 1, 2), 500.0))
    assert torch.equal(far_outside, torch.zeros(1, 2, 1, 1))


def test_correlation_is_a_cosine_of_what_is_read() -> None:
    generator = torch.Generator().manual_seed(0)
    descriptors = F.normalize(torch.randn(1, 3, 8, 6, 8, generator=generator), dim=2)
    descriptors[:, 2] = descriptors[:, 0]
    keypoints = torch.tensor([[[20.0, 20.0], [33.0, 25.0]]])
    samples = keypoints[:, None, :, None, None].expand(1, 2, 2, 3, 100, 2)
    correlation = correlate_samples(descriptors, keypoints, samples)
    assert correlation.abs().max() <= 1 + 1e-6
    assert_close(correlation[:, 1], torch.ones(1, 2, 3, 100))
    assert correlation[:, 0].max() < 0.99


def test_one_infinite_point_clamps_all() -> None:
    points = torch.tensor([[[1.0, -5000, 3], [4, 5, 6]], [[7, 2000, 9], [math.nan, 0, 0]]])
    assert clamp_if_infinite(points) is points
    points[0, 1, 2] = -math.inf
    expected = torch.tensor([[[1.0, -1000, 3], [4, 5, -1000]], [[7, 1000, 9], [math.nan, 0, 0]]])
    assert_close(clamp_if_infinite(points), expected, equal_nan=True)


def test_triangulation_of_true_pixels_finds_the_point() -> None:
    point = torch.tensor([0.2, -0.1, 2.0])
    pose = moved(-0.3, 0.1, 0.05)
    seen = torch.stack([point, pose[0, 0, :3] @ torch.cat([point, torch.ones(1)])])
    pixels = seen @ K[0].mT
    pixels = (pixels[:, :2] / pixels[:, 2:])[None, :, None]
    found = triangulate_pixels(pixels, torch.tensor([[[1.0], [0.4]]]), K, pose)
    assert found.system.shape == (1, 1, 4, 4)
    assert_close(found.points[0, 0], point, rtol=1e-3, atol=1e-3)
    assert (found.singular_values.diff(dim=-1) <= 0).all()


def test_later_points_win_pixels_even_when_invalid() -> None:
    keypoints = torch.tensor(
        [[[2.9, 1.9], [2.0, 1.0], [0.0, 0.0], [0.2, 0.4], [4.0, 0.0], [9.0, 0]]]
    )
    z = torch.tensor([[2.0, 3.0, 4.0, 0.3, 12.0, 1.0]])
    points = torch.stack([z, z, z], dim=-1)
    seen = torch.ones(1, 6, dtype=torch.bool)
    image = draw_sparse_depth(keypoints, points, seen, image_size=(3, 5))
    expected = torch.zeros(1, 1, 3, 5)
    expected[0, 0, 1, 2] = 3
    assert torch.equal(image, expected)
    alone = draw_sparse_depth(keypoints[:, :1], points[:, :1], seen[:, :1], image_size=(3, 5))
    assert alone[0, 0, 1, 2] == 2  # truncated, not rounded
    assert (draw_sparse_depth(keypoints, points, ~seen, image_size=(3, 5)) == 0).all()
    nothing = draw_sparse_depth(keypoints, points * math.nan, seen, image_size=(3, 5))
    assert (nothing == 0).all()


def test_rows_alone_decide_how_maps_are_enlarged() -> None:
    x = torch.rand(1, 2, 4, 5)
    assert torch.equal(enlarge_by_rows(x, (8, 9)), insert_zeros(x, (8, 9)))
    assert torch.equal(enlarge_by_rows(x, (7, 10)), F.interpolate(x, (7, 10)))


def test_metrics_keep_the_original_mistakes() -> None:
    truth = torch.full((2, 2, 2), 2.0)
    prediction = torch.full((2, 2, 2), 3.0)
    prediction[0, 0, 0] = -2.0
    truth[1] = 0  # nothing known, but counted
    truth[0, 1, 1] = math.nan
    result = metric_result(truth, prediction)
    abs_diff, abs_rel = (4 + 1 + 1) / 3, (2 + 0.5 + 0.5) / 3
    expected = torch.tensor([abs_rel, abs_diff, (8 + 0.5 + 0.5) / 3, 1 / 3, 1, 1]) / 2
    assert_close(result, expected)
    halves = mean_result([(truth, prediction), (truth[:1], prediction[:1])])
    assert_close(halves, expected * 1.5)
    with pytest.raises(ShapeError):
        metric_result(truth, prediction[:1])
