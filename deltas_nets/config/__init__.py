"""What a network, its losses and a training are made of: frozen dataclasses.

One dataclass is the flags of the command line, the argument in a notebook and the record that
is written beside the weights.
"""

from deltas_nets.config.losses import LOSS_FUNCTIONS, MAP_TERMS, PAPER_LOSS, LossConfig
from deltas_nets.config.named import CONFIGS, TRAIN_CONFIGS
from deltas_nets.config.network import DetectorConfig, MatcherConfig, NetworkConfig
from deltas_nets.config.record import from_dict, to_dict, without_paths
from deltas_nets.config.training import DataConfig, TrainConfig

__all__ = [
    "CONFIGS",
    "LOSS_FUNCTIONS",
    "MAP_TERMS",
    "PAPER_LOSS",
    "TRAIN_CONFIGS",
    "DataConfig",
    "DetectorConfig",
    "LossConfig",
    "MatcherConfig",
    "NetworkConfig",
    "TrainConfig",
    "from_dict",
    "to_dict",
    "without_paths",
]
