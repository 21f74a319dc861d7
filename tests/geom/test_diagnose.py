"""``diagnose``: planted faults are named and mended, clean captures raise no alarm."""

import re
import time
from typing import Any

import pytest
import torch
from diagnosis_cases import (
    FLIP,
    NAMED,
    Capture,
    Fault,
    captures,
    concerned,
    diagnosed,
    of_another_size,
    only,
    rays_of,
    seen_by,
    spoiled,
    with_translation,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from deltas_geom import PosedViews, ShapeError, diagnose, invert_pose, project
from deltas_geom.diagnosis.causes import CURES, Cause
from deltas_geom.diagnosis.evidence import distances, gather_evidence, residuals
from deltas_geom.diagnosis.results import Diagnosis, Explanation
from deltas_geom.diagnosis.trials import Trial, explains
from deltas_geom.testing import seeded_scene

# A diagnosis tries every cause: few examples, of which the first is a pattern that nothing moved.
ONE = settings(max_examples=max(1, settings.default.max_examples // 25))
PAIRS = settings(max_examples=2 * ONE.max_examples)
STILL = torch.zeros(4, 3).double()
ASIDE = torch.tensor([[0.0, 0, 0], [0.3, 0, 0], [0.6, 0, 0], [0.9, 0, 0]]).double()


# Shapes and errors.


def test_what_it_takes_is_checked() -> None:
    views, _, pixels = seeded_scene(1, num_views=3, num_points=9)
    cases: tuple[tuple[type[Exception], str, tuple[Any, ...], dict[str, Any]], ...] = (
        (ShapeError, "no batch dims", (views, pixels[None]), {}),
        (ShapeError, "no batch dims", (PosedViews(*(t[None] for t in views)), pixels), {}),
        (ShapeError, "2 views or more, got 1", (views.select([0]), pixels[:1]), {}),
        (ShapeError, "V = 2", (views, pixels[:2]), {}),
        (ShapeError, "mask", (views, pixels), {"mask": torch.ones(3, 8).bool()}),
        (TypeError, "mask must be bool", (views, pixels), {"mask": torch.ones(3, 9)}),
        (TypeError, "must be a torch.Tensor", (views, pixels.numpy()), {}),
        (ValueError, "threshold must be positive", (views, pixels), {"threshold": 0.0}),
        (ValueError, "K of camera 1", (views._replace(K=spoil(views.K)), pixels), {}),
        (
            ValueError,
            "cam_from_world of camera 1",
            (PosedViews(views.K, spoil(views[1])), pixels),
            {},
        ),
    )
    for error, words, arguments, options in cases:
        with pytest.raises(error, match=words):
            diagnose(*arguments, **options)


def spoil(tensor: Tensor) -> Tensor:
    changed = tensor.clone()
    changed[1, 0, 0] = torch.nan
    return changed


def test_every_cause_has_a_cure() -> None:
    assert CURES.keys() == set(Cause)


# Planted faults.


def check_mended(found: Diagnosis, cause: Cause, cameras: tuple[int, ...]) -> None:
    assert found.cause is cause, str(found)
    assert found.cameras == cameras and found.alternatives == ()
    assert found.residual_if_mended < 0.25 * found.residual_as_given
    views, pixels, mask = found.mended
    again = diagnose(views, pixels, mask=mask)
    assert again.well, str(again)
    assert again.residual_as_given <= found.residual_if_mended + 0.3


@NAMED
@PAIRS
@given(capture=captures("general"))
def test_a_planted_fault_is_named_and_mended(
    whose: str, cause: Cause, fault: Fault, capture: Capture
) -> None:
    found = diagnosed(fault(*capture))
    check_mended(found, cause, concerned(whose, cause))
    assert found.residual_if_mended < 0.02  # px


@NAMED
@ONE
@given(capture=captures("general", num_views=6))
def test_noise_and_mismatches_do_not_mislead(
    whose: str, cause: Cause, fault: Fault, capture: Capture
) -> None:
    found = diagnosed(fault(*capture[:2], spoiled(capture[2], wrong=0.3)))
    check_mended(found, cause, concerned(whose, cause))


@NAMED
@pytest.mark.parametrize("kind", ["forward", "handheld"])
@ONE
@given(data=st.data())
def test_a_fault_is_named_wherever_it_shows(
    kind: str, whose: str, cause: Cause, fault: Fault, data: st.DataObject
) -> None:
    capture = data.draw(captures(kind))
    found = diagnosed(fault(*capture[:2], spoiled(capture[2])))
    # A motion may hide a fault: then nothing is off, and nothing is said.
    if found.residual_as_given > 4 or not found.well:
        assert cause in {found.cause, *(other.cause for other in found.alternatives)}, str(found)


@pytest.mark.parametrize("factor", [0.5, 2.0, 1.2, 0.75, 3.0])
@ONE
@given(capture=captures("general"))
def test_the_factor_of_K_is_found(factor: float, capture: Capture) -> None:
    K, pose, pixels = capture
    found = diagnosed((of_another_size(K, factor), pose, spoiled(pixels)))
    assert found.cause is Cause.K_OF_OTHER_SIZE and found.factor is not None
    assert abs(found.factor * factor - 1) < 0.01
    told = re.search(r"which are (\S+) times as large", str(found))
    assert told is not None and abs(float(told[1]) / factor - 1) < 0.01


@pytest.mark.parametrize("factor", [1000.0, 0.01, 0.3048, 1.7])
@ONE
@given(capture=captures("general"))
def test_the_unit_of_a_translation_is_found(factor: float, capture: Capture) -> None:
    K, pose, pixels = only(1, lambda K, T, x: (K, with_translation(T, factor * T[:, :3, 3]), x))(
        *capture
    )
    found = diagnosed((K, pose, spoiled(pixels)))
    assert found.cause is Cause.UNIT_OF_TRANSLATION and found.camera == 1
    assert found.factor is not None and abs(found.factor * factor - 1) < 0.02


@given(capture=captures("general"))
@settings(max_examples=5)
def test_half_a_pixel_is_told_from_exact_matches_alone(capture: Capture) -> None:
    K, pose, pixels = capture
    exact = diagnosed((K, pose, pixels + 0.5))
    assert exact.cause is Cause.HALF_A_PIXEL and exact.factor == -0.5
    torch.testing.assert_close(exact.mended.pixels, pixels)
    noisy = diagnosed((K, pose, spoiled(pixels) + 0.5))
    assert noisy.well
    assert Cause.HALF_A_PIXEL in {other.cause for other in noisy.untold}


@pytest.mark.parametrize("seed", range(4))
def test_no_cure_makes_cameras_that_are_none(seed: int) -> None:
    """A transpose maps all pixels next to one, where nothing is off by much."""
    views, _, pixels = seeded_scene(seed, num_views=4, num_points=50)
    for seen in (pixels / 640, 2 * pixels / 640 - 1, rays_of(views.K, pixels)[..., :2]):
        found = diagnose(views, seen)
        assert found.cause is Cause.PIXELS_NORMALIZED and "P=K" in found.cure
    found = diagnose(views, pixels - torch.tensor([60.0, 40.0]))
    assert found.cause is Cause.CROPPED and "top=40)" in found.cure
    found.mended.views.check_values()


def test_points_in_the_place_of_views_are_noticed() -> None:
    K, pose, pixels = seen_by(0.15 * torch.randn(20, 3, generator=seeded()).double(), in_a_box(20))
    pixels = pixels[:, :20]
    found = diagnosed((K, pose, pixels.transpose(0, 1)))
    assert found.cause is Cause.POINTS_AS_VIEWS
    assert torch.equal(found.mended.pixels, pixels)


def seeded() -> torch.Generator:
    return torch.Generator().manual_seed(4)


def in_a_box(num_views: int) -> Tensor:
    return torch.rand(num_views, 3, generator=seeded()).double() - 0.5


# No alarm.


@pytest.mark.parametrize("kind", ["general", "forward", "handheld"])
@pytest.mark.parametrize("num_views", [2, 3, 10])
@ONE
@given(data=st.data())
def test_clean_captures_raise_no_alarm(kind: str, num_views: int, data: st.DataObject) -> None:
    K, pose, pixels = data.draw(captures(kind, num_views))
    for seen in (pixels, spoiled(pixels, wrong=0.0), spoiled(pixels), spoiled(pixels, wrong=0.3)):
        found = diagnosed((K, pose, seen))
        assert found.well and found.alternatives == (), str(found)


def test_what_is_not_observed_does_not_count() -> None:
    K, pose, pixels = seen_by(0.15 * torch.randn(6, 3, generator=seeded()).double(), in_a_box(6))
    mask = torch.rand(6, 150, generator=seeded()) < 0.7
    wild = torch.where(mask[..., None], pixels, 1e4)
    absent = torch.where(mask[..., None], pixels, torch.nan)
    wrong = PosedViews(K, invert_pose(pose))
    for found in (diagnose(wrong, wild, mask=mask), diagnose(wrong, absent)):
        assert found.cause is Cause.POSES_INVERTED and found.residual_if_mended < 1e-6
        assert torch.equal(found.mended.mask, mask)


def test_float32_is_enough() -> None:
    capture = seen_by(0.15 * torch.randn(5, 3, generator=seeded()).double(), in_a_box(5))
    K, pose, pixels = (tensor.float() for tensor in capture)
    assert diagnosed((K, pose, pixels)).well
    found = diagnosed((K, invert_pose(pose) @ FLIP.float(), pixels))
    assert found.cause is Cause.OPENGL_WORLD_FROM_CAM
    assert found.mended.views.cam_from_world.dtype == torch.float32
    with torch.device("meta"):  # torch's default does not matter
        again = diagnosed((K, invert_pose(pose) @ FLIP.float(), pixels))
    assert again.cause is found.cause


# What cannot be told is said to be so.


def test_a_pure_rotation_has_no_baseline() -> None:
    turn = torch.tensor([[0.0, 0, 0], [0.1, 0.2, 0], [-0.2, 0.1, 0.1], [0.1, -0.2, 0]]).double()
    K, pose, pixels = seen_by(turn, STILL)
    for seen in (pixels, spoiled(pixels)):
        found = diagnosed((K, pose, seen))
        assert found.cause is Cause.NO_BASELINE
        assert "cameras turn in one place or all is far away" in found.sentence
    _, _, moved = seen_by(turn, ASIDE)
    found = diagnosed((K, pose, moved))
    assert found.cause is Cause.NO_BASELINE and "matches move against it" in found.sentence


def test_cameras_that_do_not_turn_say_nothing_of_axes_and_K() -> None:
    found = diagnosed(seen_by(STILL, ASIDE, one_K=True))
    assert found.well
    untold = {other.cause for other in found.untold}
    assert {Cause.OPENGL_AXES, Cause.K_OF_OTHER_SIZE, Cause.HALF_A_PIXEL} <= untold
    assert "cannot tell" in str(found)


def test_causes_that_explain_as_much_are_all_named() -> None:
    # Where the first camera is the world, two exchanged views are an inverted pose.
    turn = torch.tensor([[0.0, 0, 0], [0.1, 0.2, 0.1]]).double()
    K, pose, pixels = seen_by(turn, ASIDE[:2], one_K=True)
    relative = torch.stack([torch.eye(4).double(), pose[1] @ invert_pose(pose[0])])
    found = diagnosed((K, relative, pixels.flip(0)))
    assert found.cause is Cause.POSES_INVERTED
    assert Cause.VIEWS_SWAPPED in {other.cause for other in found.alternatives}
    assert "cannot be told from VIEWS_SWAPPED" in str(found)


def test_two_causes_are_no_single_one() -> None:
    capture = seen_by(0.15 * torch.randn(6, 3, generator=seeded()).double(), in_a_box(6))
    for camera, sign in ((1, 1.0), (4, -1.0)):
        shift = sign * torch.tensor([0.3, -0.3, 0.2]).double()
        capture = only(camera, moved(shift))(*capture)
    found = diagnosed(capture)
    assert found.cause is Cause.NO_SINGLE_CAUSE
    assert {*found.camera_residuals.topk(2).indices.tolist()} == {1, 4}
    assert "camera 1 by" in found.sentence and "camera 4 by" in found.sentence


def moved(shift: Tensor) -> Fault:
    return lambda K, T, x: (K, with_translation(T, T[:, :3, 3] + shift), x)


def test_few_matches_tell_nothing() -> None:
    views, _, pixels = seeded_scene(1, num_views=3, num_points=7)
    assert diagnose(views, pixels).cause is Cause.TOO_FEW_MATCHES
    assert diagnose(views, pixels * torch.nan).cause is Cause.TOO_FEW_MATCHES


def test_a_ray_ends_at_the_epipole() -> None:
    """The measure, by hand: behind a camera a match is off by its parallax."""
    K = torch.eye(3).double().expand(2, 3, 3) * torch.tensor([100.0, 100, 1]).double()[:, None]
    pose = torch.eye(4).double().repeat(2, 1, 1)
    pose[1, 0, 3] = -1.0  # to the right: points move to the left
    first = torch.zeros(9, 2).double()
    for shift, wanted in ((-25.0, 0.0), (25.0, 25.0), (0.0, 0.0)):
        second = first + torch.tensor([shift, 0.0])
        pixels = torch.stack([first, second])
        evidence = gather_evidence(pixels, torch.ones(2, 9).bool())
        assert float(residuals(evidence, K, pose)) == pytest.approx(wanted)


def test_what_stands_between_cameras_that_face_each_other_fits() -> None:
    """Rays that come from behind the other camera, and end in front of it."""
    K = torch.eye(3).double().expand(2, 3, 3) * torch.tensor([100.0, 100, 1]).double()[:, None]
    pose = torch.eye(4).double().repeat(2, 1, 1)
    pose[1, :3] = torch.tensor([[-1.0, 0, 0, 0.3], [0, 1, 0, 0.1], [0, 0, -1, 4]])
    points = torch.rand(9, 3, generator=seeded(), dtype=torch.float64) + torch.tensor([-0.5, 0, 1])
    pixels = project(PosedViews(K, pose), points).pixels
    evidence = gather_evidence(pixels, torch.ones(2, 9).bool())
    assert float(distances(evidence, K, pose).max()) < 1e-9  # px


def test_it_takes_less_than_a_second() -> None:
    K, pose, pixels = seen_by(
        0.15 * torch.randn(20, 3, generator=seeded()).double(), in_a_box(20), num_points=500
    )
    taken = []
    for _ in range(3):
        start = time.process_time()
        assert diagnosed((K, invert_pose(pose), spoiled(pixels))).cause is Cause.POSES_INVERTED
        taken.append(time.process_time() - start)
    assert min(taken) < 2.0  # s of a core; 0.2 s where it is not shared


def test_an_explanation_names_its_cameras_and_its_factor() -> None:
    swapped = Explanation(Cause.VIEWS_SWAPPED, (1, 2), None, 0.5)
    assert str(swapped) == "VIEWS_SWAPPED, cameras 1 2: 0.5 px"
    unit = Explanation(Cause.UNIT_OF_TRANSLATION, (3,), 0.001, 0.25)
    assert str(unit) == "UNIT_OF_TRANSLATION, camera 3, times 0.001: 0.25 px"
    shift = Explanation(Cause.HALF_A_PIXEL, (), -0.5, 0.1)
    assert str(shift) == "HALF_A_PIXEL, -0.5 px: 0.1 px"


def test_one_wrong_camera_is_told_from_all_where_the_others_fit() -> None:
    # The first camera is the world, so it alone is its own inverse; each other meets it alone.
    turn = 0.2 * torch.randn(3, 3, generator=seeded()).double()
    K, pose, pixels = seen_by(turn, ASIDE[:3])
    pose = pose @ invert_pose(pose[:1])
    pose[2] = invert_pose(pose[2])
    mask = torch.ones(pixels.shape[:2], dtype=torch.bool)
    mask[1, ::2] = mask[2, 1::2] = False
    found = diagnose(PosedViews(K, pose), pixels, mask=mask)
    assert found.cause is Cause.POSES_INVERTED and found.cameras == (2,)


@pytest.mark.parametrize("before", [1.1, 10.0, 100.0])
@pytest.mark.parametrize(("after", "enough"), [(0.05, True), (1.5, False)])
def test_what_is_left_must_be_what_cameras_leave_that_fit(
    before: float, after: float, enough: bool
) -> None:
    hypothesis: Any = None  # residuals alone decide
    all_pairs = torch.ones(5, dtype=torch.bool)
    given, trial = (Trial(hypothesis, torch.full((5,), r), all_pairs) for r in (before, after))
    assert explains(given, trial, threshold=1.0) == enough
