"""The tolerance of a target: for what computes in float32, whatever it is given."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from deltas_geom.testing import INVARIANTS, Target, seeded_scene
from deltas_geom.testing.__main__ import main
from deltas_geom.testing.agreement import slack
from deltas_geom.testing.conformance import conformance
from deltas_geom.testing.targets import TARGETS, deltas

OURS = deltas()


def ours(feature: str) -> Callable[..., Any]:
    function: Callable[..., Any] = getattr(OURS, feature)
    return function


def failures(target: Target) -> set[str]:
    return {outcome.invariant for outcome in conformance([target]) if outcome.result == "FAIL"}


def single(function: Callable[..., Any]) -> Callable[..., Any]:
    """Computes in float32, whatever it is given."""

    def call(*arguments: Any) -> Any:
        return function(
            *(
                value.float() if isinstance(value, Tensor) and value.is_floating_point() else value
                for value in arguments
            )
        )

    return call


def in_float32(tolerance: float) -> Target:
    fields = {
        name: single(value) for name, value in vars(OURS).items() if callable(value)
    }  # fmt: skip
    return replace(OURS, name="float32", tolerance=tolerance, **fields)


def test_what_computes_in_float32_passes_with_the_tolerance_of_the_page() -> None:
    assert failures(in_float32(3e-3)) == set()
    assert len(failures(in_float32(1e-6))) > 20


@pytest.mark.parametrize(
    ("feature", "place"), [("triangulate", 1), ("unproject", 2), ("rays", 1), ("residual", 1)]
)
def test_with_that_tolerance_half_a_pixel_is_still_found(feature: str, place: int) -> None:
    def shifted(*arguments: Any) -> Any:
        moved = [*arguments]
        moved[place] = moved[place] + 0.5
        return ours(feature)(*moved)

    assert failures(Target("half a pixel", tolerance=3e-3, **{feature: shifted}))


def test_a_tolerance_is_of_its_target_alone() -> None:
    shifted = Target("x", project=lambda k, t, x: ours("project")(k, t, x) + 1e-4, tolerance=1e-3)
    invariant = INVARIANTS["pixels_are_those_of_the_camera_equations"]
    invariant(shifted, seeded_scene(0))
    with pytest.raises(AssertionError, match=r"allowed 1e-06 px"):
        invariant(replace(shifted, tolerance=1e-6), seeded_scene(0))
    with pytest.raises(AssertionError, match=r"allowed 5e-05 px"):
        invariant(replace(shifted, tolerance=5e-5), seeded_scene(0))
    assert slack() == 1.0


@pytest.mark.parametrize("value", [0.0, -1.0, torch.inf, torch.nan])
def test_a_tolerance_is_positive(value: float) -> None:
    with pytest.raises(ValueError, match=r"^tolerance must be positive and finite, got"):
        Target("x", tolerance=value)
    with pytest.raises(SystemExit):
        main(["--target", "torch", "--tolerance", str(value)])


def test_the_command_takes_a_tolerance(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    off = Target("deltas", triangulate=lambda p, x, w: ours("triangulate")(p, x, w) + 1e-3)
    monkeypatch.setitem(TARGETS, "deltas", lambda: [replace(off, differentiable=False)])
    assert main(["--target", "deltas"]) == 1
    assert "allowed 1e-06 m" in capsys.readouterr().out
    assert main(["--target", "deltas", "--tolerance", "5e-3"]) == 0
    wrong: Any = "much"
    with pytest.raises(TypeError, match=r"^tolerance must be a number, got 'much'$"):
        replace(off, tolerance=wrong)
