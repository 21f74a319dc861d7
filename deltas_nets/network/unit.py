"""In which unit the network sees the world: it was trained on rooms in metres."""

__all__ = ["AS_IN_ROOMS", "unit_of"]

USUAL = 2.5
"""Metres of the median depth that the network sees of a capture without metres."""
AS_IN_ROOMS = (1.0, 6.0)
"""Metres: a median depth within them is left as it is."""


def unit_of(median: float, metric: bool) -> float:
    """Metres that the network takes a unit for where surfaces are typically so far.

    Example:
        >>> unit_of(2.0, metric=True), unit_of(0.5, metric=True), unit_of(250.0, metric=False)
        (1.0, 5.0, 0.01)
    """
    return 1.0 if metric and AS_IN_ROOMS[0] <= median <= AS_IN_ROOMS[1] else USUAL / median
