"""Wrong segments and samples along them, each with exactly what it fails."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from deltas_geom import PosedViews, Status
from deltas_geom.testing.conformance import conformance
from deltas_geom.testing.invariants import INVARIANTS
from deltas_geom.testing.target import DepthRange, ImageSize, Target
from deltas_geom.testing.targets import deltas

OURS = deltas()
Size = ImageSize
FEATURES = {"segments", "samples", "depth_samples", "pixel_samples", "sweep"}


def ours(feature: str) -> Callable[..., Any]:
    function: Callable[..., Any] = getattr(OURS, feature)
    return function


Ends = tuple[Tensor, Tensor, Tensor]


def segments(
    change: Callable[[Tensor, Tensor, Tensor], Ends],
) -> Callable[[Tensor, Tensor, Tensor, DepthRange, Size], Ends]:
    def changed(K: Tensor, pose: Tensor, pixels: Tensor, span: DepthRange, size: Size) -> Ends:
        return change(*ours("segments")(K, pose, pixels, span, size))

    return changed


def unclipped(K: Tensor, pose: Tensor, pixels: Tensor, span: DepthRange, size: Size) -> Ends:
    """Clipped by an image of more than a hundred times the size."""
    shift = torch.tensor([[1.0, 0, 1e5], [0, 1, 1e5], [0, 0, 1]]).to(K)
    K = torch.stack([K[0], shift @ K[1]])
    start, end, status = ours("segments")(K, pose, pixels, span, (200_000, 200_000))
    return start - 1e5, end - 1e5, status


def dropped(K: Tensor, pose: Tensor, pixels: Tensor, span: DepthRange, size: Size) -> Ends:
    """Empty unless both ends are in the image."""
    start, end, status = ours("segments")(K, pose, pixels, span, size)
    whole = unclipped(K, pose, pixels, span, size)
    same = ((start - whole[0]).abs() + (end - whole[1]).abs()).amax(dim=-1) < 1e-6
    status = torch.where(same | (status == Status.NOT_FINITE_INPUT), status, Status.EMPTY)
    return start, end, status.to(torch.int8)


def both_sides(K: Tensor, pose: Tensor, pixels: Tensor, span: DepthRange, size: Size) -> Ends:
    """Ends from the camera equations, whether in front or not, forced into the image."""
    status = ours("segments")(K, pose, pixels, span, size)[2]
    anchor = PosedViews(K[:1], pose[:1])
    rays = torch.linalg.inv(K[0]) @ F.pad(pixels, (0, 1), value=1.0).mT
    forced = []
    for depth in reversed(span):
        in_anchor = F.pad((rays * depth).mT, (0, 1), value=1.0)
        world = in_anchor @ torch.linalg.inv(anchor.cam_from_world[0]).mT
        seen = world @ (K[1] @ pose[1, :3]).mT
        place = seen[:, :2] / seen[:, 2:]
        forced.append(place.clamp(min=-0.5).minimum(place.new_tensor(size[::-1]) - 0.5))
    return forced[0], forced[1], torch.where(status == Status.EMPTY, status, Status.OK)


def not_so_near(K: Tensor, pose: Tensor, pixels: Tensor, span: DepthRange, size: Size) -> Ends:
    found: Ends = ours("segments")(K, pose, pixels, (max(span[0], 0.5), span[1]), size)
    return found


def no_farther(K: Tensor, pose: Tensor, pixels: Tensor, span: DepthRange, size: Size) -> Ends:
    found: Ends = ours("segments")(K, pose, pixels, (0.5 * span[0], 2 * span[1]), size)
    return found


Along = Callable[[Tensor, Tensor, Tensor, DepthRange, Size, int], Ends]


def linear_samples(
    K: Tensor, pose: Tensor, pixels: Tensor, span: DepthRange, size: Size, count: int
) -> Ends:
    """Even in pixels and in inverse depth at once, as if the source were an affine camera."""
    along, inv_depth, status = ours("depth_samples")(K, pose, pixels, span, size, count)
    share = torch.linspace(0, 1, count, dtype=along.dtype)[:, None]
    return along[:, :1] * (1 - share) + along[:, -1:] * share, inv_depth, status


def samples(feature: str, change: Callable[[Tensor, Tensor, Tensor], Ends]) -> Along:
    def changed(
        K: Tensor, pose: Tensor, pixels: Tensor, span: DepthRange, size: Size, count: int
    ) -> Ends:
        return change(*ours(feature)(K, pose, pixels, span, size, count))

    return changed


def too_wide(
    K: Tensor, pose: Tensor, pixels: Tensor, span: DepthRange, size: Size, count: int
) -> Ends:
    found: Ends = ours("depth_samples")(K, pose, pixels, (span[0] / 2, 2 * span[1]), size, count)
    return found


def half_seen(
    K: Tensor, pose: Tensor, pixels: Tensor, w: Tensor, size: Size
) -> tuple[Tensor, Tensor]:
    found, visible = ours("sweep")(K, pose, pixels, w, size)
    return found, visible | (found == 0).all(dim=-1)


def no_infinity(
    K: Tensor, pose: Tensor, pixels: Tensor, w: Tensor, size: Size
) -> tuple[Tensor, Tensor]:
    found, visible = ours("sweep")(K, pose, pixels, w, size)
    return torch.where((w > 0)[:, None], found, torch.nan), visible


BROKEN: list[tuple[Target, set[str]]] = [
    (
        Target("half a pixel", segments=segments(lambda a, b, s: (a + 0.5, b + 0.5, s))),
        {
            "segment_ends_are_visible_depths_of_the_range",
            "every_visible_depth_lies_on_the_segment",
            "without_a_baseline_a_segment_is_a_point",
            "a_keypoint_at_the_epipole_stays_there",
            "segments_follow_a_resize",
            "a_crop_of_the_source_clips_segments",
        },
    ),
    (
        Target("y, x", segments=segments(lambda a, b, s: (a.flip(-1), b.flip(-1), s))),
        {
            "segment_ends_are_visible_depths_of_the_range",
            "every_visible_depth_lies_on_the_segment",
            "without_a_baseline_a_segment_is_a_point",
            "a_keypoint_at_the_epipole_stays_there",
            "segments_follow_a_resize",
            "a_crop_of_the_source_clips_segments",
        },
    ),
    (
        Target("near first", segments=segments(lambda a, b, s: (b, a, s))),
        {
            "segment_ends_are_visible_depths_of_the_range",
        },
    ),
    (
        Target("unclipped", segments=unclipped),
        {
            "segment_ends_are_visible_depths_of_the_range",
            "a_segment_out_of_sight_is_flagged",
            "segments_follow_a_resize",
            "a_crop_of_the_source_clips_segments",
        },
    ),
    (
        Target("dropped", segments=dropped),
        {
            "every_visible_depth_lies_on_the_segment",
            "a_crop_of_the_source_clips_segments",
        },
    ),
    (
        Target("both sides", segments=both_sides),
        {
            "segment_ends_are_visible_depths_of_the_range",
            "every_visible_depth_lies_on_the_segment",
            "a_segment_out_of_sight_is_flagged",
            "without_a_baseline_a_segment_is_a_point",
            "a_keypoint_at_the_epipole_stays_there",
            "a_crop_of_the_source_clips_segments",
        },
    ),
    (
        Target("not so near", segments=not_so_near),
        {
            "every_visible_depth_lies_on_the_segment",
            "segments_do_not_know_the_worlds_frame",
        },
    ),
    (
        Target("too long", segments=no_farther),
        {
            "segment_ends_are_visible_depths_of_the_range",
        },
    ),
    (
        Target("all seen", segments=segments(lambda a, b, s: (a, b, 0 * s))),
        {
            "a_segment_out_of_sight_is_flagged",
            "without_a_baseline_a_segment_is_a_point",
            "a_keypoint_at_the_epipole_stays_there",
            "a_crop_of_the_source_clips_segments",
        },
    ),
    (
        Target("all seen, a mask", segments=segments(lambda a, b, s: (a, b, s > -1))),
        {
            "a_segment_out_of_sight_is_flagged",
            "a_crop_of_the_source_clips_segments",
        },
    ),
    (
        Target("none seen", segments=segments(lambda a, b, s: (a, b, s > 9))),
        {
            "every_visible_depth_lies_on_the_segment",
            "without_a_baseline_a_segment_is_a_point",
            "a_keypoint_at_the_epipole_stays_there",
        },
    ),
    (
        Target("empty is nan", segments=segments(lambda a, b, s: (a / (a != 0), b, s))),
        {
            "segments_are_finite",
        },
    ),
    (
        Target("affine", depth_samples=linear_samples),
        {
            "samples_are_seen_at_their_inverse_depths",
        },
    ),
    (
        Target(
            "spacings swapped", depth_samples=OURS.pixel_samples, pixel_samples=OURS.depth_samples
        ),
        {
            "samples_are_even_in_inverse_depth",
            "samples_are_even_in_pixels",
        },
    ),
    (
        Target(
            "from near",
            depth_samples=samples("depth_samples", lambda x, w, s: (x.flip(1), w.flip(1), s)),
        ),
        {
            "samples_run_from_the_far_to_the_near_end",
        },
    ),
    (
        Target(
            "far samples first",
            pixel_samples=samples("pixel_samples", lambda x, w, s: (x, w + 1, s)),
        ),
        {
            "samples_are_seen_at_their_inverse_depths",
            "samples_run_from_the_far_to_the_near_end",
        },
    ),
    (
        Target("too wide", depth_samples=too_wide),
        {
            "samples_run_from_the_far_to_the_near_end",
        },
    ),
    (
        Target(
            "empty samples are nan",
            depth_samples=samples(
                "depth_samples", lambda x, w, s: (x / (s[:, None, None] < 6), w, s)
            ),
        ),
        {
            "samples_are_finite",
        },
    ),
    (
        Target("sees behind", sweep=half_seen),
        {
            "a_sweep_sees_each_inverse_depth_where_it_is",
        },
    ),
    (
        Target("no infinity", sweep=no_infinity),
        {
            "a_sweep_sees_each_inverse_depth_where_it_is",
        },
    ),
]


@pytest.mark.parametrize(("target", "wanted"), BROKEN, ids=[target.name for target, _ in BROKEN])
def test_a_wrong_implementation_fails_what_it_should(target: Target, wanted: set[str]) -> None:
    failed = {outcome.invariant for outcome in conformance([target]) if outcome.result == "FAIL"}
    assert failed == wanted


def test_every_invariant_can_fail() -> None:
    names = {name for name, invariant in INVARIANTS.items() if FEATURES & {*invariant.needs}}
    assert set().union(*(wanted for _, wanted in BROKEN)) == names
