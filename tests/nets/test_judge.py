"""What triangulation tells corrects the confidence, and never moves a point."""

from typing import NamedTuple

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from deltas_geom import Matches, PosedViews, Triangulation, triangulate
from deltas_nets.captures.posed_images import PosedImages
from deltas_nets.config import CONFIGS, DetectorConfig, NetworkConfig
from deltas_nets.network.deltas import Deltas
from deltas_nets.network.joint.judge import Judge, of_posterior, of_refinement, of_triangulation
from deltas_nets.network.records import Chosen, Matched, Posterior
from deltas_nets.rooms import render_room

SIZE = (64, 96)


class Case(NamedTuple):
    """What a judge judges by."""

    chosen: Chosen
    matches: Matches
    posterior: Posterior
    points: Triangulation
    views: PosedViews


@pytest.fixture(scope="module")
def room() -> PosedImages:
    return render_room(3, num_views=4, image_size=SIZE)


@pytest.fixture(scope="module")
def model() -> Deltas:
    torch.manual_seed(0)
    return Deltas(NetworkConfig(detector=DetectorConfig(num_keypoints=64))).eval()


def case_of(model: Deltas, room: PosedImages) -> Case:
    """The room as an untrained network sees it: right, wrong and unseen points."""
    views = PosedViews(*(tensor[None] for tensor in room.views))
    features, descriptors = model.encode(room.images[None].float() / 255)
    keypoints = model.detector(features, image_size=SIZE, num_keypoints=None, shift=None).pixels
    found: Matched = model.matcher(
        keypoints, descriptors, views, image_size=SIZE, depth_range=(0.5, 10.0)
    )
    matches = found.matches
    points = triangulate(views.proj, matches.pixels, matches.weights, matches.mask)
    assert found.chosen is not None
    return Case(found.chosen, matches, found.posterior, points, views)


@pytest.fixture(scope="module")
def case(model: Deltas, room: PosedImages) -> Case:
    with torch.no_grad():
        return case_of(model, room)


def taught() -> Judge:
    """One that corrects."""
    torch.manual_seed(0)
    judge = Judge(window=2)
    torch.nn.init.normal_(judge.correction[-1].weight)  # type: ignore[arg-type]
    return judge


def clues_of(case: Case) -> Tensor:
    return torch.cat(
        [
            of_triangulation(case.chosen, case.matches, case.points, case.views),
            of_refinement(case.chosen, case.matches),
            of_posterior(case.posterior, window=2),
        ],
        dim=-1,
    )


def test_it_starts_with_no_correction(model: Deltas, room: PosedImages, case: Case) -> None:
    with torch.no_grad():
        confidence = Judge(window=2)(*case)
        prediction = model(room.images.float() / 255, room.views)
    before = torch.where(case.chosen.seen, case.chosen.logit.sigmoid(), 0.0)
    assert torch.equal(confidence, before)
    torch.testing.assert_close(prediction.evidence.confidence, before[0], rtol=0, atol=1e-6)


def test_a_correction_changes_confidence_alone(
    model: Deltas, room: PosedImages, case: Case, monkeypatch: pytest.MonkeyPatch
) -> None:
    images = room.images.float() / 255
    with torch.no_grad():
        before = model(images, room.views)
        monkeypatch.setattr(model, "judge", taught())
        after = model(images, room.views)
    assert torch.equal(after.points.points, before.points.points)
    assert torch.equal(after.matches.weights, before.matches.weights)
    moved = (after.evidence.confidence - before.evidence.confidence).abs()
    assert moved.max() > 0.01


def test_the_order_of_sources_changes_nothing(case: Case) -> None:
    judge, order = taught(), [0, 3, 1, 2]
    turned = case._replace(
        chosen=case.chosen._replace(moved=case.chosen.moved[:, [2, 0, 1]]),
        matches=Matches(*(each[:, order] for each in case.matches)),
        views=PosedViews(*(each[:, order] for each in case.views)),
    )
    with torch.no_grad():
        torch.testing.assert_close(judge(*turned), judge(*case), rtol=0, atol=1e-5)


@given(
    size=st.sampled_from([0.0, 1e-30, 1e-6, 1.0, 1e6, 1e30]),
    other=st.sampled_from([0.0, 1e-30, 1.0, 1e30]),
    seen=st.booleans(),
    valid=st.booleans(),
)
def test_clues_are_bounded_whatever_happens(
    case: Case, size: float, other: float, seen: bool, valid: bool
) -> None:
    points = case.points._replace(
        residual=torch.full_like(case.points.residual, size),
        points=torch.full_like(case.points.points, other),
        depth=torch.full_like(case.points.depth, size),
        valid=torch.full_like(case.points.valid, valid),
    )
    matches = case.matches._replace(
        covariance=torch.full_like(case.matches.covariance, size),
        mask=torch.full_like(case.matches.mask, seen),
    )
    chosen = case.chosen._replace(
        inv_depth=torch.full_like(case.chosen.inv_depth, other),
        moved=torch.full_like(case.chosen.moved, size),
    )
    stages = tuple(size * stage.sign() for stage in case.posterior.stages)
    posterior = case.posterior._replace(stages=stages)
    clues = clues_of(Case(chosen, matches, posterior, points, case.views))
    assert clues.isfinite().all()
    assert (clues.abs() <= 10).all()


def test_points_that_no_source_sees_have_no_confidence(case: Case) -> None:
    nowhere = torch.zeros_like(case.chosen.seen)
    matches = case.matches._replace(mask=torch.zeros_like(case.matches.mask))
    points = triangulate(case.views.proj, matches.pixels, matches.weights, matches.mask)
    chosen = case.chosen._replace(seen=nowhere)
    chosen.embedding.requires_grad_()
    judge = taught()
    confidence = judge(chosen, matches, case.posterior, points, case.views)
    assert (confidence == 0).all()
    confidence.sum().backward()
    gradients = [parameter.grad for parameter in judge.parameters()]
    assert all(gradient is not None and gradient.isfinite().all() for gradient in gradients)


def test_no_gradient_passes_through_clues_to_descriptors(model: Deltas, room: PosedImages) -> None:
    case = case_of(model, room)
    assert case.points.residual.requires_grad and case.chosen.evidence.requires_grad
    cut = case.chosen._replace(
        logit=case.chosen.logit.detach(), embedding=case.chosen.embedding.detach()
    )
    judge = taught()
    confidence = judge(cut, *case[1:])
    judged = [parameter.grad for parameter in judge.parameters()]
    assert judged == [None] * 4
    confidence.square().sum().backward()
    assert all(parameter.grad is not None for parameter in judge.parameters())
    assert [name for name, p in model.named_parameters() if p.grad is not None] == []


def test_the_embedding_learns_to_tell_about_confidence(model: Deltas, room: PosedImages) -> None:
    case = case_of(model, room)
    embedding, logit = case.chosen.embedding, case.chosen.logit
    confidence = taught()(*case)
    gradients = torch.autograd.grad(confidence.square().sum(), [embedding, logit])
    assert all(gradient.abs().max() > 0 for gradient in gradients)


def test_rays_that_meet_where_it_was_decided_are_as_expected(case: Case) -> None:
    decided = torch.where(case.points.valid, 1 / case.points.depth[:, 0].clamp_min(1e-3), 1.0)
    chosen = case.chosen._replace(inv_depth=decided)
    clues = of_triangulation(chosen, case.matches, case.points, case.views)
    assert case.points.valid.any()
    assert (clues[..., 3][case.points.valid] < 1e-4).all()
    torch.testing.assert_close(clues[..., 4], case.points.valid.float())
    twice = of_triangulation(
        chosen._replace(inv_depth=2 * decided), case.matches, case.points, case.views
    )
    expected = torch.full_like(twice[..., 3], 2).log()[case.points.valid]
    torch.testing.assert_close(twice[..., 3][case.points.valid], expected, rtol=1e-4, atol=1e-4)


def test_the_parallax_is_that_of_the_widest_source(case: Case) -> None:
    two = case.matches.mask.clone()
    two[:, 2:] = False
    one = case.matches._replace(mask=two)
    alone = triangulate(case.views.proj, one.pixels, one.weights, one.mask)
    valid = alone.valid & (alone.parallax > 2e-3) & (alone.parallax < 0.2)
    assert valid.sum() > 10
    clues = of_triangulation(case.chosen, one, alone, case.views)
    torch.testing.assert_close(
        clues[..., 1][valid], alone.parallax.log10()[valid] + 1, rtol=0, atol=2e-3
    )


def test_a_second_mode_counts_outside_the_window_alone() -> None:
    logits = torch.zeros(1, 1, 3, 16)
    logits[..., 5] = 4.0
    logits[0, 0, 1, 7] = 3.0  # beside the peak
    logits[0, 0, 2, 8] = 3.0
    clues = of_posterior(Posterior((logits,), torch.arange(16.0), logits > 0), window=2)
    torch.testing.assert_close(5 * clues[0, :, 0], torch.tensor([4.0, 4.0, 1.0]))
    assert (clues[..., 1] == 0).all()


def test_the_papers_networks_have_none() -> None:
    model = Deltas(CONFIGS["deltas-vgg9"]).eval()
    assert model.judge is None
    assert not [name for name in model.state_dict() if name.startswith("judge")]
    room = render_room(1, num_views=2, image_size=SIZE)
    with torch.no_grad():
        prediction = model(room.images.float() / 255, room.views, num_keypoints=32)
    weights = torch.where(prediction.matches.mask, prediction.matches.weights, 0.0)
    assert torch.equal(prediction.evidence.confidence, weights[1:].amax(dim=0))
