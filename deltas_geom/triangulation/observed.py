"""Cameras and what they see of points, in the solver's type, cleaned and flagged.

Everything downstream may multiply and divide without asking: what is not used is 0 here, and
passes no NaN and no gradient.
"""

from typing import Any, NamedTuple

import torch
from torch import Tensor

from deltas_geom.checks import batch_shape, check_bool, check_floating, check_shapes
from deltas_geom.numerics.chunks import values_at_hand

# A view whose weight is below this share of the point's largest counts as no view: its squared
# weight, times a small parallax, would be lost in the rounding of the normal matrix.
NEGLIGIBLE_WEIGHT = 1e-6


Vector3 = tuple[Tensor, Tensor, Tensor]
"""Components of vectors: struct of arrays, which is fast and compiles into one loop."""


def over_views(coefficients: Tensor, values: Tensor) -> tuple[Tensor, ...]:
    """For K coefficients ``(*B, K, V)`` of views, K sums ``(*B, N)`` of values ``(*B, V, N)``."""
    if torch.compiler.is_compiling():
        sums: tuple[Tensor, ...] = _FusedSums.apply(coefficients, values)  # type: ignore[no-untyped-call]
        return sums
    return (coefficients @ values).unbind(dim=-2)


class _FusedSums(torch.autograd.Function):
    """The product element by element, which a compiler fuses with what stands around it.

    Its derivative by the coefficients is a sum over points, for which a product is better.
    """

    generate_vmap_rule = True

    @staticmethod
    def forward(coefficients: Tensor, values: Tensor) -> tuple[Tensor, ...]:
        return tuple(_sum_of(row, values) for row in coefficients.unbind(dim=-2))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor], output: Any) -> None:
        ctx.save_for_backward(*inputs)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, Tensor | None]:
        coefficients, values = ctx.saved_tensors
        gradient = torch.stack(gradients, dim=-2)
        of_coefficients = of_values = None
        if ctx.needs_input_grad[0]:
            of_coefficients = (gradient @ values.mT).sum_to_size(coefficients.shape)
        if ctx.needs_input_grad[1]:
            columns = coefficients.unbind(dim=-1)
            of_values = torch.stack([_sum_of(column, gradient) for column in columns], dim=-2)
            of_values = of_values.sum_to_size(values.shape)
        return of_coefficients, of_values


def _sum_of(row: Tensor, values: Tensor) -> Tensor:
    total = row[..., 0, None] * values[..., 0, :]
    for view in range(1, values.shape[-2]):
        total = total + row[..., view, None] * values[..., view, :]
    return total


class Weights(NamedTuple):
    """How much each view counts for each point.

    They are those of one point, N = 1, where all points are alike.

    Attributes:
        squared: ``(*B, V, N)`` squared weights, a point's largest 1; 0 where unused. 0 or
            anything where unsound, which makes the point fail.
        largest: ``(*B, 1, N)`` a point's largest weight; 1 if that is 0.
        unused: ``(*B, V, N)`` bool.
        used: ``(*B, V, N)`` its complement as 1 and 0, to be summed.
        sound: ``(*B, N)`` bool: every used weight is finite, and what it weighs is sound.
    """

    squared: Tensor
    largest: Tensor
    unused: Tensor
    used: Tensor
    sound: Tensor


def weigh(
    weights: Tensor | None, mask: Tensor | None, *, batch: torch.Size, like: Tensor, sound: Tensor
) -> Weights:
    """Tell used views from unused ones.

    Args:
        weights: ``(*B, V, N)`` or None for all 1. 0 = unused; the sign has no effect. NaN counts
            as used.
        mask: ``(*B, V, N)`` bool or None, True = used.
        batch: dims to which all are expanded.
        like: ``(*B, V, N, ...)`` of what is weighed.
        sound: ``(*B, V, N)`` bool: it can be used.
    """
    work = solver_dtype(like)
    weight = like.new_ones((), dtype=work) if weights is None else weights.to(work)
    if mask is not None:
        weight = torch.where(mask, weight, 0.0)
    alike = weights is None and mask is None
    weight = weight.expand(*batch, like.shape[-3], 1 if alike else like.shape[-2])
    size = weight.detach().abs()
    largest = size.amax(dim=-2, keepdim=True)
    unused = size <= NEGLIGIBLE_WEIGHT * largest
    counted = largest <= torch.finfo(work).max  # NaN is not, either
    one, zero = weight.new_ones(()), weight.new_zeros(())
    largest = torch.where(counted & (largest > 0), largest, one)
    # Double where: an infinite weight must not turn the gradient into NaN.
    share = torch.where(counted, weight, zero) / largest
    # What is not sound makes its point fail, if it is used: it need not be told from point to
    # point where all are alike.
    counts = ~unused if alike else sound & ~unused
    return Weights(
        squared=torch.where(counts, share * share, zero),
        largest=largest,
        unused=unused,
        used=(~unused).to(work),
        sound=(sound | unused).all(dim=-2) & counted.squeeze(-2),
    )


def alike_weights(proj: Tensor) -> Weights:
    """Those of one point for all that are seen by cameras ``(*B, V, 3, 4)`` and weigh the same."""
    like = proj[..., :1, 0]
    return weigh(None, None, batch=proj.shape[:-3], like=like[..., None], sound=like == like)


class Cameras(NamedTuple):
    """Cameras in the solver's type.

    Attributes:
        proj: ``(*B, V, 3, 4)``, 0 for cameras that are not finite.
        sick: ``(*B, V)`` 1 for those, else 0.
        centers: ``(*B, V, 3)``, see :func:`projection_centers`.
    """

    proj: Tensor
    sick: Tensor
    centers: Tensor


def cameras_of(proj: Tensor) -> Cameras:
    """Tell finite cameras ``(*B, V, 3, 4)`` from others."""
    check_shapes(proj=(proj, "+V 3 4"))
    work = solver_dtype(proj)
    limit = torch.finfo(work).max ** 0.25
    finite = (proj.detach().to(work).abs() < limit).all(-1).all(-1)
    # Double where: what is not used must pass no gradient and no NaN.
    clean = torch.where(finite[..., None, None], proj, 0.0).to(work)
    return Cameras(clean, (~finite).to(work), projection_centers(clean))


class Observations(NamedTuple):
    """Pixels of N points in V views.

    Attributes:
        proj: ``(*B, V, 3, 4)``, 0 for cameras that are not finite.
        sick: ``(*B, V)`` 1 for those, else 0.
        xy: ``(*B, V, 2, N)`` pixels, 0 where unused or not finite.
        weights: of the pixels.
    """

    proj: Tensor
    sick: Tensor
    xy: Tensor
    weights: Weights


def observe(
    proj: Tensor, pixels: Tensor, weights: Tensor | None, mask: Tensor | None
) -> Observations:
    """Check shapes, broadcast, and tell used from unused.

    Args:
        proj: ``(*B, V, 3, 4)``.
        pixels: ``(*B, V, N, 2)``; those of unused views may hold anything.
        weights: see :func:`weigh`.
        mask: see :func:`weigh`.

    Raises:
        ShapeError: a trailing shape differs, or there is no view.
        TypeError: the mask is not bool.
    """
    cameras = cameras_of(proj)
    xy, weighed = weigh_pixels(cameras, pixels, weights, mask)
    return Observations(cameras.proj, cameras.sick, xy, weighed)


def weigh_pixels(
    cameras: Cameras, pixels: Tensor, weights: Tensor | None, mask: Tensor | None
) -> tuple[Tensor, Weights]:
    """The pixels and weights of :func:`observe`."""
    batch = check_pixels(cameras, pixels, weights, mask)
    xy, sound = clean_pixels(pixels)
    return xy, weigh(weights, mask, batch=batch, like=pixels, sound=sound)


def check_pixels(
    cameras: Cameras, pixels: Tensor, weights: Tensor | None = None, mask: Tensor | None = None
) -> torch.Size:
    """:func:`check_observed` by cameras that are cleaned already."""
    return check_observed(cameras.proj, pixels, weights, mask)


def clean_pixels(pixels: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels ``(*B, V, 2, N)`` of the solver's type, 0 where not finite, and which are finite.

    These are bool, ``(*B, V, N)``, or of one point for all.
    """
    # Struct of arrays: sums over views then run over memory in order.
    work = solver_dtype(pixels)
    xy = pixels.mT.to(work, memory_format=torch.contiguous_format).contiguous()
    limit = torch.finfo(work).max ** 0.25  # what is beyond overflows; NaN is not below
    if values_at_hand(pixels):
        every = xy.detach().flatten()
        if bool(every.dot(every) < limit):
            return xy, torch.ones_like(pixels[..., :1, 0], dtype=torch.bool)
    x, y = xy.detach().unbind(dim=-2)
    sound = torch.addcmul(x * x, y, y) < limit
    # Double where: what is not used must pass no gradient and no NaN.
    return torch.where(sound.unsqueeze(-2), xy, xy.new_zeros(())), sound


def check_observed(
    proj: Tensor, pixels: Tensor, weights: Tensor | None, mask: Tensor | None
) -> torch.Size:
    """:func:`check_weights` of pixels ``(*B, V, N, 2)`` seen by cameras ``(*B, V, 3, 4)``."""
    check_shapes(proj=(proj, "+V 3 4"), pixels=(pixels, "V N 2"))
    check_floating(proj=proj)
    return check_weights(weights, mask, "pixels", pixels, "V N 2", proj.shape[:-3])


def check_weights(
    weights: Tensor | None,
    mask: Tensor | None,
    name: str,
    seen: Tensor,
    dims: str,
    batch: torch.Size,
) -> torch.Size:
    """Raise unless weights and mask ``(*B, V, N)`` fit what is weighed, and the mask is bool.

    Returns:
        The batch dims to which all broadcast.
    """
    shapes = [batch, seen.shape[:-3]]
    for label, tensor in (("weights", weights), ("mask", mask)):
        if tensor is not None:
            check_shapes(**{name: (seen, dims), label: (tensor, "V N")})
            shapes.append(tensor.shape[:-2])
    check_bool(mask=mask)
    return batch_shape(*shapes)


def solver_dtype(tensor: Tensor) -> torch.dtype:
    """The type to compute in: float64, whatever the input, where the device has it."""
    # Apple's devices have no float64; there the rig frame alone keeps float32 usable.
    return torch.float32 if tensor.device.type == "mps" else torch.float64


def projection_centers(proj: Tensor) -> Tensor:
    """Centres ``(*B, V, 3)`` of cameras ``(*B, V, 3, 4)``.

    A camera without a finite centre gets 0 with zero gradient.

    Source: Hartley and Zisserman, 2nd ed., section 6.2.4.
    """
    rows = proj[..., :3]
    r0, r1, r2 = rows.unbind(dim=-2)
    cofactors = torch.stack(
        [torch.linalg.cross(r1, r2), torch.linalg.cross(r2, r0), torch.linalg.cross(r0, r1)], dim=-2
    )
    determinant = (r0 * cofactors[..., 0, :]).sum(dim=-1)
    with torch.no_grad():
        product = rows.square().sum(dim=-1).prod(dim=-1).sqrt()
        exists = determinant.abs() > 4 * torch.finfo(proj.dtype).eps * product
    # Double where: a singular camera must not turn the gradient into NaN.
    inverse = 1 / torch.where(exists, determinant, 1.0)
    position = torch.where(exists[..., None], proj[..., 3], 0.0)
    return -inverse[..., None] * (cofactors * position[..., None]).sum(dim=-2)
