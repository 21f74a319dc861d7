"""Depth is searched as finely as the widest view needs, and no finer."""

import dataclasses

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from deltas_geom import PosedViews
from deltas_nets.config import MatcherConfig
from deltas_nets.network.joint.inverse_depths import (
    best_of_bins,
    bin_centres,
    samples_per_bin,
    subdivide,
)
from deltas_nets.network.joint.matcher import JointMatcher
from deltas_nets.network.lite.descriptor import Descriptors
from deltas_nets.network.records import Matched

SIZE = (48, 64)
RANGE = (0.5, 10.0)
CENTRES = torch.linspace(0.1, 2.0, 64)
SPACING = 1.9 / 63


def in_a_row(baseline: float, *, focal: float = 60.0, num_views: int = 2) -> PosedViews:
    """A view set ``(1, V)`` of cameras that look ahead, ``baseline`` from the first to the last."""
    K = torch.tensor([[focal, 0, 31.5], [0, focal, 23.5], [0, 0, 1]])
    cam_from_world = torch.eye(4).repeat(num_views, 1, 1)
    cam_from_world[:, 0, 3] = -torch.linspace(0, baseline, num_views)
    return PosedViews(K.repeat(1, num_views, 1, 1), cam_from_world[None])


def counts_of(views: PosedViews, *, most: int = 8) -> Tensor:
    keypoints = torch.cartesian_prod(torch.arange(2.0, 64, 8), torch.arange(2.0, 48, 8))
    keypoints = keypoints.expand(len(views.K), -1, 2)
    return samples_per_bin(views, keypoints, CENTRES, step=1.5, most=most, image_size=SIZE)


def test_one_sample_a_bin_is_its_centre_exactly(dtype: torch.dtype) -> None:
    centres = bin_centres(64, RANGE, like=torch.zeros((), dtype=dtype))
    assert torch.equal(centres, torch.linspace(0.1, 2.0, 64, dtype=dtype))
    samples = subdivide(centres, torch.tensor([1, 1]), 1)
    assert torch.equal(samples, centres[None, :, None].expand(2, 64, 1))
    assert torch.equal(subdivide(centres, torch.tensor([1]), 4), samples[:1].expand(1, 64, 4))


@given(count=st.integers(1, 8))
def test_samples_divide_bins_evenly_and_symmetrically(count: int) -> None:
    samples = subdivide(CENTRES, torch.tensor([count]), count)[0]
    torch.testing.assert_close(samples.mean(dim=-1), CENTRES, rtol=0, atol=1e-6)
    apart = samples.flatten().diff()  # from bin to bin, too
    torch.testing.assert_close(apart, torch.full_like(apart, SPACING / count), rtol=0, atol=1e-6)
    assert ((samples - CENTRES[:, None]).abs() < SPACING / 2).all()


def test_no_sample_lies_beyond_infinity() -> None:
    samples = subdivide(torch.linspace(0, 2, 16), torch.tensor([8]), 8)
    assert (samples >= 0).all()
    assert (samples[0, 1:] > 0).all()


@given(baseline=st.floats(0.0, 2.0), focal=st.floats(20.0, 120.0), most=st.integers(1, 8))
def test_a_step_is_at_most_that_of_the_config_unless_there_are_as_many_as_may_be(
    baseline: float, focal: float, most: int
) -> None:
    count = int(counts_of(in_a_row(baseline, focal=focal), most=most))
    between_centres = focal * baseline * SPACING  # px, of cameras side by side
    assert 1 <= count <= most
    assert count == most or between_centres / count < 1.5 + 1e-3
    assert count == 1 or between_centres / (count - 1) > 1.5 - 1e-3


@given(baseline=st.floats(0.05, 2.0))
def test_the_widest_view_decides(baseline: float) -> None:
    both = in_a_row(baseline, num_views=3)
    assert counts_of(both) == counts_of(in_a_row(baseline))
    turned = PosedViews(*(tensor[:, [0, 2, 1]] for tensor in both))
    assert counts_of(turned) == counts_of(both)


def test_each_view_set_of_a_batch_has_its_own_number() -> None:
    sets = [in_a_row(baseline) for baseline in (0.1, 2.0, 4.0)]
    together = PosedViews(*(torch.cat(parts) for parts in zip(*sets, strict=True)))
    assert torch.equal(counts_of(together), torch.cat([counts_of(views) for views in sets]))
    assert counts_of(together).tolist() == [1, 3, 5]


def test_a_source_that_sees_nothing_needs_nothing() -> None:
    views = in_a_row(1.0)
    views.cam_from_world[:, 1] = torch.diag(torch.tensor([-1.0, 1, -1, 1]))
    assert counts_of(views) == 1


@given(
    scores=st.lists(st.floats(-1, 1, width=16), min_size=24, max_size=24),
    seen=st.lists(st.booleans(), min_size=24, max_size=24),
)
def test_the_best_sample_that_is_seen_speaks_for_its_bin(
    scores: list[float], seen: list[bool]
) -> None:
    fused, share = torch.tensor(scores).view(1, 1, 24), torch.tensor(seen).view(1, 1, 24).float()
    centres = torch.linspace(0.1, 2.0, 8)
    samples = subdivide(centres, torch.tensor([3]), 3)
    bins = best_of_bins(fused, share, samples, centres)
    for number in range(8):
        inside = [i for i in range(3 * number, 3 * number + 3) if seen[i]]
        found = bins.inv_depth[0, 0, number]
        if not inside:
            assert bins.share[0, 0, number] == 0
            assert found == centres[number]
            continue
        best = max(scores[i] for i in inside)
        places = [samples.flatten()[i] for i in inside if scores[i] == best]
        assert bins.score[0, 0, number] == best
        assert bins.share[0, 0, number] == 1
        assert any(found == place for place in places)


def wall(disparity: int, *, views: PosedViews) -> tuple[Descriptors, Tensor]:
    """Descriptors of a wall on which every place is unlike the next, and some of its keypoints.

    Sources see it shifted by ``disparity`` pixels for each step along the row.
    """
    number = views.K.shape[1]
    random = torch.Generator().manual_seed(0)
    strip = torch.randn(1, 32, 24, 128, generator=random)
    starts = [(64 + view * disparity) // 2 for view in range(number)]
    maps = torch.stack([strip[..., start : start + 32] for start in starts], dim=1)
    maps = torch.nn.functional.normalize(maps, dim=2)
    descriptors = Descriptors(maps, torch.zeros(1, number, 48, 6, 8))
    # Centres of the map's cells: there a peak is sharp.
    keypoints = torch.cartesian_prod(torch.arange(40.5, 64, 2), torch.arange(4.5, 44, 4))
    return descriptors, keypoints[None]


def matched(
    matcher: JointMatcher,
    views: PosedViews,
    descriptors: Descriptors,
    keypoints: Tensor,
    **options: int,
) -> Matched:
    with torch.no_grad():
        return matcher(keypoints, descriptors, views, image_size=SIZE, depth_range=RANGE, **options)


def matcher_of(max_refinement: int) -> JointMatcher:
    torch.manual_seed(0)
    return JointMatcher(MatcherConfig(max_refinement=max_refinement, context_rounds=0), 32).eval()


def test_a_peak_between_the_centres_of_a_wide_baseline_is_found() -> None:
    # 4.5 px between centres; the wall is at half of it.
    baseline = 4.5 / (60 * SPACING)
    views = in_a_row(baseline)
    inv_depth = float(CENTRES[2] + CENTRES[3]) / 2
    disparity = 60 * baseline * inv_depth
    scale = round(disparity / 2) * 2 / disparity  # a whole number of the map's cells
    views = in_a_row(baseline * scale)
    descriptors, keypoints = wall(round(disparity * scale), views=views)
    found = {}
    for most in (1, 8):
        chosen = matched(matcher_of(most), views, descriptors, keypoints).chosen
        assert chosen is not None
        found[most] = ((chosen.inv_depth - inv_depth).abs() < SPACING / 3).float().mean()
    assert found[8] > 0.95
    assert found[1] < 0.7


@pytest.mark.parametrize("baseline", [0.2, 1.5, 4.0])
def test_room_for_all_samples_that_are_needed_gives_the_same_matches(baseline: float) -> None:
    views = in_a_row(baseline, num_views=3)
    descriptors, keypoints = wall(6, views=views)
    matcher = matcher_of(8)
    usual = matched(matcher, views, descriptors, keypoints)
    roomy = matched(matcher, views, descriptors, keypoints, refinement=8)
    beyond = matched(matcher, views, descriptors, keypoints, refinement=20)
    for other in (roomy, beyond):
        torch.testing.assert_close(other.matches.pixels, usual.matches.pixels, rtol=0, atol=1e-4)
        torch.testing.assert_close(other.confidence, usual.confidence, rtol=0, atol=1e-5)


@pytest.mark.parametrize("baseline", [0.2, 1.5, 4.0])
def test_the_order_of_sources_changes_nothing(baseline: float) -> None:
    views = in_a_row(baseline, num_views=4)
    descriptors, keypoints = wall(4, views=views)
    order = [0, 3, 1, 2]
    matcher = matcher_of(8)
    straight = matched(matcher, views, descriptors, keypoints)
    turned = matched(
        matcher,
        PosedViews(*(tensor[:, order] for tensor in views)),
        Descriptors(*(part[:, order] for part in descriptors)),
        keypoints,
    )
    torch.testing.assert_close(
        turned.matches.pixels, straight.matches.pixels[:, order], rtol=0, atol=1e-3
    )
    torch.testing.assert_close(turned.confidence, straight.confidence, rtol=0, atol=1e-4)


def test_what_a_view_set_is_batched_with_changes_nothing() -> None:
    sets = [in_a_row(baseline, num_views=3) for baseline in (0.2, 4.0)]
    descriptors, keypoints = wall(4, views=sets[0])
    matcher = matcher_of(8)
    together = matched(
        matcher,
        PosedViews(*(torch.cat(parts) for parts in zip(*sets, strict=True))),
        Descriptors(*(part.repeat(2, 1, 1, 1, 1) for part in descriptors)),
        keypoints.repeat(2, 1, 1),
    )
    for number, views in enumerate(sets):
        alone = matched(matcher, views, descriptors, keypoints)
        torch.testing.assert_close(
            together.matches.pixels[number], alone.matches.pixels[0], rtol=0, atol=1e-4
        )


def test_nonsense_is_refused() -> None:
    for wrong in ({"step": 0.0}, {"step": float("nan")}, {"max_refinement": 0}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            dataclasses.replace(MatcherConfig(), **wrong)  # type: ignore[arg-type]
