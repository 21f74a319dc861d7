"""Numbers of a config, refused in the user's words where they make no sense."""

import math
from typing import Any

__all__ = [
    "check_at_least",
    "check_finite",
    "check_positive",
    "check_seed",
    "check_share",
    "check_unseen",
]

MAX_SEED = 2**32 - 1
HELD_OUT = 1000
"""Seeds below are those of rooms that are measured on."""


def check_at_least(least: int, config: Any, *names: str) -> None:
    """Each of these fields, or every number of it, is finite and ``least`` or more.

    Raises:
        ValueError: one is not; the text names it.
    """
    check_finite(config, *names)
    for name in names:
        if any(number < least for number in _numbers(config, name)):
            raise ValueError(f"{name} must be at least {least}, got {getattr(config, name)}")


def check_positive(config: Any, *names: str) -> None:
    """Each of these fields is finite and above 0; raises as :func:`check_at_least`."""
    check_finite(config, *names)
    for name in names:
        if any(number <= 0 for number in _numbers(config, name)):
            raise ValueError(f"{name} must be positive, got {getattr(config, name)}")


def check_share(config: Any, *names: str) -> None:
    """Each of these fields is within [0, 1); raises as :func:`check_at_least`."""
    for name in names:
        if not all(0 <= number < 1 for number in _numbers(config, name)):
            raise ValueError(f"{name} must be within [0, 1), got {getattr(config, name)}")


def check_finite(config: Any, *names: str) -> None:
    """Each of these fields is finite; raises as :func:`check_at_least`."""
    for name in names:
        if not all(map(math.isfinite, _numbers(config, name))):
            raise ValueError(f"{name} must be finite, got {getattr(config, name)}")


def check_seed(config: Any) -> None:
    """Generators take the config's ``seed``; raises as :func:`check_at_least`."""
    if not 0 <= config.seed <= MAX_SEED:
        raise ValueError(f"seed must be within [0, {MAX_SEED}], got {config.seed}")


def check_unseen(config: Any, name: str) -> None:
    """No room from this field's seed on is measured on; raises as :func:`check_at_least`."""
    if getattr(config, name) < HELD_OUT:
        what = f"{name} must be {HELD_OUT} or more, as no training sees the rooms below"
        raise ValueError(f"{what}; got {getattr(config, name)}")


def _numbers(config: Any, name: str) -> tuple[float, ...]:
    value = getattr(config, name)
    return value if isinstance(value, tuple) else (value,)
