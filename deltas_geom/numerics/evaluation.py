"""How results are computed: some points at a time, keeping only inputs for backward.

What lies between a function's inputs and its outputs is usually many times larger than both, so
backward computes it again, and points are cut into chunks that stay in the cache. All that depends
on who calls (a compiler, a transform of ``torch.func``, forward mode) is here.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.autograd import forward_ad

from deltas_geom.checks import tracing
from deltas_geom.numerics.arithmetic import outside_gradients
from deltas_geom.numerics.chunks import Cut, chunks, joined

Function = Callable[..., tuple[Tensor, ...]]
Inputs = tuple[Tensor | None, ...]
Adjoint = Callable[..., Inputs]


def recomputed(
    function: Function,
    *tensors: Tensor | None,
    values: Function | None = None,
    cut: Cut | None = None,
    adjoint: Adjoint | None = None,
) -> tuple[Tensor, ...]:
    """``function(*tensors)``, keeping nothing but ``tensors`` for its backward pass.

    Under ``torch.compile``, ``torch.export``, ``torch.jit.trace``, the transforms of
    ``torch.func`` and in forward mode the function is called as it is: they derive and keep what
    they need by themselves.

    Args:
        function: pure, from tensors to a tuple of tensors; outputs that are not of floating
            point have no gradient.
        *tensors: inputs; those in a closure get no gradient.
        values: the same outputs by a faster route that need not be differentiable.
        cut: compute some points at a time.
        adjoint: from the gradients of the outputs, which inputs need one, and the inputs: the
            gradient of each input or None, to first order; of the first output alone, as the
            others then have none. Where outputs solve equations, it follows from the equations
            and the solution, however that was found.

    Source: Griewank and Walther, Evaluating Derivatives, 2nd ed., chapters 12 (checkpointing) and
    15 (implicit functions).

    Example:
        >>> x = torch.ones(3, requires_grad=True)
        >>> (y,) = recomputed(lambda x: (x.exp().sin(),), x)
        >>> torch.autograd.grad(y.sum(), x)[0].allclose((x.exp().cos() * x.exp()))
        True
    """
    # A trace would hold chunks of so many points as it was made with, and no Function of ours.
    if transformed(*tensors) or tracing():
        return function(*tensors)
    values = function if values is None else values
    compiling = torch.compiler.is_compiling()
    if not differentiated(*tensors):
        with outside_gradients():
            return in_chunks(values, cut, *tensors)
    kind = _Traced if compiling else _Recomputed
    outputs: tuple[Tensor, ...] = kind.apply(function, values, cut, adjoint, *tensors)  # type: ignore[no-untyped-call]
    return outputs


def in_chunks(function: Function, cut: Cut | None, *tensors: Tensor | None) -> tuple[Tensor, ...]:
    """``function(*tensors)``, some points at a time, without a derivative."""
    if cut is None:
        return function(*tensors)
    cut = cut if cut.values is None else cut._replace(size=cut.values)
    parts = [function(*some) for some in chunks(cut, tensors, cut.inputs)]
    return tuple(map(joined, zip(*parts, strict=True), cut.outputs))


def differentiated(*tensors: Tensor | None) -> bool:
    """Will a backward pass be possible?"""
    return torch.is_grad_enabled() and any(t is not None and t.requires_grad for t in tensors)


def transformed(*tensors: Tensor | None) -> bool:
    """Does a transform of ``torch.func`` run, or forward mode?"""
    return torch._C._are_functorch_transforms_active() or any(map(_has_tangent, tensors))


def _has_tangent(tensor: Tensor | None) -> bool:
    if tensor is None or forward_ad._current_level < 0:
        return False
    tangent = forward_ad.unpack_dual(tensor).tangent  # type: ignore[no-untyped-call]
    return tangent is not None


def _in_batch(tensor: Tensor | None) -> bool:
    """Does ``vmap`` run, that of ``torch.func`` or of ``is_grads_batched``?"""
    if torch._C._are_functorch_transforms_active():
        return True
    return tensor is not None and torch._C._functorch.is_legacy_batchedtensor(tensor)


class _Keeping(torch.autograd.Function):
    """What keeps the inputs alone."""

    @staticmethod
    def forward(
        ctx: Any,
        function: Function,
        values: Function,
        cut: Cut | None,
        adjoint: Adjoint | None,
        *tensors: Tensor | None,
    ) -> tuple[Tensor, ...]:
        if not torch.compiler.is_compiling():
            ctx.set_materialize_grads(False)
        ctx.function, ctx.cut, ctx.adjoint = function, cut, adjoint
        ctx.save_for_backward(*tensors)
        outputs = in_chunks(values, cut, *tensors)
        ctx.floating = [out.is_floating_point() for out in outputs]
        ctx.mark_non_differentiable(
            *(out for k, out in enumerate(outputs) if (adjoint and k) or not ctx.floating[k])
        )
        return outputs


class _Recomputed(_Keeping):
    @staticmethod
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        needed, function, cut = ctx.needs_input_grad[4:], ctx.function, ctx.cut
        tensors, settings = ctx.saved_tensors, (None,) * 4
        if all(gradient is None for gradient in gradients):
            return *settings, *(None for _ in tensors)
        if torch.is_grad_enabled():  # a second derivative is wanted of what is done here
            pulled = _pulled(function, gradients, needed, *tensors, create_graph=True)
            return *settings, *pulled
        # A sum of gradients in a batch could not tell one from the other.
        pull = partial(_pulled, function)
        if ctx.adjoint and not any(map(_in_batch, gradients)):
            pull = ctx.adjoint
        if cut is None:
            return *settings, *pull(gradients, needed, *tensors)
        pairs = zip(
            chunks(cut, gradients, cut.outputs), chunks(cut, tensors, cut.inputs), strict=True
        )
        parts = zip(*(pull(some, needed, *inputs) for some, inputs in pairs), strict=True)
        return *settings, *map(_together, parts, cut.inputs)


def _together(parts: tuple[Tensor | None, ...], dim: int) -> Tensor | None:
    """The gradient of an input from those of its chunks, which are all None or none."""
    known = [part for part in parts if part is not None]
    if not known:
        return None
    return joined(known, dim) if dim else sum(known[1:], known[0])


def _pulled(
    function: Function,
    gradients: Sequence[Tensor | None],
    needed: Sequence[bool],
    *tensors: Tensor | None,
    create_graph: bool = False,
) -> tuple[Tensor | None, ...]:
    """Gradients of the inputs by those of the outputs."""
    inputs = [
        t if t is None or create_graph else t.detach().requires_grad_(asked)
        for t, asked in zip(tensors, needed, strict=True)
    ]
    with torch.enable_grad():
        outputs = function(*inputs)
    followed = [
        (output, gradient)
        for output, gradient in zip(outputs, gradients, strict=True)
        if gradient is not None and output.requires_grad
    ]
    if not followed:
        return (None,) * len(inputs)
    pulled = iter(
        torch.autograd.grad(
            [output for output, _ in followed],
            [t for t, asked in zip(inputs, needed, strict=True) if t is not None and asked],
            [gradient for _, gradient in followed],
            create_graph=create_graph,
            allow_unused=True,
        )
    )
    return tuple(next(pulled) if asked else None for asked in needed)


class _Traced(_Keeping):
    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        needed, function = ctx.needs_input_grad[4:], ctx.function
        tensors, settings = ctx.saved_tensors, (None,) * 4
        followed = tuple(g for g, has in zip(gradients, ctx.floating, strict=True) if has)
        # What depends on inputs alone the compiler would compute in the forward pass, and keep.
        never = (followed[0] > torch.inf).any()
        tensors = [None if t is None else torch.where(never, t.new_zeros(()), t) for t in tensors]
        if ctx.adjoint:
            return *settings, *ctx.adjoint(followed, needed, *tensors)
        places = [k for k, t in enumerate(tensors) if t is not None and needed[k]]

        def of_needed(*needed: Tensor) -> tuple[Tensor, ...]:
            inputs = list(tensors)
            for place, tensor in zip(places, needed, strict=True):
                inputs[place] = tensor
            return tuple(out for out in function(*inputs) if out.is_floating_point())

        _, pull, *_ = torch.func.vjp(of_needed, *(tensors[place] for place in places))
        pulled = dict(zip(places, pull(followed), strict=True))
        return *settings, *(pulled.get(k) for k in range(len(tensors)))
