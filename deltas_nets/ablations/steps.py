"""One row of a table: a network, or what it is given, with one thing changed."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from deltas_nets.captures.view_sets import ViewSet
from deltas_nets.config.varied import NetworkSettings
from deltas_nets.predict.predictor import Predictor

__all__ = ["Series", "Step", "instead", "varied"]


T = TypeVar("T")


def _same(given: T) -> T:
    return given


@dataclass(frozen=True)
class Step:
    """One thing changed."""

    name: str
    """As rows have it."""
    value: float | None = None
    """Where it is on the figure's axis; None beside it."""
    change: Callable[[Predictor], Predictor] = _same
    """The network to another.

    Raises:
        UserError: the network lacks the setting; the row says so.
    """
    weights: str | None = None
    """What is loaded in the network's place, by name."""
    views: Callable[[ViewSet], ViewSet] = _same
    """A view set to another."""
    search: tuple[float, float] | None = None
    """(near, far) of the search, metres; that of the command if None."""
    once: bool = False
    """Whether it does not depend on the network that is measured: a row for all of them."""


@dataclass(frozen=True)
class Series:
    """A table or a curve."""

    name: str
    """As the command takes it."""
    title: str
    """What is changed, for a person."""
    axis: str
    """What the values are, with their unit; empty where steps lie on no axis."""
    steps: tuple[Step, ...]
    logarithmic: bool = False
    """Whether the axis is."""
    source: str = ""
    """Which table of the paper it is."""

    def __post_init__(self) -> None:
        names = [step.name for step in self.steps]
        if len(set(names)) < len(names):
            raise ValueError(f"steps of {self.name} must have names of their own, got {names}")


def varied(name: str, value: float, settings: NetworkSettings) -> Step:
    """A setting of the supplement."""
    return Step(name, value, lambda predictor: predictor.varied(settings))


def instead(name: str, weights: str) -> Step:
    """Another method, whatever the network."""
    return Step(name, weights=weights, once=True)
