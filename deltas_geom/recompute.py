"""Functions that keep only their inputs for backward, and compute what lies between again.

What lies between a function's inputs and its outputs is usually many times larger than both.
Derivatives of any order are autograd's, of the second computation.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.autograd import forward_ad


def recomputed(
    function: Callable[..., tuple[Tensor, ...]],
    *tensors: Tensor | None,
    values: Callable[..., tuple[Tensor, ...]] | None = None,
) -> tuple[Tensor, ...]:
    """``function(*tensors)``, keeping nothing but ``tensors`` for its backward pass.

    Under ``torch.compile``, ``torch.export``, the transforms of ``torch.func`` and in forward
    mode the function is called as it is: they derive and keep what they need by themselves.

    Args:
        function: pure, from tensors to a tuple of tensors; outputs that are not of floating
            point have no gradient.
        *tensors: inputs; those in a closure get no gradient.
        values: the same outputs by a faster route that need not be differentiable.

    Source: Griewank and Walther, Evaluating Derivatives, 2nd ed., chapter 12 (checkpointing).

    Example:
        >>> x = torch.ones(3, requires_grad=True)
        >>> (y,) = recomputed(lambda x: (x.exp().sin(),), x)
        >>> torch.autograd.grad(y.sum(), x)[0].allclose((x.exp().cos() * x.exp()))
        True
    """
    if torch._C._are_functorch_transforms_active() or any(map(_has_tangent, tensors)):
        return function(*tensors)
    if not (torch.is_grad_enabled() and any(t is not None and t.requires_grad for t in tensors)):
        with torch.no_grad():
            return (function if values is None else values)(*tensors)
    if torch.compiler.is_compiling():
        return _applied(_Traced, function, function if values is None else values, *tensors)
    return _applied(_Recomputed, function, function if values is None else values, *tensors)


def _applied(kind: type[torch.autograd.Function], *inputs: Any) -> tuple[Tensor, ...]:
    outputs: tuple[Tensor, ...] = kind.apply(*inputs)  # type: ignore[no-untyped-call]
    return outputs


def _has_tangent(tensor: Tensor | None) -> bool:
    if tensor is None:
        return False
    tangent = forward_ad.unpack_dual(tensor).tangent  # type: ignore[no-untyped-call]
    return tangent is not None


class _Recomputed(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        function: Callable[..., tuple[Tensor, ...]],
        values: Callable[..., tuple[Tensor, ...]],
        *tensors: Tensor | None,
    ) -> tuple[Tensor, ...]:
        ctx.function = function
        ctx.save_for_backward(*tensors)
        ctx.set_materialize_grads(False)
        outputs = values(*tensors)
        ctx.mark_non_differentiable(*(out for out in outputs if not out.is_floating_point()))
        return outputs

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        needed = ctx.needs_input_grad[2:]
        higher = torch.is_grad_enabled()  # a second derivative is wanted of what is done here
        inputs = [
            tensor if tensor is None or higher else tensor.detach().requires_grad_(asked)
            for tensor, asked in zip(ctx.saved_tensors, needed, strict=True)
        ]
        with torch.enable_grad():
            outputs = ctx.function(*inputs)
        followed = [
            (output, gradient)
            for output, gradient in zip(outputs, gradients, strict=True)
            if gradient is not None and output.requires_grad
        ]
        wanted = [tensor for tensor, asked in zip(inputs, needed, strict=True) if asked]
        if not followed:
            return (None, None, *(None for _ in inputs))
        found = iter(
            torch.autograd.grad(
                [output for output, _ in followed],
                [tensor for tensor in wanted if tensor is not None],
                [gradient for _, gradient in followed],
                create_graph=higher,
                allow_unused=True,
            )
        )
        return (None, None, *(next(found) if asked else None for asked in needed))


class _Traced(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        function: Callable[..., tuple[Tensor, ...]],
        values: Callable[..., tuple[Tensor, ...]],
        *tensors: Tensor | None,
    ) -> tuple[Tensor, ...]:
        ctx.function = function
        ctx.save_for_backward(*tensors)
        outputs = values(*tensors)
        ctx.floating = tuple(out.is_floating_point() for out in outputs)
        ctx.mark_non_differentiable(*(out for out in outputs if not out.is_floating_point()))
        return outputs

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        tensors = ctx.saved_tensors
        function = ctx.function
        places = [k for k, t in enumerate(tensors) if t is not None and ctx.needs_input_grad[2 + k]]

        def of_needed(*needed: Tensor) -> tuple[Tensor, ...]:
            inputs = list(tensors)
            for place, tensor in zip(places, needed, strict=True):
                inputs[place] = tensor
            return tuple(out for out in function(*inputs) if out.is_floating_point())

        _, pull, *_ = torch.func.vjp(of_needed, *(tensors[place] for place in places))
        followed = tuple(g for g, has in zip(gradients, ctx.floating, strict=True) if has)
        found = dict(zip(places, pull(followed), strict=True))
        return (None, None, *(found.get(k) for k in range(len(tensors))))
