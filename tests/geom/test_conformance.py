"""The invariants as a package: deltas passes all, wrong implementations fail the right ones."""

import re
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from deltas_geom import PosedViews, ShapeError, triangulate_points
from deltas_geom.fundamental import cross_matrix, inverse_intrinsics
from deltas_geom.testing import DEGENERATE_SCENES, PosedScene, forward_motion, rigid
from deltas_geom.testing.__main__ import main
from deltas_geom.testing.conformance import check, conformance, scenes_for, seeded_scene, table
from deltas_geom.testing.invariants import INVARIANTS, World, first_views
from deltas_geom.testing.strategies import posed_scenes, scales, vectors
from deltas_geom.testing.targets import KORNIA_SOLVERS, KorniaSolver, Target, deltas, kornia, opencv

DOCS = Path(__file__).resolve().parents[2] / "docs" / "testing.md"
OURS = deltas()
POSED = [name for name, invariant in INVARIANTS.items() if invariant.scenes == "posed"]
OF_CAMERAS = [name for name in POSED if {"project", "fundamental"} & {*INVARIANTS[name].needs}]
OF_WORLDS = [name for name in POSED if "frame" in name or name == "points_move_with_the_world"]


@st.composite
def noisy(draw: st.DrawFn) -> PosedScene:
    """Three views of two points, up to half a pixel off."""
    scene = draw(posed_scenes(num_views=3, num_points=2))
    return scene._replace(pixels=scene.pixels + draw(vectors(6, within=0.5, size=2)).view(3, 2, 2))


@given(scene=noisy())
@pytest.mark.parametrize("name", POSED)
def test_deltas_passes_on_drawn_scenes(name: str, scene: PosedScene) -> None:
    INVARIANTS[name](OURS, scene)


@given(scene=noisy(), turn=vectors(1, within=3.0), shift=vectors(1, within=10.0), scale=scales())
@pytest.mark.parametrize("name", OF_WORLDS)
def test_deltas_passes_in_drawn_worlds(
    name: str, scene: PosedScene, turn: Tensor, shift: Tensor, scale: float
) -> None:
    INVARIANTS[name](OURS, scene, world=World(rigid(turn, shift)[0], scale))


@given(scene=noisy(), view=st.integers(0, 2), spoil=st.sampled_from([0.0, 1e9, torch.nan]))
def test_deltas_does_not_look_at_a_view_of_weight_0(
    scene: PosedScene, view: int, spoil: float
) -> None:
    INVARIANTS["a_view_of_weight_0_is_a_view_removed"](OURS, scene, view=view, spoil=spoil)


@pytest.mark.parametrize("name", INVARIANTS)
def test_deltas_passes_on_every_fixed_scene(name: str) -> None:
    assert check(name, OURS).example == ""


@given(scene=posed_scenes(num_views=2, num_points=2))
@pytest.mark.parametrize("name", OF_CAMERAS)
def test_kornias_cameras_pass_on_drawn_scenes(name: str, scene: PosedScene) -> None:
    INVARIANTS[name](kornia(), scene)


@given(scene=posed_scenes(num_views=2, num_points=2))
@pytest.mark.parametrize("solver", KORNIA_SOLVERS)
def test_kornia_is_exact_without_noise(solver: KorniaSolver, scene: PosedScene) -> None:
    INVARIANTS["points_are_exact_without_noise"](kornia(solver), scene)


@given(scene=posed_scenes(num_views=2, num_points=2))
def test_opencv_is_exact_without_noise(scene: PosedScene) -> None:
    INVARIANTS["points_are_exact_without_noise"](opencv(), scene)


# Wrong implementations, each with exactly what it fails.


def heavier(proj: Tensor, pixels: Tensor, weights: Tensor | None) -> Tensor:
    assert weights is not None
    return triangulate_points(proj, pixels, weights + 0.1)


def svd_points(proj: Tensor, pixels: Tensor, weights: Tensor | None) -> Tensor:
    """In the world's frame, as in the book."""
    rows = pixels[..., None] * proj[:, None, 2:] - proj[:, None, :2]
    rows = rows if weights is None else weights[..., None, None] * rows
    null: Tensor = torch.linalg.svd(rows.transpose(0, 1).flatten(1, 2)).Vh[:, -1]
    return null[:, :3] / null[:, 3:]


def first_view_counts_twice(proj: Tensor, pixels: Tensor, weights: Tensor | None) -> Tensor:
    assert weights is not None
    return triangulate_points(proj, pixels, torch.cat([2 * weights[:1], weights[1:]]))


def spread(proj: Tensor, pixels: Tensor, weights: Tensor | None) -> Tensor:
    points = triangulate_points(proj, pixels, weights)
    return points + 1e-3 * (points - points.mean(dim=0))


def constant(proj: Tensor, pixels: Tensor, weights: Tensor | None) -> Tensor:
    points = triangulate_points(proj, pixels, weights)
    return points.detach() + 0 * points


def unguarded_pixels(K: Tensor, cam_from_world: Tensor, points: Tensor) -> Tensor:
    homogeneous = torch.nn.functional.pad(points, (0, 1), value=1.0)
    seen = homogeneous @ PosedViews(K, cam_from_world).proj.mT
    return seen[..., :2] / seen[..., 2:]


def our_pixels(K: Tensor, cam_from_world: Tensor, points: Tensor) -> Tensor:
    assert OURS.project is not None
    return OURS.project(K, cam_from_world, points)


def our_fundamental(K: Tensor, cam_from_world: Tensor) -> Tensor:
    assert OURS.fundamental is not None
    return OURS.fundamental(K, cam_from_world)


def fundamental_of_a_first_view_at_the_origin(K: Tensor, cam_from_world: Tensor) -> Tensor:
    essential = cross_matrix(cam_from_world[1, :3, 3]) @ cam_from_world[1, :3, :3]
    return inverse_intrinsics(K[1]).mT @ essential @ inverse_intrinsics(K[0])


def unit_fundamental(K: Tensor, cam_from_world: Tensor) -> Tensor:
    fundamental = our_fundamental(K, cam_from_world)
    unit: Tensor = fundamental / fundamental.norm()
    return unit


BROKEN: list[tuple[Target, set[str]]] = [
    (
        Target("1 mm off", triangulate=lambda p, x, w: triangulate_points(p, x, w) + 1e-3),
        {"points_are_exact_without_noise", "points_move_with_the_world"},
    ),
    (
        Target("weights ignored", triangulate=lambda p, x, w: triangulate_points(p, x)),
        {"a_view_of_weight_0_is_a_view_removed", "a_doubled_view_is_a_doubled_squared_weight"},
    ),
    (
        Target("weights plus 0.1", triangulate=heavier),
        {
            "only_the_ratios_of_weights_count",
            "a_view_of_weight_0_is_a_view_removed",
            "a_doubled_view_is_a_doubled_squared_weight",
        },
    ),
    (
        Target("pixels stretched", triangulate=lambda p, x, w: triangulate_points(p, 1.001 * x, w)),
        {"points_are_exact_without_noise", "points_do_not_know_of_a_crop_and_a_resize"},
    ),
    (
        Target("first view twice", triangulate=first_view_counts_twice),
        {"points_do_not_know_the_order_of_views"},
    ),
    (
        Target("spread", triangulate=spread),
        {"points_are_exact_without_noise", "many_points_are_solved_as_each_alone"},
    ),
    (
        Target("no gradient", triangulate=constant),
        {"gradients_are_finite_differences", "gradients_are_finite_differences_at_ties"},
    ),
    (
        Target("svd", triangulate=lambda p, x, w: svd_points(p, x, w) + 0 / (p[0] - p[1]).norm()),
        {
            "points_move_with_the_world",
            "gradients_are_finite_differences_at_ties",
            "points_are_finite",
            "gradients_are_finite",
        },
    ),
    (
        Target("transposed", fundamental=lambda k, t: our_fundamental(k, t).mT),
        {
            "a_match_lies_on_its_epipolar_line",
            "the_fundamental_matrix_follows_a_crop_and_a_resize",
        },
    ),
    (
        Target("at the origin", fundamental=fundamental_of_a_first_view_at_the_origin),
        {
            "a_match_lies_on_its_epipolar_line",
            "the_fundamental_matrix_back_is_the_transpose",
            "the_fundamental_matrix_does_not_know_the_worlds_frame",
        },
    ),
    (Target("unit F", fundamental=unit_fundamental), {"the_fundamental_matrix_is_finite"}),
    (
        Target("no lines", fundamental=lambda k, t: 0 * our_fundamental(k, t)),
        {"a_match_lies_on_its_epipolar_line"},
    ),
    (
        Target("centres at 0.5", project=lambda k, t, x: our_pixels(k, t, x) + 0.5),
        {"pixels_are_those_of_the_camera_equations", "pixels_follow_a_crop_and_a_resize"},
    ),
    (
        Target("whole mm", project=lambda k, t, x: our_pixels(k, t, (1e3 * x).round() / 1e3)),
        {"pixels_are_those_of_the_camera_equations", "pixels_do_not_know_the_worlds_frame"},
    ),
    (Target("unguarded", project=unguarded_pixels), {"pixels_are_finite"}),
]


def failures(target: Target) -> set[str]:
    return {outcome.invariant for outcome in conformance([target]) if outcome.result == "FAIL"}


@pytest.mark.parametrize(("target", "wanted"), BROKEN, ids=[target.name for target, _ in BROKEN])
def test_a_wrong_implementation_fails_what_it_should(target: Target, wanted: set[str]) -> None:
    assert failures(target) == wanted


def test_every_invariant_can_fail() -> None:
    assert set().union(*(wanted for _, wanted in BROKEN)) == set(INVARIANTS)


# What surrounds the invariants.


def test_what_is_not_offered_is_not_asked() -> None:
    two_views = Target("two", triangulate=triangulate_points, max_views=2)
    results = {outcome.invariant: outcome.result for outcome in conformance([two_views])}
    assert results["points_are_exact_without_noise"] == "pass"
    assert results["only_the_ratios_of_weights_count"] == "pass"
    for name in ("a_view_of_weight_0_is_a_view_removed", *POSED[:2], "pixels_are_finite"):
        assert results[name] == "-"
    assert {outcome.result for outcome in conformance([Target("nothing")])} == {"-"}
    with pytest.raises(ValueError, match="max_views must be 2 or more, or None, got 1"):
        replace(two_views, max_views=1)


def test_an_exception_of_the_target_is_its_failure() -> None:
    def raises(K: Tensor, cam_from_world: Tensor, points: Tensor) -> Tensor:
        raise ShapeError("no such shape")

    outcome = check("pixels_are_finite", Target("raises", project=raises))
    assert outcome.result == "FAIL" and "ShapeError: no such shape" in outcome.example


def test_every_invariant_states_its_theorem() -> None:
    for invariant in INVARIANTS.values():
        assert re.fullmatch(r"[A-Zx].*\.( \(.*\))?", invariant.theorem)
        assert len(invariant.theorem) < 120


def test_the_fixed_scenes_come_smallest_first() -> None:
    scenes = [make() for make in scenes_for(INVARIANTS["points_are_exact_without_noise"])]
    sizes = [scene.pixels.shape[0] * scene.pixels.shape[1] for scene in scenes]
    assert sizes == sorted(sizes)
    assert all(torch.isfinite(scene.pixels).all() for scene in scenes)
    named = scenes_for(INVARIANTS["points_are_finite"])
    assert len(named) == 2 * len(DEGENERATE_SCENES)
    assert first_views(forward_motion(), 1).pixels.shape == (1, 3, 2)


def test_the_example_is_a_call_that_can_be_pasted() -> None:
    example = check("points_move_with_the_world", opencv()).example
    call = example.split(": ")[0]
    scene = eval(call, {"seeded_scene": seeded_scene})
    with pytest.raises(AssertionError, match=r"off by 0\.00054, allowed 1e-06 m"):
        INVARIANTS["points_move_with_the_world"](opencv(), scene)


def test_the_command_prints_the_table(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--target", "all"]) == 0
    printed = capsys.readouterr().out
    head, *rows = printed.splitlines()
    assert re.split(r"\s{2,}", head.strip()) == [
        "deltas", "kornia eigh", "kornia svd", "kornia cofactor", "opencv",
    ]  # fmt: skip
    cells = {row[0]: row[1:] for row in (re.split(r"\s{2,}", line) for line in rows)}
    assert all(cells[name.replace("_", " ")][0] == "pass" for name in INVARIANTS)
    assert cells["points move with the world"] == ["pass", "FAIL", "FAIL", "FAIL", "FAIL"]
    assert cells["only the ratios of weights count"] == ["pass", "-", "-", "-", "-"]
    assert "opencv: Where cameras are moved" in printed
    assert "seeded_scene(0, noise=1.0): " in printed


def test_the_exit_code_is_about_deltas_alone(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert main(["--target", "kornia"]) == 0
    assert "FAIL" in capsys.readouterr().out
    broken = replace(BROKEN[0][0], name="deltas")
    monkeypatch.setattr("deltas_geom.testing.__main__.deltas", lambda: broken)
    assert main(["--target", "deltas"]) == 1
    assert "points are exact without noise" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        main(["--target", "colmap"])


def test_without_opencv_the_error_names_the_extra(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(ImportError, match=r"pip install 'deltas-depth\[test\]'"):
        opencv()
    assert main(["--target", "opencv"]) == 2
    assert "deltas-depth[test]" in capsys.readouterr().err


def test_an_empty_table_is_no_error() -> None:
    assert table([]).strip() == ""


def test_the_page_runs(capsys: pytest.CaptureFixture[str]) -> None:
    (snippet,) = re.findall(r"^```python\n(.*?)^```$", DOCS.read_text(), re.DOTALL | re.MULTILINE)
    exec(compile(snippet, "docs/testing.md", "exec"), {"__name__": "page"})
    failed = re.findall(r"^(.*?) +FAIL", capsys.readouterr().out, re.MULTILINE)
    assert {"points move with the world", "gradients are finite differences at ties"} <= {*failed}
    assert "points are exact without noise" not in failed
