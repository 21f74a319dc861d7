"""The invariants as a package: deltas passes all, wrong implementations fail the right ones."""

import io
import re
import sys
from collections.abc import Callable
from contextlib import redirect_stdout
from dataclasses import fields, replace
from itertools import product
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import find, given, settings
from hypothesis import strategies as st
from torch import Tensor

import deltas_geom
from deltas_geom import ShapeError, Status, triangulate_points
from deltas_geom.cameras.homogeneous import to_homogeneous
from deltas_geom.cameras.poses import camera_centers
from deltas_geom.testing import (
    DEGENERATE_SCENES,
    PosedScene,
    forward_motion,
    rigid,
    seeded_depths,
    seeded_map,
    seeded_scene,
    seeded_scores,
    strategies,
)
from deltas_geom.testing.__main__ import main
from deltas_geom.testing.agreement import assert_near, assert_status
from deltas_geom.testing.conformance import Outcome, check, conformance, scenes_for, table
from deltas_geom.testing.invariants import INVARIANTS, World, first_views
from deltas_geom.testing.planar import MapScene, ScoreScene
from deltas_geom.testing.strategies import map_scenes, posed_scenes, scales, score_scenes, vectors
from deltas_geom.testing.targets import (
    KORNIA_SOLVERS,
    TARGETS,
    KorniaSolver,
    Target,
    deltas,
    kornia,
    opencv,
    plain_torch,
)

DOCS = Path(__file__).resolve().parents[2] / "docs" / "testing.md"
OURS = deltas()
FUNCTIONS = [field.name for field in fields(Target) if callable(getattr(OURS, field.name))]
PLANAR = ("maps", "scores", "depths")
SOLVING = {"triangulate", "gradients", "batches", "judge", "refine"}
POSED = [name for name, invariant in INVARIANTS.items() if invariant.scenes == "posed"]
SOLVED = [name for name in POSED if SOLVING & {*INVARIANTS[name].needs}]
# A derivative by each entry of cameras and pixels is many solutions.
SLOW = ["gradients_are_finite_differences", "float32_is_as_good_as_rounding_the_input"]
OF_CAMERAS = [name for name in POSED if {"project", "fundamental"} & {*INVARIANTS[name].needs}]
OF_MAPS = [name for name, invariant in INVARIANTS.items() if invariant.needs == ("sample_map",)]
OF_SCORES = [name for name, invariant in INVARIANTS.items() if invariant.scenes == "scores"]
OF_HEATMAPS = [name for name in OF_SCORES if "heatmap_argmax" in INVARIANTS[name].needs]


@st.composite
def noisy(draw: st.DrawFn) -> PosedScene:
    """Three views of two points, up to half a pixel off."""
    scene = draw(posed_scenes(num_views=3, num_points=2))
    return scene._replace(pixels=scene.pixels + draw(vectors(6, within=0.5, size=2)).view(3, 2, 2))


@given(scene=noisy())
@pytest.mark.parametrize("name", [name for name in SOLVED if name not in SLOW])
def test_deltas_solves_drawn_scenes(name: str, scene: PosedScene) -> None:
    INVARIANTS[name](OURS, scene)


@given(scene=noisy())
@settings(max_examples=8)
@pytest.mark.parametrize("name", SLOW)
def test_deltas_has_derivatives_on_drawn_scenes(name: str, scene: PosedScene) -> None:
    INVARIANTS[name](OURS, scene)


@given(scene=noisy(), turn=vectors(1, within=3.0), shift=vectors(1, within=10.0), scale=scales())
def test_deltas_solves_in_drawn_worlds(
    scene: PosedScene, turn: Tensor, shift: Tensor, scale: float
) -> None:
    world = World(rigid(turn, shift)[0], scale)
    INVARIANTS["points_move_with_the_world"](OURS, scene, world=world)


@given(scene=noisy(), start=vectors(2, within=0.5))
def test_deltas_refines_from_drawn_starts(scene: PosedScene, start: Tensor) -> None:
    INVARIANTS["refined_points_fit_no_worse"](OURS, scene, start=scene.points + start)


@given(scene=score_scenes())
@pytest.mark.parametrize("name", OF_SCORES)
def test_deltas_averages_drawn_scores(name: str, scene: ScoreScene) -> None:
    INVARIANTS[name](OURS, scene)


@given(scene=noisy(), view=st.integers(0, 2), spoil=st.sampled_from([0.0, 1e9, torch.nan]))
def test_deltas_does_not_look_at_a_view_of_weight_0(
    scene: PosedScene, view: int, spoil: float
) -> None:
    INVARIANTS["a_view_of_weight_0_is_a_view_removed"](OURS, scene, view=view, spoil=spoil)


@given(scene=posed_scenes(num_views=2, num_points=2))
@pytest.mark.parametrize("name", OF_CAMERAS)
def test_kornias_cameras_pass_on_drawn_scenes(name: str, scene: PosedScene) -> None:
    INVARIANTS[name](kornia(), scene)


@given(scene=posed_scenes(num_views=2, num_points=2))
@pytest.mark.parametrize("solver", KORNIA_SOLVERS)
def test_kornia_is_exact_without_noise(solver: KorniaSolver, scene: PosedScene) -> None:
    INVARIANTS["points_are_exact_without_noise"](kornia(solver), scene)


@given(scene=map_scenes())
@pytest.mark.parametrize("name", OF_MAPS)
def test_torch_and_kornia_read_drawn_maps(name: str, scene: MapScene) -> None:
    for target in (plain_torch(), kornia()):
        INVARIANTS[name](target, scene)


@given(scene=score_scenes())
@pytest.mark.parametrize("name", OF_HEATMAPS)
def test_kornia_averages_drawn_heatmaps(name: str, scene: ScoreScene) -> None:
    INVARIANTS[name](kornia(), scene)


@given(scene=posed_scenes(num_views=2, num_points=2))
def test_opencv_is_exact_without_noise(scene: PosedScene) -> None:
    INVARIANTS["points_are_exact_without_noise"](opencv(), scene)


# What surrounds the invariants.


def test_what_is_not_offered_is_not_asked() -> None:
    two_views = Target("two", triangulate=triangulate_points, max_views=2, differentiable=False)
    results = {outcome.invariant: outcome.result for outcome in conformance([two_views])}
    assert results["points_are_exact_without_noise"] == "pass"
    assert results["only_the_ratios_of_weights_count"] == "pass"
    others = ("pixels_are_finite", "one_view_is_too_few", "the_nearest_point_wins")
    for name in ("a_view_of_weight_0_is_a_view_removed", *POSED[:2], *others):
        assert results[name] == "-"
    assert {outcome.result for outcome in conformance([Target("nothing")])} == {"-"}
    with pytest.raises(ValueError, match="max_views must be 2 or more, or None, got 1"):
        replace(two_views, max_views=1)


def test_an_exception_of_the_target_is_its_failure() -> None:
    def raises(K: Tensor, cam_from_world: Tensor, points: Tensor) -> Tensor:
        raise ShapeError("no such shape")

    outcome = check("pixels_are_finite", Target("raises", project=raises))
    assert outcome.result == "FAIL" and "ShapeError: no such shape" in outcome.example


def test_targets_of_one_name_are_refused() -> None:
    broken = Target("t", rasterize=lambda p, z, size: torch.full(size, torch.nan).double())
    good = replace(OURS, name="t")
    with pytest.raises(ValueError, match="2 targets are named 't': give each its own name"):
        conformance(iter([broken, good]))
    outcomes = [check("depth_images_are_finite", target) for target in (broken, good)]
    assert [outcome.result for outcome in outcomes] == ["FAIL", "pass"]
    with pytest.raises(ValueError, match="2 outcomes of depth_images_are_finite are of targets"):
        table(outcomes)
    row = table([outcomes[0], Outcome("depth_images_are_finite", "other", "pass")]).splitlines()[1]
    assert row.split() == ["depth", "images", "are", "finite", "FAIL", "pass"]
    # A part of the table: blank where nothing was asked.
    part = table(
        [Outcome("pixels_are_finite", "a", "pass"), Outcome("points_are_finite", "b", "-")]
    )
    assert table([]).strip() == ""
    assert [line.split()[3:] for line in part.splitlines()[1:]] == [["pass"], ["-"]]


@pytest.mark.parametrize("name", INVARIANTS)
def test_an_invariant_names_the_field_that_the_target_lacks(name: str) -> None:
    invariant = INVARIANTS[name]
    module = sys.modules[invariant.check.__module__]
    bare: Any = triangulate_points
    for ask in (invariant, getattr(module, name)):
        scene = scenes_for(invariant)[0]()
        with pytest.raises(ValueError, match=f"^{name} needs .*: x lacks it$") as raised:
            ask(Target("x"), scene)
        words = {*re.findall(r"\w+", str(raised.value).removeprefix(f"{name} needs "))}
        assert words & {field.name for field in fields(Target)} - {"name"}
        other = forward_motion() if invariant.scenes in PLANAR else seeded_depths(0)
        with pytest.raises(TypeError, match=f"^{name} takes a .*Scene, got {type(other).__name__}"):
            ask(OURS, other)
        with pytest.raises(TypeError, match=f"^{name} takes a Target, got function$"):
            ask(bare, scene)


def test_an_invariant_names_the_flag_that_the_target_has_off() -> None:
    scene = seeded_scene(0, num_views=3)
    cases: tuple[tuple[str, str, dict[str, Any]], ...] = (
        ("only_the_ratios_of_weights_count", "weighted=True", {"weighted": False}),
        ("gradients_are_finite_differences", "differentiable=True", {"differentiable": False}),
        ("a_batch_of_scenes_is_solved_as_each_alone", "batched=True", {"batched": False}),
        ("a_view_of_weight_0_is_a_view_removed", "max_views of 3 or more", {"max_views": 2}),
    )
    for name, flag, off in cases:
        INVARIANTS[name](OURS, scene)
        with pytest.raises(ValueError, match=f"{name} needs .*{flag}"):
            INVARIANTS[name](replace(OURS, **off), scene)


def test_an_invariant_refuses_a_scene_of_too_few_views() -> None:
    # With a view less, nothing is left to solve: the target would be blamed.
    with pytest.raises(ValueError, match="needs a scene of 3 views, got 2"):
        INVARIANTS["a_view_of_weight_0_is_a_view_removed"](OURS, seeded_scene(0))
    one = first_views(seeded_scene(0), 1)
    with pytest.raises(ValueError, match="needs a scene of 2 views, got 1"):
        INVARIANTS["points_are_exact_without_noise"](OURS, one)
    INVARIANTS["pixels_are_those_of_the_camera_equations"](OURS, one)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_field_is_a_function_and_returns_tensors(name: str) -> None:
    no_function: dict[str, Any] = {name: 3}
    with pytest.raises(TypeError, match=f"^{name} must be a function or None, got int$"):
        Target("x", **no_function)
    function = getattr(OURS, name)

    def in_numpy(*arguments: Any) -> Any:
        found = function(*arguments)
        several = isinstance(found, tuple)
        parts = tuple(part.detach().numpy() for part in (found if several else (found,)))
        return parts if several else parts[0]

    def too_many(*arguments: Any) -> Any:
        found = function(*arguments)
        return (*found, found[0]) if isinstance(found, tuple) else (found, found)

    asked = [known for known in INVARIANTS if name in INVARIANTS[known].needs]
    asked += ["samples_are_finite"] * name.endswith("samples")
    asked += ["depth_images_are_finite"] * (name in ("mean_depth", "splat"))
    for known, (wrong, got) in product(
        asked, ((in_numpy, r"\(?ndarray"), (too_many, r"(tuple|\(Tensor, )"))
    ):
        scene = scenes_for(INVARIANTS[known])[0]()
        target = replace(OURS, **{name: wrong})
        with pytest.raises(TypeError, match=f"^deltas: {name} must return .*Tensor.*, got {got}"):
            INVARIANTS[known](target, scene)


@pytest.mark.parametrize(
    ("field", "value"),
    [("weighted", None), ("differentiable", 1), ("batched", "no"), ("max_views", 2.5), ("name", 3)],
)
def test_a_field_of_another_type_is_refused(field: str, value: Any) -> None:
    with pytest.raises(TypeError, match=f"^{field} must be "):
        replace(OURS, **{field: value})


@pytest.mark.parametrize(
    ("strategy", "argument"),
    [
        (posed_scenes(num_views=0), "num_views"),
        (posed_scenes(num_views=1), "num_views"),
        (posed_scenes(num_views=21), "num_views"),
        (posed_scenes(num_points=0), "num_points"),
        (strategies.cameras(0), "num_views"),
        (strategies.intrinsics(0), "num_views"),
        (strategies.poses(0), "num_views"),
        (strategies.poses(turn=-0.1), "turn"),
        (strategies.poses(shift=torch.inf), "shift"),
        (strategies.rigs(0), "num_points"),
        (strategies.epipole_rigs(0), "num_points"),
        (strategies.epipole_rigs(within=-1.0), "within"),
        (strategies.image_pixels(-1), "count"),
        (strategies.image_pixels(1, image_size=(0, 3)), "image_size"),
        (strategies.extreme(-1), "shape"),
        (strategies.extreme(2, decades=400), "decades"),
        (scales(decades=-1), "decades"),
        (scales(decades=400), "decades"),
        (vectors(-1, within=1.0), "count"),
        (vectors(1, within=1.0, size=0), "size"),
        (vectors(1, within=torch.nan), "within"),
        (map_scenes(cells=(1, 4)), "cells"),
        (map_scenes(channels=0), "channels"),
        (map_scenes(num_pixels=0), "num_pixels"),
        (score_scenes(size=(1, 1)), "size"),
        (score_scenes(size=(0, 4)), "size"),
        (score_scenes(dims=0), "dims"),
        (strategies.depth_scenes(0), "num_points"),
        (strategies.depth_scenes(image_size=(4, 0)), "image_size"),
    ],
)
def test_what_cannot_be_drawn_well_posed_is_refused(
    strategy: st.SearchStrategy[object], argument: str
) -> None:
    with pytest.raises(ValueError, match=f"^{argument} must "):
        find(strategy, lambda drawn: True)


@pytest.mark.parametrize(
    ("make", "arguments"),
    [
        (seeded_scene, {"num_views": 1}),
        (seeded_scene, {"num_points": 0}),
        (seeded_scene, {"noise": -1.0}),
        (seeded_map, {"stride": (0, 1)}),
        (seeded_map, {"channels": 0}),
        (seeded_map, {"num_pixels": 0}),
        (seeded_scores, {"size": (1, 1)}),
        (seeded_scores, {"dims": 0}),
        (seeded_depths, {"num_points": 0}),
        (seeded_depths, {"image_size": (0, 2)}),
    ],
)
def test_a_seeded_scene_with_nothing_in_it_is_refused(
    make: Callable[..., object], arguments: dict[str, object]
) -> None:
    (name,) = arguments
    with pytest.raises(ValueError, match=f"^{name} must "):
        make(0, **arguments)
    if name != "noise" and not isinstance(arguments[name], tuple):
        with pytest.raises(TypeError, match=f"^{name} must be whole, got 2.5$"):
            make(0, **{name: 2.5})


@given(data=st.data(), num_views=st.sampled_from([2, 3, 4, 5, 20]))
def test_drawn_scenes_are_as_well_posed_as_they_say(data: st.DataObject, num_views: int) -> None:
    scene = data.draw(posed_scenes(num_views, 3))
    depth = (to_homogeneous(scene.points) @ scene.views.proj.mT)[..., 2]
    assert float(depth.min()) > (1.8 if num_views <= 4 else 1.0)
    centers = camera_centers(scene.views.cam_from_world)
    assert float(centers.diff(dim=0).norm(dim=-1).min()) > 0.09


def test_the_least_depth_of_drawn_scenes_is_what_they_say() -> None:
    # The worst turn of the last camera of a row, and the worst corner of the box of points.
    steps = torch.linspace(-0.2, 0.2, 9).double()
    turn = torch.cartesian_prod(steps, steps, steps)
    ahead = rigid(turn, torch.zeros_like(turn))[:, 2, :3]
    for num_views, wanted in ((4, 1.8), (20, 1.0)):
        middle = torch.tensor([-0.2 * (num_views - 1), 0, 3.5]).double()
        depth = ahead @ middle - 1.04 * ahead.abs().sum(dim=-1)
        assert wanted < float(depth.min()) < wanted + 0.2


def test_every_invariant_states_its_theorem() -> None:
    for invariant in INVARIANTS.values():
        assert re.fullmatch(r"[A-Zx].*\.", invariant.theorem)
        assert len(invariant.theorem) < 120


def test_the_fixed_scenes_come_smallest_first() -> None:
    for invariant in INVARIANTS.values():
        scenes = [make() for make in scenes_for(invariant)]
        assert len(scenes) >= 2 and all(scene.sketch() for scene in scenes)
        if invariant.scenes in ("named", "segments"):
            continue
        sizes = [
            max(value.numel() for value in scene[-3:] if isinstance(value, Tensor))
            for scene in scenes
        ]
        assert sizes == sorted(sizes)
    named = scenes_for(INVARIANTS["points_are_finite"])
    assert len(named) == 2 * len(DEGENERATE_SCENES)
    assert first_views(forward_motion(), 1).pixels.shape == (1, 3, 2)


def test_an_assertion_names_the_worst_entry_and_a_wrong_shape() -> None:
    with pytest.raises(AssertionError, match=r"nan instead of 2 at \[1\]"):
        assert_near(torch.tensor([1.5, torch.nan]), torch.tensor([1.0, 2.0]), 0.1, "m")
    off = torch.zeros(2, 3, 2)
    off[1, 0, 1] = 2
    with pytest.raises(AssertionError, match=r"instead of 0 at view 1, point 0, y: off by 2"):
        assert_near(off, torch.zeros(2, 3, 2), 0.1, "px", "view point")
    with pytest.raises(AssertionError, match=r"shape \(2,\) instead of \(3,\)"):
        assert_near(torch.zeros(2), torch.zeros(3), 0.1, "m")
    wanted = torch.tensor([Status.OK, Status.EMPTY])
    assert_status(torch.tensor([True, False]), wanted, (Status.OK,))
    with pytest.raises(AssertionError, match="item 1 is True, but in truth EMPTY"):
        assert_status(torch.tensor([True, True]), wanted, (Status.OK,))
    with pytest.raises(AssertionError, match="item 1 is NO_PARALLAX, but in truth EMPTY"):
        assert_status(torch.tensor([0, 2]), wanted, (Status.OK,))
    with pytest.raises(AssertionError, match="item 1 is 77"):
        assert_status(torch.tensor([0, 77]), wanted, (Status.OK,))


def test_the_example_is_a_call_that_can_be_pasted() -> None:
    example = check("points_move_with_the_world", opencv()).example
    call = example.split(": ")[0]
    scene = eval(call, vars(deltas_geom.testing))
    with pytest.raises(AssertionError, match=r"off by 0\.00051, allowed 1e-06 m"):
        INVARIANTS["points_move_with_the_world"](opencv(), scene)


@pytest.fixture(scope="module")
def printed() -> str:
    """The table of all targets, by the command."""
    with redirect_stdout(io.StringIO()) as out:
        assert main(["--target", "all"]) == 0
    return out.getvalue()


def test_the_command_prints_the_table(printed: str) -> None:
    head, *rows = printed.splitlines()
    assert re.split(r"\s{2,}", head.strip()) == [
        "deltas", "torch", "kornia eigh", "kornia svd", "kornia cofactor", "opencv",
    ]  # fmt: skip
    cells = {row[0]: row[1:] for row in (re.split(r"\s{2,}", line) for line in rows)}
    assert all(cells[name.replace("_", " ")][0] == "pass" for name in INVARIANTS)
    assert cells["points move with the world"] == ["pass", "FAIL", "FAIL", "FAIL", "FAIL", "FAIL"]
    assert cells["only the ratios of weights count"] == ["pass", "pass", "-", "-", "-", "-"]
    assert cells["a linear field is read exactly"] == ["pass"] * 5 + ["FAIL"]
    # One failing example is printed once for all who share it.
    assert printed.count("kornia svd, kornia cofactor, opencv: Where cameras are moved") == 1
    assert "seeded_scene(0, noise=1.0): " in printed


def test_the_exit_code_is_about_deltas_alone(
    printed: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "FAIL" in printed  # of others
    broken = Target("deltas", triangulate=lambda p, x, w: triangulate_points(p, x, w) + 1e-3)
    monkeypatch.setitem(TARGETS, "deltas", lambda: [broken])
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


def test_the_page_runs_and_lists_what_fails(capsys: pytest.CaptureFixture[str]) -> None:
    example, again, listing = _blocks("python")
    namespace: dict[str, Any] = {"__name__": "page"}
    exec(compile(example, "docs/testing.md", "exec"), namespace)
    printed = capsys.readouterr().out
    failed = {*re.findall(r"^(\S.*?) +FAIL", printed, re.MULTILINE)}
    listed = DOCS.read_text().split("Here these fail:")[1].split("Below the table")[0]
    assert {*re.findall(r"`([^`]+)`", listed)} == failed
    shown, _ = _blocks("text")
    # The last digits are those of one machine.
    short = re.sub(r"(\d\.\d{4})\d+", r"\1", shown)
    assert short in re.sub(r"(\d\.\d{4})\d+", r"\1", printed) + "\n"
    with pytest.raises(AssertionError, match=r"off by 0\.00046, allowed 1e-06 m"):
        exec(compile(again, "docs/testing.md", "exec"), namespace)
    exec(compile(listing, "docs/testing.md", "exec"), namespace)
    printed = capsys.readouterr().out
    assert all(
        f"{name} " in printed and each.theorem in printed for name, each in INVARIANTS.items()
    )
    with pytest.raises(AssertionError, match="instead of"):
        namespace["test_mine_on_fixed_scenes"]("points_move_with_the_world")


def test_the_page_on_geometry_runs_and_names_what_there_is() -> None:
    page = (DOCS.parent / "geometry.md").read_text()
    names = {"__name__": "page"}
    for snippet in re.findall(r"^```python\n(.*?)^```$", page, re.DOTALL | re.MULTILINE):
        alone = "deltas_geom import Lens" in snippet
        exec(compile(snippet, "docs/geometry.md", "exec"), {} if alone else names)
    solvers = {name for name in deltas_geom.__all__ if name.startswith("triangulate")}
    assert set(re.findall(r"triangulate(?:_\w+)?", page)) == solvers


def test_the_page_has_every_row() -> None:
    _, page = _blocks("text")
    # Other columns may change with the versions of others.
    rows = [re.split(r"\s{2,}", line)[:2] for line in page.splitlines()[1:]]
    assert rows == [[name.replace("_", " "), "pass"] for name in INVARIANTS]


def _blocks(language: str) -> list[str]:
    """The page's blocks of code in a language."""
    pattern = rf"^```{language}\n(.*?)^```$"
    return re.findall(pattern, DOCS.read_text(), re.DOTALL | re.MULTILINE)


@pytest.mark.parametrize(
    ("asked", "told"),
    [
        (Target("mine"), r"must be a list of Target, got one: use \[target\]"),
        (
            [triangulate_points],
            r"list of Target, got a function in it: use Target\(\"mine\", \.\.\.\)",
        ),
        (["torch"], r"list of Target, got a str in it"),
    ],
)
def test_what_is_no_list_of_targets_is_told(asked: Any, told: str) -> None:
    with pytest.raises(TypeError, match=told):
        conformance(asked)
