"""Metric depth from posed images: the DELTAS network, its training, weights and command.

Example:
    >>> from deltas_nets import load_model
    >>> model = load_model("deltas-small")
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from deltas_nets.captures.opening import open_capture
    from deltas_nets.config import NetworkConfig
    from deltas_nets.network.deltas import Deltas
    from deltas_nets.network.prediction import DepthPrediction
    from deltas_nets.predict.predictor import load_predictor
    from deltas_nets.weights_file import load_model

__version__ = "0.1.0"

__all__ = [
    "Deltas",
    "DepthPrediction",
    "NetworkConfig",
    "load_model",
    "load_predictor",
    "open_capture",
]

_HOMES = {
    "Deltas": "deltas_nets.network.deltas",
    "DepthPrediction": "deltas_nets.network.prediction",
    "NetworkConfig": "deltas_nets.config",
    "load_model": "deltas_nets.weights_file",
    "load_predictor": "deltas_nets.predict.predictor",
    "open_capture": "deltas_nets.captures.opening",
}


def __getattr__(name: str) -> Any:
    # On first use, so that `deltas --help` does not wait for torch.
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    # What completion offers: names that nobody has used yet are in no globals.
    return sorted({*globals(), *__all__})
