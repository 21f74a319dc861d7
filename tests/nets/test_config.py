"""Configs: what is recorded comes back, nonsense is refused."""

import json
from dataclasses import fields, replace
from math import inf, nan
from pathlib import Path

import pytest

from deltas_nets.config import (
    DataConfig,
    DetectorConfig,
    LossConfig,
    MatcherConfig,
    NetworkConfig,
    TrainConfig,
    from_dict,
    to_dict,
    without_paths,
)
from deltas_nets.config.redraw import RedrawConfig
from deltas_nets.config.scannet import ScanNetConfig
from deltas_nets.evaluate.rooms import CALIBRATION_SEEDS, EVALUATION_SEEDS
from deltas_nets.export.agreement import ROOM_SEEDS
from deltas_nets.train.fit import validation_rooms

FRAMES = DataConfig(
    source="scannet",
    cache="/mine/kept",
    scannet=ScanNetConfig(
        root="/mine", split="/mine/a.txt", validation="/mine/b.txt", skip="c.txt", baseline=(0.1, 1)
    ),
)


@pytest.mark.parametrize(
    "config",
    [
        NetworkConfig(),
        NetworkConfig(name="other", matcher=MatcherConfig(kind="per_view", offsets=(-2.0, 2.0))),
        TrainConfig(steps=7, sizes=((48, 64),), data=DataConfig(cache="somewhere")),
        TrainConfig(data=FRAMES),
    ],
)
def test_a_config_survives_json(config: NetworkConfig | TrainConfig) -> None:
    assert from_dict(type(config), json.loads(json.dumps(to_dict(config)))) == config


def test_unknown_fields_are_refused() -> None:
    with pytest.raises(ValueError, match="NetworkConfig has no field wings"):
        from_dict(NetworkConfig, {"wings": 2})


def test_nonsense_is_refused_in_the_users_words() -> None:
    with pytest.raises(ValueError, match="min_views <= max_views"):
        TrainConfig(min_views=4, max_views=3)
    with pytest.raises(ValueError, match="num_samples must be at least 8"):
        MatcherConfig(num_samples=2)
    with pytest.raises(ValueError, match="need --data scannet"):
        DataConfig(scannet=ScanNetConfig(root="somewhere"))
    with pytest.raises(ValueError, match="gap must be at least 1"):
        ScanNetConfig(gap=0)
    with pytest.raises(ValueError, match="baseline must be 0 < low < high"):
        ScanNetConfig(baseline=(0.1, inf))
    with pytest.raises(ValueError, match="offsets must name a line"):
        MatcherConfig(offsets=())
    TrainConfig(data=FRAMES, max_views=7)  # of rooms, 5 views are rendered


def test_no_training_sees_a_room_that_is_measured_on() -> None:
    measured = {*EVALUATION_SEEDS, *CALIBRATION_SEEDS, *ROOM_SEEDS}
    first = validation_rooms().seed
    measured |= set(range(first, first + len(validation_rooms())))
    for seed in (min(measured), max(measured)):
        with pytest.raises(ValueError, match=f"seed must be 1000 or more.*got {seed}"):
            DataConfig(seed=seed)
        with pytest.raises(ValueError, match=f"first_room must be 1000 or more.*got {seed}"):
            RedrawConfig(Path("a.safetensors"), first_room=seed)
    DataConfig(seed=max(measured) + 1)
    replace(FRAMES, seed=0)  # of no rooms


def numeric_fields(kind: type) -> list[tuple[type, str]]:
    """Fields of a config that hold a number, or some."""
    defaults = kind()
    values = ((field.name, getattr(defaults, field.name)) for field in fields(kind))
    one_of_two = {"descriptor_stride"}
    return [(kind, name) for name, value in values if numbers_in(value) and name not in one_of_two]


def numbers_in(value: object) -> bool:
    first = value[0] if isinstance(value, tuple) and value else value
    return isinstance(first, int | float) and not isinstance(first, bool)


CONFIGS = (TrainConfig, DataConfig, LossConfig, NetworkConfig, DetectorConfig, MatcherConfig)


@pytest.mark.parametrize(
    ("kind", "name"), [pair for kind in CONFIGS for pair in numeric_fields(kind)]
)
def test_no_number_is_nan_infinite_or_below_its_least(kind: type, name: str) -> None:
    usual = getattr(kind(), name)
    wrong: list[float] = [] if name == "offsets" else [-1]  # lines to either side
    wrong += [nan, inf] if isinstance(usual, float | tuple) else []
    for number in wrong:
        value = (number, *usual[1:]) if isinstance(usual, tuple) else number
        with pytest.raises(ValueError, match=f"{name}.*, got .*{number}"):
            kind(**{name: value})


def test_what_is_shown_to_others_has_names_but_no_folders() -> None:
    config = TrainConfig(steps=7, data=FRAMES)
    public = without_paths(config)
    assert "/" not in json.dumps(to_dict(public))
    scannet = public.data.scannet
    assert (scannet.root, scannet.split, scannet.validation) == (None, "a.txt", "b.txt")
    assert scannet.skip == "c.txt" and scannet.baseline == (0.1, 1)
    assert public.steps == 7 and public.data.source == "scannet" and public.data.cache is None
    assert without_paths(public) == public
    assert without_paths(TrainConfig()) == TrainConfig()
