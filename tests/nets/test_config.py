"""Configs: what is recorded comes back, nonsense is refused."""

import json

import pytest

from deltas_nets.config import (
    DataConfig,
    MatcherConfig,
    NetworkConfig,
    TrainConfig,
    from_dict,
    to_dict,
)


@pytest.mark.parametrize(
    "config",
    [
        NetworkConfig(),
        NetworkConfig(name="other", matcher=MatcherConfig(kind="per_view", offsets=(-2.0, 2.0))),
        TrainConfig(steps=7, sizes=((48, 64),), data=DataConfig(cache="somewhere")),
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
