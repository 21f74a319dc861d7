"""Functions that keep only their inputs for backward."""

from typing import Any

import pytest
import torch
from hypothesis import given
from torch import Tensor
from torch.testing import assert_close

from deltas_geom.numerics.chunks import Cut
from deltas_geom.numerics.evaluation import recomputed
from deltas_geom.testing.strategies import vectors


def curved(x: Tensor, y: Tensor) -> tuple[Tensor, ...]:
    """Two numbers and an integer of each pair, with much in between."""
    z = (x * y).sin()
    for _ in range(5):
        z = (z + x).sin() * y.exp()
    return z, z * x, (z > 0).to(torch.int8)


def by_another_route(x: Tensor, y: Tensor) -> tuple[Tensor, ...]:
    """The same numbers, without a derivative."""
    return tuple(out.detach().clone() for out in curved(x.detach(), y.detach()))


def leaves(x: Tensor) -> tuple[Tensor, Tensor]:
    return x[0].clone().requires_grad_(), x[1].clone().requires_grad_()


@given(drawn=vectors(2, within=1.0, size=5))
def test_values_and_gradients_are_those_of_the_function(drawn: Tensor) -> None:
    x, y = leaves(drawn)
    wanted, found = curved(x, y), recomputed(curved, x, y)
    apart = recomputed(curved, x, y, values=by_another_route)
    for a, b, c in zip(found, wanted, apart, strict=True):
        assert torch.equal(a, b) and torch.equal(c, b) and a.dtype == b.dtype
    expected = torch.autograd.grad((wanted[0] + 2 * wanted[1]).sum(), (x, y))
    for outputs in (found, apart):
        gradients = torch.autograd.grad((outputs[0] + 2 * outputs[1]).sum(), (x, y))
        for ours, theirs in zip(gradients, expected, strict=True):
            assert_close(ours, theirs, rtol=0, atol=0)


@given(drawn=vectors(2, within=1.0, size=3))
def test_nested_it_is_still_the_function(drawn: Tensor) -> None:
    def inner(x: Tensor, y: Tensor) -> tuple[Tensor, ...]:
        z, _, _ = recomputed(curved, x, y)
        return (z * z,)

    x, y = leaves(drawn)
    (found,) = recomputed(inner, x, y)
    wanted = curved(x, y)[0].square()
    assert torch.equal(found, wanted)
    for ours, theirs in zip(
        torch.autograd.grad(found.sum(), (x, y)),
        torch.autograd.grad(wanted.sum(), (x, y)),
        strict=True,
    ):
        assert_close(ours, theirs, rtol=0, atol=0)


def test_only_the_inputs_are_kept() -> None:
    x, y = leaves(torch.rand(2, 1000).double())
    kept: list[Tensor] = []

    def keep(tensor: Tensor) -> Tensor:
        kept.append(tensor)
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        recomputed(curved, x, y)
    ours = {tensor.untyped_storage().data_ptr() for tensor in kept}
    assert ours == {tensor.untyped_storage().data_ptr() for tensor in (x, y)}
    kept.clear()
    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        curved(x, y)
    assert len({tensor.untyped_storage().data_ptr() for tensor in kept}) > 10


def test_outputs_that_share_the_inputs_or_each_other_are_no_harm() -> None:
    x, y = leaves(torch.rand(2, 3).double())
    same, again, sliced = recomputed(lambda x, y: (x, x * y, (x * y)[:2]), x, y)
    of_x, of_y = torch.autograd.grad(same.sum() + again.sum() + sliced.sum(), (x, y))
    share = torch.tensor([2.0, 2.0, 1.0]).double()
    assert_close(of_x, 1 + share * y)
    assert_close(of_y, share * x)


@given(drawn=vectors(2, within=1.0, size=2))
def test_second_and_third_derivatives_are_right(drawn: Tensor) -> None:
    x, y = leaves(drawn)
    orders: list[list[Tensor]] = []
    for outputs in (recomputed(curved, x, y, values=by_another_route), curved(x, y)):
        total, found = (outputs[0] * outputs[1]).sum(), []
        for _ in range(3):
            of_x, of_y = torch.autograd.grad(total, (x, y), create_graph=True)
            found += [of_x, of_y]
            total = (of_x * of_x.detach() + 3 * of_y).sum()
        orders.append(found)
    for ours, theirs in zip(*orders, strict=True):
        assert_close(ours, theirs, rtol=1e-12, atol=1e-12)


def test_gradcheck_in_both_modes() -> None:
    inputs = leaves(torch.rand(2, 3, generator=torch.Generator().manual_seed(0)).double())

    def solve(x: Tensor, y: Tensor) -> tuple[Tensor, ...]:
        return recomputed(curved, x, y)[:2]

    assert torch.autograd.gradcheck(solve, inputs, check_forward_ad=True)
    assert torch.autograd.gradgradcheck(solve, inputs)


def test_the_transforms_see_the_function() -> None:
    x, y = torch.rand(2, 4, 3, generator=torch.Generator().manual_seed(0)).double()

    def solve(x: Tensor, y: Tensor) -> Tensor:
        return recomputed(curved, x, y)[1]

    def plain(x: Tensor, y: Tensor) -> Tensor:
        return curved(x, y)[1]

    for transform in (
        torch.func.vmap,
        torch.func.jacrev,
        torch.func.jacfwd,
        torch.func.hessian,
        lambda f: torch.func.vmap(torch.func.jacrev(f)),
        lambda f: torch.func.jacrev(torch.func.vmap(f)),
    ):
        assert_close(transform(solve)(x, y), transform(plain)(x, y))


def test_an_input_may_be_none() -> None:
    def function(x: Tensor, y: Tensor | None) -> tuple[Tensor]:
        return (x * x if y is None else x * y,)

    x, y = leaves(torch.rand(2, 3).double())
    (found,) = recomputed(function, x, None)
    assert_close(torch.autograd.grad(found.sum(), x)[0], 2 * x)
    (found,) = recomputed(function, x, y)
    assert_close(torch.autograd.grad(found.sum(), x)[0], y)


def test_integers_have_no_gradient_and_masks_may_come_in() -> None:
    x = torch.tensor([1.0, -2.0, 3.0], requires_grad=True)
    mask, index = torch.tensor([True, False, True]), torch.tensor([2, 1, 0])

    def function(x: Tensor, mask: Tensor, index: Tensor) -> tuple[Tensor, ...]:
        return torch.where(mask, x[index], 0.0), index + 1, ~mask

    places, number, flag = recomputed(function, x, mask, index)
    assert places.requires_grad and not number.requires_grad and not flag.requires_grad
    gradient = torch.autograd.grad(places.sum(), x)[0]
    assert gradient.tolist() == [1.0, 0.0, 1.0]


def test_outputs_may_stay_unused() -> None:
    x, y = leaves(torch.rand(2, 3).double())
    for used in (0, 1):
        found = torch.autograd.grad(recomputed(curved, x, y)[used].sum(), (x, y))
        wanted = torch.autograd.grad(curved(x, y)[used].sum(), (x, y))
        for ours, theirs in zip(found, wanted, strict=True):
            assert_close(ours, theirs, rtol=0, atol=0)


def test_an_input_without_gradient_gets_none() -> None:
    x, y = torch.rand(3, requires_grad=True), torch.rand(3)
    out, _, _ = recomputed(curved, x, y)
    out.sum().backward()
    assert x.grad is not None and y.grad is None
    # An input that the function does not use is no error either.
    z = torch.rand(3, requires_grad=True)
    (alone,) = recomputed(lambda x, z: (2 * x,), x, z)
    of_x, of_z = torch.autograd.grad(alone.sum(), (x, z), allow_unused=True)
    assert (of_x == 2).all() and (of_z is None or (of_z == 0).all())


def test_without_gradients_it_is_the_faster_route() -> None:
    calls: list[str] = []

    def slow(x: Tensor) -> tuple[Tensor]:
        calls.append("slow")
        return (x.exp(),)

    def fast(x: Tensor) -> tuple[Tensor]:
        calls.append("fast")
        return (x.exp(),)

    x = torch.rand(3, requires_grad=True)
    with torch.no_grad():
        (found,) = recomputed(slow, x, values=fast)
    assert not found.requires_grad and calls == ["fast"]
    (found,) = recomputed(slow, x.detach(), values=fast)
    assert not found.requires_grad and calls == ["fast", "fast"]
    with torch.inference_mode():
        recomputed(slow, x, values=fast)
    (found,) = recomputed(slow, x, values=fast)
    assert found.requires_grad and calls[2:] == ["fast", "fast"]
    found.sum().backward()
    assert calls[-1] == "slow"


def test_the_graph_may_be_kept_and_walked_twice() -> None:
    x, y = leaves(torch.rand(2, 3).double())
    out, _, _ = recomputed(curved, x, y)
    first = torch.autograd.grad(out.sum(), x, retain_graph=True)[0]
    assert torch.equal(first, torch.autograd.grad(out.sum(), x)[0])


def root(x: Tensor, y: Tensor) -> tuple[Tensor, ...]:
    """r of r^3 + y^2 r = x, by Newton's method; and two more outputs."""
    r = x / (1 + y * y)
    for _ in range(60):
        r = r - (r**3 + y * y * r - x) / (3 * r * r + y * y)
    return r, r.detach().clone(), r > 0


def implicit(
    gradients: tuple[Tensor, ...], needed: tuple[bool, ...], x: Tensor, y: Tensor
) -> tuple[Tensor | None, ...]:
    """From the equation: dr (3 r^2 + y^2) = dx - 2 y r dy."""
    r = root(x, y)[0]
    of_x = gradients[0] / (3 * r * r + y * y)
    return tuple(
        g if asked else None for g, asked in zip((of_x, -2 * y * r * of_x), needed, strict=True)
    )


@pytest.mark.parametrize(
    ("cut", "compiled"),
    [(None, False), (Cut(2, (-1, -1), (-1, -1, -1)), False), (None, True)],
    ids=["whole", "cut", "compiled"],
)
def test_an_adjoint_gives_the_gradient_in_place_of_the_function(
    cut: Cut | None, compiled: bool
) -> None:
    numbers = torch.rand(2, 5, generator=torch.Generator().manual_seed(0)).double() + 0.5
    x, y = leaves(numbers)

    def solve(x: Tensor, y: Tensor) -> tuple[Tensor, ...]:
        return recomputed(root, x, y, cut=cut, adjoint=implicit)

    found = (torch.compile(solve, fullgraph=True, backend="aot_eager") if compiled else solve)(x, y)
    assert [out.requires_grad for out in found] == [True, False, False]
    for ours, theirs in zip(found, root(x, y), strict=True):
        assert_close(ours, theirs)
    share = torch.arange(5.0).double()
    wanted = torch.autograd.grad((share * root(x, y)[0]).sum(), (x, y))
    ours = torch.autograd.grad((share * found[0]).sum(), (x, y), retain_graph=True)
    for a, b in zip(ours, wanted, strict=True):
        assert_close(a, b)
    assert_close(torch.autograd.grad((share * found[0]).sum(), y)[0], wanted[1])


def test_an_adjoint_spares_the_function_except_where_more_is_asked() -> None:
    calls: list[str] = []

    def function(x: Tensor, y: Tensor) -> tuple[Tensor, ...]:
        calls.append("function")
        return root(x, y)

    def adjoint(*arguments: Any) -> tuple[Tensor | None, ...]:
        calls.append("adjoint")
        return implicit(*arguments)

    x, y = leaves(torch.tensor([[0.5, 1.0], [1.0, 1.5]]).double())
    kept: list[Tensor] = []
    with torch.autograd.graph.saved_tensors_hooks(
        lambda tensor: kept.append(tensor) or tensor,
        lambda tensor: tensor,
    ):
        found = recomputed(function, x, y, values=root, adjoint=adjoint)[0]
    assert len(kept) == 2  # the inputs
    found.sum().backward(retain_graph=True)
    assert calls == ["adjoint"]
    # A batch of gradients at once, whose sums an adjoint could not tell apart.
    rows = torch.autograd.grad(found, x, torch.eye(2).double(), is_grads_batched=True)[0]
    assert calls[1:] == ["function"]
    assert x.grad is not None
    assert_close(rows, torch.diag(x.grad))
    assert torch.autograd.gradgradcheck(
        lambda x, y: recomputed(function, x, y, adjoint=adjoint)[0], (x, y)
    )
