"""Wrong implementations made of ours, by what is done to the arguments or to the result."""

from collections.abc import Callable
from typing import Any

from deltas_geom.testing.target import Target
from deltas_geom.testing.targets import deltas

OURS = deltas()
Function = Callable[..., Any]


def ours(feature: str) -> Function:
    function: Function = getattr(OURS, feature)
    return function


def before(name: str, feature: str, change: Function) -> Target:
    """Ours, given other arguments."""
    return Target(name, **{feature: lambda *given: ours(feature)(*change(*given))})


def after(name: str, feature: str, change: Function) -> Target:
    """Ours, with another result."""

    def call(*given: Any) -> Any:
        result = ours(feature)(*given)
        return change(*result) if isinstance(result, tuple) else change(result)

    return Target(name, **{feature: call})
