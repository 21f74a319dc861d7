"""What a scene can be asked for: places and bounds, in the words of every error."""

import math

from deltas_geom.checks import check_counts


def check_places(size: tuple[int, int]) -> None:
    """Raise ``ValueError`` unless ``size``, (h, w), has two places or more."""
    check_counts(1, size=size)
    if size[0] * size[1] < 2:
        raise ValueError(f"size must be (h, w) of 2 places or more, got {size}")


def check_bounds(most: float = math.inf, **bounds: float) -> None:
    """Raise ``ValueError`` unless every bound is finite, 0 or more, and ``most`` at most.

    Example:
        >>> check_bounds(noise=-0.5)
        Traceback (most recent call last):
        ...
        ValueError: noise must be finite and 0 or more, got -0.5
    """
    for name, bound in bounds.items():
        if not (0 <= bound <= most and math.isfinite(bound)):
            allowed = "finite and 0 or more" if math.isinf(most) else f"between 0 and {most:g}"
            raise ValueError(f"{name} must be {allowed}, got {bound}")
