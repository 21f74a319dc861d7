"""The table of losses: the function of each, what it weighs with us, and in the paper.

A field of :class:`LossConfig` that :func:`_loss` makes is a row. Its function is named, not
imported: configs are read before torch is.
"""

from dataclasses import dataclass, field, fields
from typing import Any

from deltas_nets.config.checks import check_at_least


def _loss(function: str, ours: float, *, paper: float = 0.0) -> Any:
    """A row of the table.

    Args:
        function: "module:name" in `deltas_nets.losses`; it takes a `Seen`, or of dense
            a `SeenMap`, and returns a scalar.
        ours: the weight in our trainings, unless a flag gives another.
        paper: the weight in the paper's; 0 where the paper has no such term.
    """
    return field(default=ours, metadata={"function": function, "paper": paper})


@dataclass(frozen=True)
class LossConfig:
    """Weights of the loss terms; the first five are the paper's terms."""

    detector: float = _loss("points:detector_loss", 0.1, paper=0.1)
    """Cross-entropy of interest points."""
    match: float = _loss("points:match_loss", 0.1, paper=1.0)
    """Smooth L1 of 2D matches, pixels."""
    point: float = _loss("points:point_loss", 2.0, paper=2.0)
    """Smooth L1 of 3D points, relative to their depth."""
    smoothness: float = _loss("dense:smoothness_loss", 0.02, paper=1.0)
    """Edge-aware smoothness of the dense map."""
    depth: float = _loss("dense:depth_loss", 2.0, paper=2.0)
    """Smooth L1 of log depth at the finest of four scales."""
    scale_decay: float = 0.7
    """Factor of the depth term from a scale to the next coarser one (the paper: 0.7)."""
    gradient: float = _loss("dense:gradient_loss", 2.0)
    """L1 of the gradient of log depth at the two finest scales: keeps edges where they are."""
    posterior: float = _loss("points:posterior_loss", 1.0)
    """Cross-entropy of the posterior over inverse depth, at every stage."""
    confidence: float = _loss("points:confidence_loss", 0.5)
    """Cross-entropy of the points' confidence."""
    spread: float = _loss("dense:spread_loss", 0.2)
    """Laplace likelihood of the dense map's own uncertainty."""

    def __post_init__(self) -> None:
        check_at_least(0, self, *(term.name for term in fields(self)))


_ROWS = {row.name: row.metadata for row in fields(LossConfig) if "function" in row.metadata}

LOSS_FUNCTIONS: dict[str, str] = {name: row["function"] for name, row in _ROWS.items()}
"""The function of each loss, in the order in which losses are recorded."""

MAP_TERMS = tuple(name for name, row in _ROWS.items() if row["function"].startswith("dense:"))
"""Those that look at nothing but the dense map: each takes a `SeenMap`."""

PAPER_LOSS = LossConfig(**{name: row["paper"] for name, row in _ROWS.items()})
"""The five terms with the paper's weights, and no other."""
