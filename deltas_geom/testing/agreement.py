"""How invariants compare: assertions that print the failing numbers, and derivatives."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import torch
from torch import Tensor

from deltas_geom.cameras.homogeneous import to_homogeneous
from deltas_geom.epipolar.fundamental import epipolar_lines
from deltas_geom.status import Status
from deltas_geom.testing.scenes import IMAGE_SIZE

PIXEL_TOLERANCE = 1e-6  # px
POINT_TOLERANCE = 1e-6  # m, at the few metres of the scenes
VALUE_TOLERANCE = 1e-9  # of values around 1, read or averaged
EXTREMES = torch.tensor([[1e15, -1e15, 1e-15], [-1e15, 1e7, 1.0], [1e-15, 0.0, -1e-15]]).double()
"""``(3, 3)`` coordinates of very different sizes, whose ratios still fit float32."""

_SLACK = ContextVar("slack", default=1.0)


@contextmanager
def allowing(tolerance: float) -> Iterator[None]:
    """Inside, :func:`assert_near` allows as many times more as ``tolerance`` is of 1e-6.

    Args:
        tolerance: of pixels (px) and points (m).
    """
    token = _SLACK.set(tolerance / POINT_TOLERANCE)
    try:
        yield
    finally:
        _SLACK.reset(token)


def slack() -> float:
    """How many times more is allowed now than by default."""
    return _SLACK.get()


def assert_near(
    found: Tensor, wanted: Tensor, tolerance: float | Tensor, unit: str, dims: str = ""
) -> None:
    """Raise ``AssertionError`` with the worst pair unless all are as close; NaN is not.

    Args:
        found: of any shape.
        wanted: of the same shape.
        tolerance: largest difference, or one for each entry; times :func:`slack`.
        unit: of both, for the message.
        dims: what the dims are, but the last, which are x, y and z; without them they are numbers.

    Example:
        >>> assert_near(torch.tensor([1.0, 2.5]), torch.tensor([1.0, 2.0]), 0.1, "m")
        Traceback (most recent call last):
        ...
        AssertionError: 2.5 instead of 2 at [1]: off by 0.5, allowed 0.1 m
    """
    if found.shape != wanted.shape:
        raise AssertionError(f"shape {tuple(found.shape)} instead of {tuple(wanted.shape)}")
    error = (found.detach() - wanted.detach()).abs()
    allowed = slack() * torch.as_tensor(tolerance, dtype=error.dtype).expand(error.shape)
    bad = ~(error <= allowed)  # NaN is bad
    if bool(bad.any()):
        excess = error.nan_to_num(torch.inf) / allowed.clamp(min=torch.finfo(error.dtype).tiny)
        index = _index(int(torch.where(bad, excess, -1.0).argmax()), error)
        raise AssertionError(
            f"{float(found[index]):.9g} instead of {float(wanted[index]):.9g} at "
            f"{_place(index, dims.split())}: off by {float(error[index]):.2g}, "
            f"allowed {float(allowed[index]):.2g} {unit}"
        )


def assert_finite(found: Tensor, name: str) -> None:
    """Raise ``AssertionError`` with the first entry that is NaN or infinite."""
    bad = ~found.detach().isfinite()
    if bool(bad.any()):
        index = bad.nonzero()[0].tolist()
        raise AssertionError(f"{name} {index} is {float(found[tuple(index)])}")


def assert_same_lines(
    found: Tensor, wanted: Tensor, pixels: Tensor, tolerance: float = PIXEL_TOLERANCE
) -> None:
    """Both matrices draw the same lines of ``pixels (N, 2)``, measured at the image's corners."""
    height, width = IMAGE_SIZE
    corners = torch.tensor([[0, 0], [width, 0], [0, height], [width, height]]).to(pixels)
    ours, theirs = epipolar_lines(found, pixels), epipolar_lines(wanted, pixels)
    sign = (ours[:, :2] * theirs[:, :2]).sum(dim=-1, keepdim=True).sign()
    found, wanted = (line @ to_homogeneous(corners).mT for line in (sign * ours, theirs))
    assert_near(found, wanted, tolerance, "px (of a corner from a line)")


def assert_status(found: Tensor, wanted: Tensor, good: tuple[Status, ...]) -> None:
    """Codes of ``Status`` are as wanted; a mask is True where a ``good`` code is wanted.

    Args:
        found: ``(N)`` bool, or integers of :class:`Status`.
        wanted: ``(N)`` integers of :class:`Status`.
        good: what a mask calls True.
    """
    is_mask = found.dtype == torch.bool
    truth = is_good(wanted, good) if is_mask else wanted.to(found.dtype)
    if found.shape != truth.shape:
        raise AssertionError(f"shape {tuple(found.shape)} instead of {tuple(truth.shape)}")
    wrong = found != truth
    if bool(wrong.any()):
        index = int(wrong.nonzero()[0])
        says = bool(found[index]) if is_mask else _name(int(found[index]))
        means = Status(int(wanted[index])).name
        raise AssertionError(f"item {index} is {says}, but in truth {means}")


def is_good(status: Tensor, good: tuple[Status, ...]) -> Tensor:
    """``(N)`` bool of a mask or of codes of which some are ``good``."""
    if status.dtype == torch.bool:
        return status
    return torch.isin(status, torch.tensor(good, dtype=status.dtype))


def gradients(loss: Callable[..., Tensor], inputs: list[Tensor]) -> list[Tensor]:
    """By each of the inputs; 0 where the loss does not depend on it.

    Raises:
        AssertionError: autograd does not know that it depends on any.
    """
    leaves = [value.detach().clone().requires_grad_() for value in inputs]
    total = loss(*leaves)
    if not total.requires_grad:
        raise AssertionError(
            "no gradient: autograd does not go through the answer (a detach, or NumPy inside?); "
            "if none is meant, say differentiable=False"
        )
    found = torch.autograd.grad(total, leaves, allow_unused=True)
    pairs = zip(inputs, found, strict=True)
    return [torch.zeros_like(value) if grad is None else grad for value, grad in pairs]


def assert_gradients(
    function: Callable[..., Tensor], inputs: list[Tensor], names: Iterable[str], unit: str
) -> None:
    """The gradient by each input is finite and that of finite differences, relative to its size.

    Args:
        function: of the inputs.
        inputs: where.
        names: of the inputs, for the message; there may be more.
        unit: of what the function returns.
    """

    def loss(*values: Tensor) -> Tensor:
        found = function(*values)
        # Different factors, so that no two errors cancel.
        return (found * torch.linspace(1, 2, found.numel()).to(found).reshape(found.shape)).sum()

    for value, found, name in zip(inputs, gradients(loss, inputs), names, strict=False):
        # Relative steps, so that entries of all units get an effect of one size; longer where the
        # target's rounding would drown it.
        size = value.abs().clamp(min=1)
        wanted = differences(loss, inputs, value, 1e-5 * slack() ** 0.5 * size)
        tolerance = 1e-5 + 1e-4 * float((wanted * size).abs().max())
        assert_near(
            found * size, wanted * size, tolerance, f"{unit} (gradient by {name}, relative)"
        )


def differences(
    function: Callable[..., Tensor], inputs: list[Tensor], value: Tensor, step: Tensor
) -> Tensor:
    """Central differences by each entry of ``value``, which is one of the inputs.

    Returns:
        The shape of ``value``, then that of the function's result.
    """
    columns = []
    for place, size in enumerate(step.flatten().tolist()):
        change = torch.zeros_like(value, memory_format=torch.contiguous_format)
        change.view(-1)[place] = size
        ahead, behind = (
            function(*(other + sign * change if other is value else other for other in inputs))
            for sign in (1, -1)
        )
        columns.append((ahead - behind).detach() / (2 * size))
    return torch.stack(columns).reshape(*value.shape, *columns[0].shape)


def _index(place: int, tensor: Tensor) -> tuple[int, ...]:
    return tuple(int(i) for i in torch.unravel_index(torch.tensor(place), tensor.shape))


def _place(index: tuple[int, ...], dims: list[str]) -> str:
    """Where an entry is: "view 1, point 0, y" or, of dims without names, "[1, 0, 1]"."""
    if len(index) != len(dims) + 1 or not dims:
        return str(list(index))
    named = [f"{dim} {at}" for dim, at in zip(dims, index, strict=False)]
    return ", ".join([*named, "xyz"[index[-1]]])


def _name(code: int) -> str:
    return Status(code).name if code in set(Status) else str(code)
