"""Records of tensors: named tuples that move, detach, save and print as one tensor does."""

from collections import Counter, namedtuple
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Self, dataclass_transform

import torch
from torch import Tensor

from deltas_geom.status import Status


class _RecordType(type):
    """Makes a plain named tuple of each class that derives from :class:`Record`.

    Its one base must be ``tuple``: ``vmap`` and ``torch.compile`` of torch 2.6 take a named tuple
    with another base for a leaf. So the methods of Record are copied, not inherited.
    """

    def __new__(cls, name: str, bases: tuple[type, ...], body: dict[str, Any]) -> Any:
        written = super().__new__(cls, name, bases, body)
        if bases == (tuple,):
            return written
        fields = list(written.__annotations__)
        record: Any = namedtuple(name, fields, module=written.__module__)  # type: ignore[misc]
        copied = {"__new__", "__repr__", "__doc__", "__qualname__", "__annotations__"}
        for key, value in {**vars(bases[0]), **vars(written)}.items():
            if key in copied or not key.startswith("__"):
                setattr(record, key, value)
        # torch.load refuses classes that it has not been told of.
        torch.serialization.add_safe_globals([record])
        return record


@dataclass_transform(frozen_default=True)
class Record(tuple[Any, ...], metaclass=_RecordType):
    """A named tuple of tensors, None and other records, with what is common to all of them."""

    if TYPE_CHECKING:  # as of every named tuple
        _fields: tuple[str, ...]

        def _asdict(self) -> dict[str, Any]: ...
        def _replace(self, **changes: Any) -> Self: ...

    def to(self, *args: Any, **kwargs: Any) -> Self:
        """All moved as by :meth:`torch.Tensor.to`; a dtype is for floating point alone."""
        target: list[Any] = [arg.device if isinstance(arg, Tensor) else arg for arg in args]
        place = [arg for arg in target if not isinstance(arg, (torch.dtype, bool))]
        options = {name: value for name, value in kwargs.items() if name != "dtype"}

        def moved(tensor: Tensor) -> Tensor:
            if tensor.is_floating_point():
                return tensor.to(*args, **kwargs)
            return tensor.to(*place, **options) if place or options else tensor

        return mapped(moved, self)  # type: ignore[no-any-return]

    def detach(self) -> Self:
        """The same without gradients."""
        return mapped(Tensor.detach, self)  # type: ignore[no-any-return]

    @property
    def device(self) -> torch.device:
        """Of the first tensor, as of all."""
        return tensors_of(self)[0].device

    @property
    def dtype(self) -> torch.dtype:
        """Of the first tensor that is of floating point."""
        return next(x.dtype for x in tensors_of(self) if x.is_floating_point())

    def __repr__(self) -> str:
        """Shapes, dtype and device, how many of each status or mask: no numbers."""
        tensors = tensors_of(self)
        kinds = {str(x.dtype).removeprefix("torch.") for x in tensors if x.is_floating_point()}
        places = {str(x.device) for x in tensors}
        return " ".join([_described(self), *sorted(kinds), *sorted(places)])


def mapped(function: Callable[[Tensor], Any], value: Any, but: str | None = None) -> Any:
    """The same nest of tuples with ``function`` of each tensor, but of fields of this name."""
    if isinstance(value, Tensor):
        return function(value)
    if isinstance(value, tuple):
        names = getattr(value, "_fields", None)
        inside = [
            part if name is not None and name == but else mapped(function, part, but)
            for name, part in zip(names or [None] * len(value), value, strict=True)
        ]
        return type(value)(*inside) if names else tuple(inside)
    return value


def tensors_of(values: Any) -> list[Tensor]:
    """All tensors in a nest of tuples, in order."""
    if isinstance(values, Tensor):
        return [values]
    parts = values if isinstance(values, tuple) else ()
    return [tensor for part in parts for tensor in tensors_of(part)]


def _described(value: Any, name: str = "") -> str:
    if isinstance(value, Tensor):
        return f"{tuple(value.shape)}{_counts(value, name)}"
    if isinstance(value, tuple):
        names = getattr(value, "_fields", [""] * len(value))
        pairs = zip(names, value, strict=True)
        inside = ", ".join(f"{key} {_described(part, key)}".lstrip() for key, part in pairs)
        return f"{type(value).__name__ if names and names[0] else ''}({inside})"
    return repr(value)


def _counts(tensor: Tensor, name: str) -> str:
    """How many of each status, or how many are True; nothing where values cannot be read."""
    if name != "status" and tensor.dtype != torch.bool:
        return ""
    try:
        if tensor.dtype == torch.bool:
            return f" {int(tensor.sum())} True"
        counts = Counter(tensor.flatten().tolist())
        return "".join(f" {counts[code]} {Status(code).name}" for code in sorted(counts))
    except (RuntimeError, ValueError):  # no values: meta, fake or mapped tensors; no statuses
        return ""
