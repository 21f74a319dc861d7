"""Functions that keep only their inputs for backward, and compute what lies between again.

What lies between a function's inputs and its outputs is usually many times larger than both.
Derivatives of any order are autograd's, of the second computation.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.autograd import forward_ad


class WithLagrangian:
    """A function of :func:`recomputed` whose gradient needs less than the function again.

    Where outputs solve equations, the gradient follows from the equations and the solution,
    however that was found. The first output alone has a gradient; the others are kept too.

    Attributes:
        function: as for :func:`recomputed`.
        lagrangian: from the other outputs, the gradient of the first, and the inputs: a tensor
            whose sum has the derivatives of sum(gradient * output) by the inputs, to first order.

    Source: Griewank and Walther, Evaluating Derivatives, 2nd ed., chapter 15 (implicit).
    """

    def __init__(
        self,
        function: Callable[..., tuple[Tensor, ...]],
        lagrangian: Callable[..., Tensor],
    ) -> None:
        self.function = function
        self.lagrangian = lagrangian

    def __call__(self, *tensors: Tensor | None) -> tuple[Tensor, ...]:
        """All outputs, differentiably."""
        return self.function(*tensors)


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


def _in_batch(tensor: Tensor | None) -> bool:
    """Does ``vmap`` run, that of ``torch.func`` or of ``is_grads_batched``?"""
    if torch._C._are_functorch_transforms_active():
        return True
    return tensor is not None and torch._C._functorch.is_legacy_batchedtensor(tensor)


class _Recomputed(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        function: Callable[..., tuple[Tensor, ...]],
        values: Callable[..., tuple[Tensor, ...]],
        *tensors: Tensor | None,
    ) -> tuple[Tensor, ...]:
        ctx.set_materialize_grads(False)
        return _kept(ctx, function, values, tensors)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        needed = ctx.needs_input_grad[2:]
        higher = torch.is_grad_enabled()  # a second derivative is wanted of what is done here
        tensors, found = ctx.saved_tensors[: len(needed)], ctx.saved_tensors[len(needed) :]
        inputs = [
            tensor if tensor is None or higher else tensor.detach().requires_grad_(asked)
            for tensor, asked in zip(tensors, needed, strict=True)
        ]
        # A sum of gradients in a batch could not tell one from the other.
        batched = _in_batch(gradients[0])
        with torch.enable_grad():
            if isinstance(ctx.function, WithLagrangian) and not (higher or batched):
                if gradients[0] is None:
                    return (None, None, *(None for _ in inputs))
                outputs = (ctx.function.lagrangian(found, gradients[0], *inputs),)
                gradients = (torch.ones_like(outputs[0]),)
            else:
                outputs = ctx.function(*inputs)
        followed = [
            (output, gradient)
            for output, gradient in zip(outputs, gradients, strict=True)
            if gradient is not None and output.requires_grad
        ]
        wanted = [tensor for tensor, asked in zip(inputs, needed, strict=True) if asked]
        if not followed:
            return (None, None, *(None for _ in inputs))
        pulled = iter(
            torch.autograd.grad(
                [output for output, _ in followed],
                [tensor for tensor in wanted if tensor is not None],
                [gradient for _, gradient in followed],
                create_graph=higher,
                allow_unused=True,
            )
        )
        return (None, None, *(next(pulled) if asked else None for asked in needed))


class _Traced(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        function: Callable[..., tuple[Tensor, ...]],
        values: Callable[..., tuple[Tensor, ...]],
        *tensors: Tensor | None,
    ) -> tuple[Tensor, ...]:
        outputs = _kept(ctx, function, values, tensors)
        ctx.floating = tuple(out.is_floating_point() for out in outputs)
        return outputs

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        needed = ctx.needs_input_grad[2:]
        tensors, found = ctx.saved_tensors[: len(needed)], ctx.saved_tensors[len(needed) :]
        function = ctx.function
        followed = tuple(g for g, has in zip(gradients, ctx.floating, strict=True) if has)
        # What depends on inputs alone the compiler would compute in the forward pass, and keep.
        never = (followed[0] > torch.inf).any()
        tensors = [None if t is None else torch.where(never, t.new_zeros(()), t) for t in tensors]
        places = [k for k, t in enumerate(tensors) if t is not None and needed[k]]

        def of_needed(*needed: Tensor) -> tuple[Tensor, ...]:
            inputs = list(tensors)
            for place, tensor in zip(places, needed, strict=True):
                inputs[place] = tensor
            if isinstance(function, WithLagrangian):
                return (function.lagrangian(found, followed[0], *inputs),)
            return tuple(out for out in function(*inputs) if out.is_floating_point())

        outputs, pull, *_ = torch.func.vjp(of_needed, *(tensors[place] for place in places))
        if isinstance(function, WithLagrangian):
            followed = (torch.ones_like(outputs[0]),)
        pulled = dict(zip(places, pull(followed), strict=True))
        return (None, None, *(pulled.get(k) for k in range(len(tensors))))


def _kept(
    ctx: Any,
    function: Callable[..., tuple[Tensor, ...]],
    values: Callable[..., tuple[Tensor, ...]],
    tensors: tuple[Tensor | None, ...],
) -> tuple[Tensor, ...]:
    """The values, after ``ctx`` was told what to keep for backward."""
    ctx.function = function
    outputs = values(*tensors)
    short = isinstance(function, WithLagrangian)
    ctx.save_for_backward(*tensors, *(outputs[1:] if short else ()))
    ctx.mark_non_differentiable(
        *(out for k, out in enumerate(outputs) if (short and k > 0) or not out.is_floating_point())
    )
    return outputs
