"""``torch.jit.trace``, which serving code still uses: the same values and gradients."""

from typing import Any

import pytest
import torch
from operations import METHODS, OPERATIONS, Operation, chosen, followed, inputs_in, tensors_of
from torch import Tensor
from torch.testing import assert_close

from deltas_geom import Triangulator, triangulate_points
from deltas_geom.testing.fixed_scenes import seeded_scene

ALL = OPERATIONS | METHODS
BY_DAY = (
    "correlate",
    "project",
    "refine_points, implicit",
    "triangulate",
    "triangulate_points, weights",
    "triangulate_rays",
)
EACH = pytest.mark.parametrize(
    "name", [name if name in BY_DAY else pytest.param(name, marks=pytest.mark.slow) for name in ALL]
)
pytestmark = pytest.mark.filterwarnings("ignore::torch.jit.TracerWarning", "ignore:.*jit.trace")


def traced(operation: Operation, inputs: dict[str, Tensor]) -> tuple[Any, Any]:
    """What a trace finds of inputs other than it was made with, and what it should."""

    def of_tensors(*tensors: Tensor) -> tuple[Tensor, ...]:
        return tuple(tensors_of(operation(**dict(zip(inputs, tensors, strict=True)))))

    made_with = tuple(x.detach() + 1e-3 if x.is_floating_point() else x for x in inputs.values())
    trace = torch.jit.trace(of_tensors, made_with, check_trace=False)
    return trace(*inputs.values()), of_tensors(*inputs.values())


@EACH
def test_a_trace_of_a_batch_finds_the_same(name: str) -> None:
    inputs = chosen(ALL[name], inputs_in(torch.float64))
    inputs = {name: torch.stack([tensor, tensor]) for name, tensor in inputs.items()}
    for found, wanted in zip(*traced(ALL[name], inputs), strict=True):
        # Scores have the noise of float32: where they are read, products are summed in it.
        tolerance = 1e-5 if name.startswith("correlate") else 1e-9
        assert_close(found, wanted, rtol=tolerance, atol=tolerance, equal_nan=True)


@EACH
def test_gradients_of_a_trace_are_the_same(name: str) -> None:
    inputs = followed(chosen(ALL[name], inputs_in(torch.float64)))
    several = traced(ALL[name], inputs)
    totals = [sum(x.sum() for x in each if x.requires_grad) for each in several]
    if not isinstance(totals[1], Tensor):  # without gradients
        return
    asked = [tensor for tensor in inputs.values() if tensor.requires_grad]
    each = (torch.autograd.grad(total, asked, materialize_grads=True) for total in totals)
    for found, wanted in zip(*each, strict=True):
        scale = max(1.0, float(wanted.abs().max()))
        assert_close(found, wanted, rtol=1e-5, atol=1e-6 * scale)  # correlate sums in float32


@pytest.mark.parametrize("count", [3, 40_000])
def test_a_trace_takes_any_number_of_points(count: int) -> None:
    def scene(num_points: int) -> tuple[Tensor, Tensor]:
        found = seeded_scene(1, num_views=3, num_points=num_points, noise=1.0)
        return found.views.proj, found.pixels

    trace = torch.jit.trace(triangulate_points, scene(7))
    inputs = scene(count)
    assert_close(trace(*inputs), triangulate_points(*inputs), rtol=1e-9, atol=1e-9)


def test_prepared_cameras_can_be_traced_twice() -> None:
    """What a trace leaves behind is none of the next one's business, nor of plain calls."""
    scene = seeded_scene(1, num_views=3, num_points=7, noise=1.0)
    rig = Triangulator().prepare(scene.views.proj)
    for _ in range(2):  # each checks itself
        trace = torch.jit.trace(rig.points, (scene.pixels,))
        assert_close(trace(scene.pixels), rig.points(scene.pixels), rtol=1e-9, atol=1e-9)
    assert not rig.points(scene.pixels).requires_grad
