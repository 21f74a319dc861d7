"""The equations that pixels put to points, as rows and as the normal matrix.

A pixel (x, y) of a camera with the rows p1, p2, p3 puts two equations to a homogeneous point X:
(x p3 - p1) X = 0 and (y p3 - p2) X = 0. Their stack is A, each row multiplied by the weight of its
pixel, which the book has as 1. The point is the X of length 1 that makes the length of A X least:
of the normal matrix A^T A the eigenvector to the smallest eigenvalue
(:mod:`deltas_geom.numerics.null_vector`).

Multiplied out, a pixel of weight w adds to A^T A

.. math:: w^2 [(x^2 + y^2) p_3^T p_3 - x (p_3^T p_1 + p_1^T p_3) - y (p_3^T p_2 + p_2^T p_3)
    + p_1^T p_1 + p_2^T p_2]

which is linear in x^2 + y^2, x, y and 1, so what belongs to a camera is found once for all points.
Many points are solved so, few by the rows.

Source: Hartley and Zisserman, 2nd ed., section 12.2, without weights.
"""

import numpy as np
import torch
from torch import Tensor

from deltas_geom.numerics.sums import over_views, plain, product
from deltas_geom.numerics.vectors import Numbers


def rows(proj: Numbers, pixels: Numbers) -> Numbers:
    """A without weights: the equations ``(*B, N, V, 2, 4)`` of N points, two of each view.

    Of cameras ``(*B, N, V, 3, 4)`` and pixels ``(*B, N, V, 2)``, tensors or arrays.
    """
    equations: Numbers = pixels[..., None] * proj[..., 2:, :] - proj[..., :2, :]
    return equations


def normal_matrix(
    coefficients: Tensor, x: Tensor, y: Tensor, squared: Tensor | None = None
) -> tuple[Tensor, ...]:
    """A^T A, the upper triangle row by row: D (D + 1) / 2 entries ``(*B, N)``.

    Of :func:`normal_coefficients`, pixels and squared weights ``(*B, V, N)`` each; None where the
    coefficients hold the weights.
    """
    if plain(coefficients, x, y, squared):
        return product(coefficients, _terms_at_hand(x, y, squared)).unbind(dim=-2)
    if squared is None:
        one = torch.ones_like(x[..., :1, :])
        return over_views(coefficients, torch.addcmul(x * x, y, y), x, y, one)
    across, down = x * squared, y * squared
    return over_views(coefficients, torch.addcmul(x * across, y, down), across, down, squared)


def _terms_at_hand(x: Tensor, y: Tensor, squared: Tensor | None) -> Tensor:
    """What the coefficients belong to, in NumPy: without joining parts, and without threads."""
    views, values = x.shape[-2], [t.detach().numpy() for t in (x, y, squared) if t is not None]
    shape = np.broadcast_shapes(*(v.shape for v in values))
    terms = np.empty((*shape[:-2], 3 * views + (1 if squared is None else views), shape[-1]))
    square, across, down = (terms[..., k * views : (k + 1) * views, :] for k in range(3))
    with np.errstate(all="ignore"):
        if squared is None:
            across[...], down[...], terms[..., 3 * views :, :] = *values, 1.0
        else:
            weight = terms[..., 3 * views :, :]
            weight[...] = values[2]
            np.multiply(values[0], weight, out=across)
            np.multiply(values[1], weight, out=down)
        np.multiply(values[0], across, out=square)
        square += values[1] * down
    return torch.from_numpy(terms)


def normal_coefficients(proj: Tensor, squared: Tensor | None = None) -> Tensor:
    """``(*B, D (D + 1) / 2, 4 V)``: every entry of a normal matrix is linear in these.

    They belong to x^2 + y^2, x, y and 1 of each view, whatever the pixel (x, y), so that all points
    share them.

    Args:
        proj: ``(*B, V, 3, D)`` rows p1, p2, p3, of D = 4 (homogeneous points) or 3 entries.
        squared: ``(*B, V, 1)`` squared weights of the views, if points have none of their own;
            what belongs to 1 is summed then: ``(*B, D (D + 1) / 2, 3 V + 1)``.
    """
    outer = proj[..., :, None, :, None] * proj[..., None, :, None, :]  # (*B, V, 3, 3, D, D)
    (e11, _, e13), (_, e22, e23), (e31, e32, e33) = (
        row.unbind(dim=-3) for row in outer.unbind(dim=-4)
    )
    squares = torch.stack([e33, -(e31 + e13), -(e32 + e23), e11 + e22], dim=-4)
    upper = torch.cat([squares[..., row, row:] for row in range(proj.shape[-1])], dim=-1)
    if squared is None:
        return upper.flatten(-3, -2).mT  # (*B, 4, V, D (D + 1) / 2) before
    *moving, of_one = (upper * squared.unsqueeze(-3)).unbind(dim=-3)
    return torch.cat([*moving, of_one.sum(dim=-2, keepdim=True)], dim=-2).mT
