"""One life cycle of a triangulation, so that a solver is its mathematics and little else.

What is given is seen once, solved and judged without gradient, followed with one, and described.
Chunks, what backward computes again, types, numbers beyond their range and limits are here.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

import torch
from torch import Tensor

from deltas_geom.numerics.arithmetic import outside_gradients
from deltas_geom.numerics.chunks import cut_points
from deltas_geom.numerics.evaluation import Inputs, recomputed
from deltas_geom.records import Record
from deltas_geom.triangulation.judge import ok
from deltas_geom.triangulation.results import within_residual
from deltas_geom.triangulation.uncertainty import representable

_Points = TypeVar("_Points", bound=Record)
_Seen = TypeVar("_Seen")
_Found = TypeVar("_Found")
_POINTS = {"points": -2, "pixels": -2, "covariance": -3}  # the dim of points; -1 in other fields


def operation(
    record: type[_Points],
    inputs: Inputs,
    *,
    see: Callable[..., _Seen],
    solve: Callable[[_Seen], tuple[_Found, Tensor]],
    follow: Callable[[_Seen, _Found, Tensor], _Found],
    describe: Callable[[_Seen, _Found, Tensor, bool], dict[str, Tensor]],
    dtype: torch.dtype,
    covariance: bool,
    max_residual: float | None,
    listed: bool = False,
) -> _Points:
    """Points and what is known about them.

    Args:
        record: of the result. It has ``status``, ``valid`` and, if asked for, ``covariance``.
        inputs: cameras, what they see, and more that is known of it; or None.
        see: the inputs, cleaned, in the solver's type.
        solve: of what is seen the solution, called without gradient, and its status.
        follow: the solution, from what is seen, itself and where it is valid; differentiably.
        describe: fields of the record, from these three and whether to state a covariance.
        dtype: of the results.
        covariance: is it to be stated?
        max_residual: where to refuse points, or None.
        listed: the inputs are lists of observations, not views of points.
    """
    names = [name for name in record._fields if name not in ("status", "valid")]
    if not covariance and "covariance" in names:
        names.remove("covariance")

    def computed(derivable: bool, *tensors: Tensor | None) -> tuple[Tensor, ...]:
        seen = see(*tensors)
        with outside_gradients():
            found, status = solve(seen)
        valid = ok(status)
        if derivable:
            found = follow(seen, found, valid)
        fields = describe(seen, found, valid, covariance)
        return (*(_outward(name, fields[name], dtype) for name in names), status)

    cut = None
    if not listed and inputs[1] is not None:
        outputs = (*(_POINTS.get(name, -1) for name in names), -1)
        # Of two rays what lies between is 8 numbers a point, too.
        cut = cut_points(inputs[1], -2, *(-1 for _ in inputs[2:]), outputs=outputs, least=8)
    compute, values = partial(computed, True), partial(computed, False)
    *fields, status = recomputed(compute, *inputs, values=values, cut=cut)
    known: dict[str, Any] = dict.fromkeys(record._fields) | dict(zip(names, fields, strict=True))
    known["parallax"] = known["parallax"].detach()
    found = record(**known | {"status": status, "valid": ok(status)})
    return found if max_residual is None else within_residual(found, max_residual)


def _outward(name: str, field: Tensor, dtype: torch.dtype) -> Tensor:
    if not field.is_floating_point():
        return field
    limit = torch.finfo(dtype).max
    return (
        representable(field, dtype)
        if name == "covariance"
        else field.to(dtype).clamp(-limit, limit)
    )
