"""Configs as the records that are written beside weights."""

import dataclasses
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

from deltas_nets.config.training import TrainConfig

Config = TypeVar("Config")


def to_dict(config: Any) -> dict[str, Any]:
    """A config dataclass as plain, JSON-ready values."""
    return dataclasses.asdict(config)


def from_dict(kind: type[Config], values: dict[str, Any]) -> Config:
    """The config that :func:`to_dict` recorded.

    Args:
        kind: the dataclass, for example :class:`NetworkConfig`.
        values: its fields; missing ones keep their defaults.

    Raises:
        ValueError: a field is unknown, or has no fields: the record is of another version.
    """
    if not isinstance(values, dict):
        raise ValueError(f"{kind.__name__} must be fields by name, got {type(values).__name__}")
    hints = get_type_hints(kind)
    unknown = sorted(set(values) - set(hints))
    if unknown:
        raise ValueError(f"{kind.__name__} has no field {', '.join(unknown)}")
    read: dict[str, Any] = {}
    for name, value in values.items():
        hint = hints[name]
        if isinstance(hint, type) and dataclasses.is_dataclass(hint):
            value = from_dict(hint, value)
        else:
            value = _as_tuples(value)
        read[name] = value
    return kind(**read)


def without_paths(config: TrainConfig) -> TrainConfig:
    """The config as it may be shown to others: where files are is the machine's, and private.

    Of split and skip files the names stay.
    """
    scannet = config.data.scannet
    public = dataclasses.replace(
        scannet,
        root=None,
        split=Path(scannet.split).name,
        validation=None if scannet.validation is None else Path(scannet.validation).name,
        skip=None if scannet.skip is None else Path(scannet.skip).name,
    )
    data = dataclasses.replace(config.data, cache=None, scannet=public)
    return dataclasses.replace(config, data=data)


def _as_tuples(value: Any) -> Any:
    """JSON's lists as the tuples they were."""
    return tuple(_as_tuples(item) for item in value) if isinstance(value, list) else value
