"""What an answer must be before its numbers count: of its shape and dtype, and the same twice."""

import re
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

Function = Callable[..., Any]

_SOLVES = "proj (V, 3, 4); pixels (V, N, 2); weights (V, N)"
_SAMPLES = "K (2, 3, 3); cam_from_world (2, 4, 4); pixels (N, 2); depth_range; image_size (H, W); S"
_DRAWS = "pixels (N, 2); depth (N); weights (N); image_size (H, W) -> depth (H, W); weight (H, W)"
SIGNATURES: dict[str, str] = {
    "project": "K (V, 3, 3); cam_from_world (V, 4, 4); points (N, 3) -> pixels (V, N, 2)",
    "fundamental": "K (2, 3, 3); cam_from_world (2, 4, 4) -> F (3, 3)",
    "triangulate": f"{_SOLVES} -> points (N, 3)",
    "judge": f"{_SOLVES} -> status (N)",
    "refine": "proj (V, 3, 4); pixels (V, N, 2); points (N, 3); weights (V, N) -> points (N, 3)",
    "segments": "K (2, 3, 3); cam_from_world (2, 4, 4); pixels (N, 2); depth_range; "
    "image_size (H, W) -> far (N, 2); near (N, 2); status (N)",
    "depth_samples": f"{_SAMPLES} -> pixels (N, S, 2); inv_depth (N, S); status (N)",
    "pixel_samples": f"{_SAMPLES} -> pixels (N, S, 2); inv_depth (N, S); status (N)",
    "sweep": "K (2, 3, 3); cam_from_world (2, 4, 4); pixels (N, 2); inv_depth (S); "
    "image_size (H, W) -> pixels (N, S, 2); visible (N, S) bool",
    "sample_map": "feature_map (D, h, w); pixels (N, 2); image_size (H, W) -> features (N, D)",
    "correlate": "descriptors (N, D); feature_map (D, h, w); pixels (N, S, 2); image_size (H, W) "
    "-> scores (N, S)",
    "soft_argmax": "logits (S); positions (S, D); mask (S) -> position (D)",
    "soft_covariance": "logits (S); positions (S, D); mask (S) -> covariance (D, D)",
    "heatmap_argmax": "logits (h, w) -> pixel (2)",
    "rasterize": "pixels (N, 2); depth (N); image_size (H, W) -> depth (H, W)",
    "mean_depth": _DRAWS,
    "splat": _DRAWS,
    "unproject": "K (V, 3, 3); cam_from_world (V, 4, 4); pixels (V, N, 2); depth (V, N) "
    "-> points (V, N, 3)",
    "rays": "K (V, 3, 3); pixels (V, N, 2) -> rays (V, N, 3)",
    "residual": "proj (V, 3, 4); pixels (V, N, 2); points (N, 3); weights (V, N) -> residual (N)",
    "parallax": "proj (V, 3, 4); points (N, 3) -> angle (N)",
    "robust": f"{_SOLVES}; threshold -> points (N, 3); inliers (V, N) bool",
}
"""What each function of a target takes and returns."""


class _Part(NamedTuple):
    name: str
    dims: tuple[str, ...]
    wanted: str

    def sized(self, sizes: dict[str, int]) -> tuple[int, ...]:
        return tuple(sizes[dim] if dim in sizes else int(dim) for dim in self.dims)


def checked(target: str, feature: str, function: Function, remarks: list[str]) -> Function:
    """The function, whose answers are looked at first: at what no comparison of numbers says well.

    The first question is put twice, and once in float32. Arguments are copies: a scene survives
    what writes into it.

    Args:
        target: its name, for messages.
        feature: one of ``SIGNATURES``.
        function: the target's.
        remarks: what a failing comparison may come from is added here.

    Raises (when called):
        TypeError: no tensors, or of another kind of numbers.
        AssertionError: another shape; a wider dtype than the arguments'; an argument was written
            into; the same question has two answers.

    Example:
        >>> squash = checked("mine", "parallax", lambda proj, points: points[:1, 0], [])
        >>> squash(torch.zeros(2, 3, 4), torch.zeros(5, 3))
        Traceback (most recent call last):
        ...
        AssertionError: mine: parallax must return angle (N), here (5,), got (1,)
    """
    takes, returns = (_parts(side) for side in SIGNATURES[feature].split(" -> "))
    where = f"{target}: {feature}"
    asked = False

    def answer(arguments: tuple[Any, ...]) -> list[Tensor]:
        copies = _copies(arguments)
        try:
            found = function(*copies)
        except RuntimeError as error:
            # Torch's own words, "use detach", lead to an answer without a gradient.
            if "numpy() on Tensor that requires grad" in str(error):
                remarks.append(f"{feature} uses NumPy: give the target differentiable=False")
            raise
        except TypeError as error:
            # Raised by the call itself, not by what it called.
            if error.__traceback__ is not None and error.__traceback__.tb_next is None:
                names = ", ".join(one.wanted for one in takes)
                remarks.append(f"{feature} is called with {len(copies)} arguments: {names}")
            raise
        parts = _tensors(where, found, returns)
        _check_arguments(where, takes, arguments, copies)
        _check_shapes(where, takes, arguments, parts, returns)
        _check_dtypes(where, arguments, parts, returns)
        return parts

    def call(*arguments: Any) -> Any:
        nonlocal asked
        parts = answer(arguments)
        if not asked:
            asked = True
            _check_same(where, parts, answer(arguments), returns)
            # Of float64 alone, nobody could tell whether it is float64 for all.
            answer(_single(arguments))
        widest = _widest(arguments)
        exact = []
        for part, one in zip(parts, returns, strict=True):
            if widest is not None and part.is_floating_point() and part.dtype != widest:
                remark = (
                    f"{feature} returns {one.name} in {_short(part.dtype)} for arguments in "
                    f"{_short(widest)}: if that is meant, give the target a tolerance, say 3e-3"
                )
                remarks.extend([remark] if remark not in remarks else [])
                part = part.to(widest)  # what is compared is in the dtype of the arguments
            exact.append(part)
        return tuple(exact) if len(returns) > 1 else exact[0]

    return call


def _parts(side: str) -> list[_Part]:
    found = []
    for text in side.split("; "):
        match = re.fullmatch(r"(\w+)(?: \((.*)\))?(?: bool)?", text)
        assert match is not None, text
        dims = tuple(match[2].split(", ")) if match[2] else ()
        found.append(_Part(match[1], dims, text))
    return found


def _copies(arguments: tuple[Any, ...]) -> list[Any]:
    return [value.clone() if isinstance(value, Tensor) else value for value in arguments]


def _tensors(where: str, found: Any, returns: list[_Part]) -> list[Tensor]:
    several = len(returns) > 1 and isinstance(found, tuple | list)
    parts = list(found) if several else [found]
    wanted = ", ".join(one.wanted for one in returns)
    if len(parts) != len(returns) or not all(isinstance(part, Tensor) for part in parts):
        kinds = ", ".join(type(part).__name__ for part in parts)
        got = f"({kinds})" if several else kinds
        what = "a torch.Tensor" if len(returns) == 1 else f"{len(returns)} torch.Tensors"
        raise TypeError(f"{where} must return {what}, {wanted}, got {got}")
    for part, one in zip(parts, returns, strict=True):
        is_bool = part.dtype == torch.bool
        is_whole = not is_bool and not part.is_floating_point() and not part.is_complex()
        right = {"status": is_bool or is_whole}.get(
            one.name, is_bool if one.wanted.endswith("bool") else part.is_floating_point()
        )
        if not right:
            kind = "bool" if one.wanted.endswith("bool") else "of floating point"
            kind = "bool or whole numbers" if one.name == "status" else kind
            raise TypeError(f"{where}: {one.name} must be {kind}, got {_short(part.dtype)}")
    return parts


def _check_arguments(
    where: str, takes: list[_Part], arguments: tuple[Any, ...], copies: list[Any]
) -> None:
    for one, before, after in zip(takes, arguments, copies, strict=True):
        if isinstance(before, Tensor) and not _same_bits(before, after):
            raise AssertionError(
                f"{where} writes into its argument {one.wanted}: what is computed next from the "
                "same tensor is wrong; let it work on a copy"
            )


def _check_shapes(
    where: str,
    takes: list[_Part],
    arguments: tuple[Any, ...],
    parts: list[Tensor],
    returns: list[_Part],
) -> None:
    sizes: dict[str, int] = {}
    batched = False
    for one, value in zip(takes, arguments, strict=True):
        if isinstance(value, Tensor):
            batched |= value.dim() > len(one.dims)
            shape: tuple[int, ...] = tuple(value.shape)[-len(one.dims) :]
        else:
            shape = value if one.dims and isinstance(value, tuple) else ()
        names = one.dims if shape else ()
        sizes |= {dim: size for dim, size in zip(names, shape, strict=True) if dim.isalpha()}
        if one.name == "S":
            sizes["S"] = value
    for one, part in zip(returns, parts, strict=True):
        wanted = one.sized(sizes)
        shape = tuple(part.shape)
        if (shape[-len(wanted) :] if batched else shape) != wanted:
            raise AssertionError(f"{where} must return {one.wanted}, here {wanted}, got {shape}")


def _check_dtypes(
    where: str, arguments: tuple[Any, ...], parts: list[Tensor], returns: list[_Part]
) -> None:
    widest = _widest(arguments)
    for one, part in zip(returns, parts, strict=True):
        if widest is None or not part.is_floating_point():
            continue
        if torch.promote_types(part.dtype, widest) != widest:
            raise AssertionError(
                f"{where} returns {one.name} in {_short(part.dtype)} for arguments in "
                f"{_short(widest)}: its dtype must be theirs"
            )


def _check_same(
    where: str, first: list[Tensor], second: list[Tensor], returns: list[_Part]
) -> None:
    for one, here, there in zip(returns, first, second, strict=True):
        same = here.shape == there.shape
        if same and here.is_floating_point():
            # Not to the last bit: sums on an accelerator may come in any order.
            share = max(1e-9, 64 * torch.finfo(here.dtype).eps)
            same = torch.allclose(here, there, rtol=share, atol=share, equal_nan=True)
        elif same:
            same = torch.equal(here, there)
        if not same:
            moved = ""
            if here.shape == there.shape and here.is_floating_point():
                apart = (here - there).detach().abs().nan_to_num(torch.inf).max()
                moved = f", {float(apart):.2g} apart"
            raise AssertionError(
                f"{where} is not deterministic: the same question asked twice has two answers, "
                f"{one.name}{moved}. If it draws at random, seed it inside"
            )


def _same_bits(before: Tensor, after: Tensor) -> bool:
    if torch.equal(before, after) or before.shape != after.shape:
        return before.shape == after.shape
    return bool(((before == after) | ((before != before) & (after != after))).all())


def _single(arguments: tuple[Any, ...]) -> tuple[Any, ...]:
    return tuple(
        value.detach().float() if isinstance(value, Tensor) and value.is_floating_point() else value
        for value in arguments
    )


def _widest(arguments: tuple[Any, ...]) -> torch.dtype | None:
    widest: torch.dtype | None = None
    for value in arguments:
        if isinstance(value, Tensor) and value.is_floating_point():
            widest = value.dtype if widest is None else torch.promote_types(widest, value.dtype)
    return widest


def _short(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")
