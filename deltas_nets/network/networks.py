"""The kinds of networks that the training code trains, and which one a config names."""

from deltas_nets.config import NetworkConfig
from deltas_nets.network.cost_volume.network import CostVolume
from deltas_nets.network.deltas import Deltas

Network = Deltas | CostVolume


def build_network(config: NetworkConfig) -> Network:
    """The network of a config, with random weights.

    Example:
        >>> build_network(NetworkConfig()).config.name
        'deltas-small'
    """
    return CostVolume(config) if config.matcher.kind == "volume" else Deltas(config)
